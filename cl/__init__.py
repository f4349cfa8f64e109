"""The OpenCL kernels and their headers; this file holds no code, it makes the folder importable as `clrecon.cl`."""
