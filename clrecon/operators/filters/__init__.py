"""Filters of volumes: HU in, HU out, at the same places."""
