"""Clouds of points: the class `PointCloud`, what a step made of one, and which clusters are kept."""

from clrecon.points.cloud import PointCloud
from clrecon.points.keep import keep_clusters
from clrecon.points.step import PointStep

__all__ = ["PointCloud", "PointStep", "keep_clusters"]
