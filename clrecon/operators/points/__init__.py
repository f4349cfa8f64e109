"""Clouds of points on the device: grids over them, and what is made of them."""
