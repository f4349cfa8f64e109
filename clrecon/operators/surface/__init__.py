"""Surfaces at an iso value, of labels and of their masks."""
