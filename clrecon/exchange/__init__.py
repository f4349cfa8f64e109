"""Files of meshes that are written: one module a format, chosen by the extension of the file."""
