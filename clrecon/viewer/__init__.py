"""Scenes in PyVista: meshes and pictures together, seen by one camera."""

from clrecon.viewer.scene import add_rendering, merge_scene

__all__ = ["add_rendering", "merge_scene"]
