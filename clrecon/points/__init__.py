"""Clouds of points: the class `PointCloud`, what a step made of one, and which clusters are kept."""

from clrecon.points.cloud import PointCloud
from clrecon.points.ghost_slices import drop_ghost_slices, fill_ghost_slices
from clrecon.points.keep import keep_clusters
from clrecon.points.step import PointStep

__all__ = ["PointCloud", "PointStep", "drop_ghost_slices", "fill_ghost_slices", "keep_clusters"]
