"""Headers: the elements of a file become the headers of its slices."""
