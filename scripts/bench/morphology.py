"""Case of morphology in mm: masks changed by balls and filled on the device, beside SimpleITK, scipy and edt."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from registry import Job, case
from voxel_clusters import compare_sides

RADIUS_MM, LARGE_MM = 3.0, 8.0
SCIPY_SLICES = 20
"""Slices that scipy dilates, as do we beside it: it takes a minute for 150."""

Side = Callable[[], Any]


@case("morphology", "balls in mm, closing and holes of a mask, against SimpleITK, scipy, edt, fastmorph and fill-voids")
def measure_morphology(job: Job) -> dict[str, Any]:
    """Time masks on the device, and with ``-packed`` from a bool array in host memory to another one.

    Peers begin and end with arrays in host memory, in their own best type.  Ratios are of wall time and, with ``-cpu``,
    of processor time.  ``equal`` says where the voxels are the same; balls of SimpleITK are ellipsoids of whole voxels.
    """
    import numpy as np

    import clrecon
    from clrecon.opencl import wait

    volume = job.input.volume()
    inside = volume.voxels >= job.hu
    few = clrecon.Volume(volume.voxels[:SCIPY_SLICES], volume.affine)
    mask, part = (clrecon.Mask.from_array(each, each.voxels >= job.hu, device=job.device) for each in (volume, few))
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "equal": {}, "voxels": int(inside.sum())}
    steps: dict[str, Callable[[clrecon.Mask], clrecon.Mask]] = {
        "dilate": lambda made: made.dilate(RADIUS_MM),
        "dilate-large": lambda made: made.dilate(LARGE_MM),
        "close": lambda made: made.close(RADIUS_MM),
        "holes": lambda made: made.fill_holes(),
    }

    def on_device(step: str, of: clrecon.Mask) -> Side:
        def run() -> clrecon.Mask:
            made = steps[step](of)
            wait(job.device)
            return made

        return run

    def packed(step: str) -> Any:
        return steps[step](clrecon.Mask.from_array(volume, inside, device=job.device)).to_numpy()

    for (step, peer), theirs in _peers(inside, tuple(map(float, volume.spacing))).items():
        of = part if peer == "scipy-part" else mask
        compare_sides(job, f"{step}-{peer}", on_device(step, of), theirs, figures)
        figures["equal"][f"{step}-{peer}"] = bool(np.array_equal(steps[step](of).to_numpy(), theirs()))
        if peer == "simpleitk":
            compare_sides(job, f"{step}-{peer}-packed", partial(packed, step), theirs, figures)
    return figures


def _peers(inside: Any, spacing: tuple[float, ...]) -> dict[tuple[str, str], Side]:
    """Return the peers' functions by step and name; those that are not installed are left out."""
    import numpy as np
    from scipy import ndimage

    peers = _simpleitk_peers(inside, spacing)
    across = spacing[::-1]
    reach = [int(RADIUS_MM / step) for step in across]
    places = np.indices([2 * n + 1 for n in reach]) - np.array(reach)[:, None, None, None]
    square = sum((place * step) ** 2 for place, step in zip(places, across, strict=True))
    ball = square <= (RADIUS_MM * (1 + 1e-6)) ** 2
    part = inside[:SCIPY_SLICES]
    peers["dilate", "scipy-part"] = lambda: ndimage.binary_dilation(part, ball)
    peers["holes", "scipy"] = lambda: ndimage.binary_fill_holes(inside)
    try:
        import edt

        outside = ~inside
        peers["dilate", "edt"] = lambda: (
            edt.edt(outside, anisotropy=across, parallel=0) <= np.float32(RADIUS_MM * (1 + 1e-6))
        )
    except ImportError:
        pass
    try:
        import fastmorph

        bytes_inside = inside.view(np.uint8)
        peers["dilate", "fastmorph"] = lambda: fastmorph.spherical_dilate(
            bytes_inside, radius=RADIUS_MM, anisotropy=across, parallel=0
        )
    except ImportError:
        pass
    try:
        import fill_voids

        peers["holes", "fill-voids"] = lambda: fill_voids.fill(inside)
    except ImportError:
        pass
    return peers


def _simpleitk_peers(inside: Any, spacing: tuple[float, ...]) -> dict[tuple[str, str], Side]:
    import numpy as np
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(inside.view(np.uint8))
    small, large = ([int(mm / step + 1e-9) for step in spacing] for mm in (RADIUS_MM, LARGE_MM))

    def array(made: Any) -> Any:
        return sitk.GetArrayViewFromImage(made)

    return {
        ("dilate", "simpleitk"): lambda: array(sitk.BinaryDilate(image, small)),
        ("dilate-large", "simpleitk"): lambda: array(sitk.BinaryDilate(image, large)),
        ("close", "simpleitk"): lambda: array(sitk.BinaryMorphologicalClosing(image, small)),
        ("holes", "simpleitk"): lambda: array(sitk.BinaryFillhole(image)),
    }
