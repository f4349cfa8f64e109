"""Pictures, parts and meshes of what a view shows, on the device."""
