"""Files of meshes and clouds: a module for each format, with its writer and its reader."""
