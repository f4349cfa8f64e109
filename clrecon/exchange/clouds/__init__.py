"""Files of point clouds: writers of our own clouds, readers of those of other programs too."""
