"""Elements of a file to the headers of its slices."""
