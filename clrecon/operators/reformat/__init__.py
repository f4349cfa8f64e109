"""Slices and curved reformations."""
