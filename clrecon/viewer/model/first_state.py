"""What a view shows at the start: the objects as wholes, the labels of label maps, and the ends of the slider."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from clrecon.rendering.pictures.label_style import distinct_colors
from clrecon.viewer.model.objects import ShownCloud, ShownLabels, ShownMesh, ShownObject, ShownScan
from clrecon.viewer.model.state import ShownPart, as_point

ISO_ENDS = (-1000.0, 2000.0)
"""Ends of the slider, as far as the values of the scan go: air, and dense cortex."""


def first_parts(objects: Sequence[ShownObject]) -> list[ShownPart]:
    """Return the objects as wholes, and the labels of label maps."""
    parts = []
    for each in objects:
        count: int | None = None
        if isinstance(each, ShownMesh):
            count = each.mesh.triangle_count
        elif isinstance(each, ShownCloud):
            count = len(each.cloud)
        parts.append(ShownPart(key=str(each.number), name=each.name, kind=each.kind, object=each.number, count=count))
        if isinstance(each, ShownLabels):
            parts += _label_parts(each)
    return parts


def _label_parts(shown: ShownLabels) -> list[ShownPart]:
    """Return a part for each label, and within a scan one for what has none."""
    labels = shown.labels
    voxel_ml = abs(float(np.linalg.det(labels.affine[:3, :3]))) / 1000.0
    colors = distinct_colors(len(labels.numbers))
    parts = [
        ShownPart(
            key=f"{shown.number}/{number}", name=labels.name(number), kind="label", object=shown.number,
            number=number, ml=voxels * voxel_ml, count=voxels, color=as_point(color),
        )
        for (number, voxels), color in zip(labels.counts.items(), colors, strict=True)
    ]  # fmt: skip
    if shown.within is not None:
        parts.append(ShownPart(key=f"{shown.number}/0", name="without a label", kind="rest", object=shown.number))
    return parts


def find_iso_range(scans: Sequence[ShownScan]) -> tuple[float, float]:
    """Return the ends of the slider: values that some scan has."""
    ranges = [each.volume.hu_range for each in scans]
    known = [each for each in ranges if each is not None]
    if not known:
        return ISO_ENDS
    low, high = min(each[0] for each in known), max(each[1] for each in known)
    first, last = max(low, ISO_ENDS[0]), min(high, ISO_ENDS[1])
    return (float(math.ceil(first)), float(math.floor(last))) if math.ceil(first) < math.floor(last) else (low, high)
