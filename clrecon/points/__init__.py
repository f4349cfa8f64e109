"""Clouds of points: the class `PointCloud`, and what a step made of one."""

from clrecon.points.cloud import PointCloud
from clrecon.points.step import PointStep

__all__ = ["PointCloud", "PointStep"]
