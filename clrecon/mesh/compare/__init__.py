"""Distances of meshes from each other, from their scan and from an earlier state, and the gates on them."""
