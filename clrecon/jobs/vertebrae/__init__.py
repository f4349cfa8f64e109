"""The job that makes a first guess of a label map of vertebrae: settings, files, picture, report."""
