"""Kept kernels: the folders of built programs, what clrecon and PoCL keep there, and whether it can be trusted."""
