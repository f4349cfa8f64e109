"""The crop of a job: the scan becomes smaller before anything is made of it, and its voxels keep their places."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clrecon.errors import UsageError

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.geometry.boxes import Box
    from clrecon.labels import LabelMap


def crop_scan(volume: Volume, box: Box | None, space: str, *, margin: int = 0) -> Volume:
    """Return the part of a scan in a box, in mm of the frame `space`; all of it without a box."""
    if box is None:
        return volume
    from clrecon.geometry.crop import crop_volume

    return crop_volume(volume, *box, margin=margin, space=space)


def crop_labels(labels: LabelMap, box: Box | None, space: str) -> LabelMap:
    """Return the part of a label map in a box, as `crop_scan` does a scan."""
    if box is None:
        return labels
    import numpy as np

    from clrecon.geometry import frame_from_lps
    from clrecon.geometry.blocks import find_block, place_block
    from clrecon.labels import LabelMap

    turned = np.sort(np.array(box) * np.diag(frame_from_lps(space)), axis=0)
    origins = labels.affine[:3, 3] + np.arange(labels.shape_ijk[2])[:, None] * labels.affine[:3, 2]
    block = find_block(labels, origins, turned[0], turned[1])
    cut = None
    if block is not None:
        (i0, j0, k0), (i1, j1, k1) = block
        cut = labels.voxels[k0:k1, j0:j1, i0:i1]
    if block is None or cut is None or not cut.any():
        raise UsageError("nothing is left: no labelled voxel lies in the box of the crop")
    affine, _ = place_block(labels.affine, origins, False, block)
    names = {number: labels.name(number) for number in labels.numbers}
    return LabelMap(
        cut, affine, names, frame_of_reference_hash=labels.frame_of_reference_hash, warnings=labels.warnings
    )
