"""The job that shows scans and meshes together: as a page."""
