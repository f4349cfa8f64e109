"""Phantoms, CT series with known surfaces, as voxels or DICOM; names are loaded when first used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clrecon.proof.phantom.build import label_materials, make_phantom, write_phantom
    from clrecon.proof.phantom.sampling import add_noise, apply_point_spread, sample_occupancy
    from clrecon.proof.phantom.scenes import MATERIALS
    from clrecon.proof.phantom.settings import KINDS, PhantomSettings, parse_missing, parse_size
    from clrecon.proof.phantom.shapes import Body, Box, Cylinder, Sphere, Torus
    from clrecon.proof.phantom.truth import PhantomTruth, phantom_truth

_MODULES = {
    "build": ("label_materials", "make_phantom", "write_phantom"),
    "sampling": ("add_noise", "apply_point_spread", "sample_occupancy"),
    "scenes": ("MATERIALS",),
    "settings": ("KINDS", "PhantomSettings", "parse_missing", "parse_size"),
    "truth": ("PhantomTruth", "phantom_truth"),
    "shapes": ("Body", "Box", "Cylinder", "Sphere", "Torus"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f"clrecon.proof.phantom.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
