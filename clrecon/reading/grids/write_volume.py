"""`write_volume`: a volume as NIfTI, NRRD or MetaImage with its certificate; nothing is rounded."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, UsageError
from clrecon.exchange.content import certificate_lines
from clrecon.geometry.resample import LARGEST_SHEAR_DEGREES, describe_unevenness, resample_volume, shear_degrees
from clrecon.geometry.volume import Volume
from clrecon.reading.grids.grid_file import VOLUME, VolumeContent, import_extra
from clrecon.reading.grids.metaimage import write_metaimage
from clrecon.reading.grids.nifti import write_nifti
from clrecon.reading.grids.nrrd import write_nrrd
from clrecon.reading.grids.reader import open_grid
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.files import StagedFile, stage_file
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress

SAME_PLACE_MM = 1e-3
"""Largest distance of a voxel from its place when the header is read back; NIfTI keeps its affine in float32."""


@dataclass(frozen=True)
class VolumeFormat:
    """A format of volumes: its `tell_kind`, the library that writes it, whether axes may lie at any angle."""

    kind: str
    module: str
    holds_shear: bool
    write: Callable[[BinaryIO, VolumeContent], None]


FORMATS = {
    ".nii.gz": VolumeFormat("NIfTI", "nibabel", True, partial(write_nifti, packed=True)),
    ".nii": VolumeFormat("NIfTI", "nibabel", True, partial(write_nifti, packed=False)),
    ".nrrd": VolumeFormat("NRRD", "nrrd", True, write_nrrd),
    ".mha": VolumeFormat("MetaImage", "SimpleITK", False, write_metaimage),
}


def check_volume_format(path: str | os.PathLike[str]) -> str:
    """Return the extension of a volume file in lower case, such as ``.nii.gz``."""
    try:
        name = os.path.basename(os.fspath(path)).lower()
    except TypeError as error:
        raise UsageError(f"a volume file is named by a string or a path, not {type(path).__name__}") from error
    for extension, chosen in FORMATS.items():
        if name.endswith(extension) and name != extension:
            import_extra(chosen.module, VOLUME)
            return extension
    raise UsageError(f"the name of the volume file is {name[-40:]!r}: it ends with one of {', '.join(FORMATS)}")


@explains_arguments
def write_volume(
    volume: Volume,
    path: str | os.PathLike[str],
    *,
    resample: float | None = None,
    keep_ids: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write a volume to a file, as a whole or not at all.

    Parameters
    ----------
    volume : Volume
    path : path
        .nii.gz, .nii (NIfTI-1; RAS mm, as that format has it), .nrrd or .mha (LPS mm).
    resample : float, optional
        Resample (trilinear) to a regular grid with this step in mm along all axes, see
        ``clrecon.geometry.resample.resample_volume``.  Without it voxels stay as they are.
    keep_ids : bool
        Write the hash of the frame of reference with the certificate.
    progress : callable, optional
        ``progress("write", done, total)`` in slices.

    Returns
    -------
    int
        Size of the file in bytes.

    Raises
    ------
    UsageError
        The extension is unknown, a package is missing, or the format cannot hold the volume as it is: uneven slices, in
        .mha also sheared axes.
    OutputError
        The file cannot be written; an older one is intact.
    """
    check_volume_format(path)
    if resample is not None and isinstance(volume, Volume):
        volume = resample_volume(volume, resample, progress=progress)
    with stage_volume(volume, path, keep_ids=keep_ids, progress=progress) as staged:
        staged.commit()
    return staged.size


def stage_volume(
    volume: Volume, path: str | os.PathLike[str], *, keep_ids: bool = False, progress: Progress | None = None
) -> AbstractContextManager[StagedFile]:
    """Write a volume under a temporary name, to be committed with other files; see `write_volume` and `stage_file`."""
    if not isinstance(volume, Volume):
        raise UsageError(f"a volume is written, not {type(volume).__name__}")
    extension = check_volume_format(path)
    chosen = FORMATS[extension]
    check_holds(volume, extension)
    content = VolumeContent(
        stored_values(volume.voxels, volume.hu_range),
        volume.affine,
        certificate_lines(volume.report, keep_ids=keep_ids),
        progress or ignore_progress,
    )
    packed = extension in (".nii.gz", ".nrrd")
    return stage_file(
        path,
        lambda stream: chosen.write(stream, content),
        lambda temporary: _verify_file(temporary, chosen.kind, content),
        expected_bytes=0 if packed else content.voxels.nbytes,
    )


def stored_values(voxels: NDArray[Any], limits: tuple[float, float] | None) -> NDArray[Any]:
    """Return voxels in the type in which they are written: int16 or int32 for whole numbers, else float32."""
    if voxels.dtype.kind == "f":
        return voxels
    low, high = limits or (0.0, 0.0)
    short = np.iinfo(np.int16)
    return voxels.astype(np.int16 if short.min <= low and high <= short.max else np.int32, copy=False)


def describe_shear(volume: Volume) -> str | None:
    """Return the warning about a volume whose axes lie at other than right angles, None for others."""
    shear = shear_degrees(volume.affine)
    if shear <= LARGEST_SHEAR_DEGREES:
        return None
    return (
        f"the axes are sheared by {shear:.2f} degrees (gantry tilt) and written so: each voxel is at its place, but"
        " programs that use ITK refuse a sheared NIfTI, and others may leave the shear out;"
        f" {name_parameter('resample', 'MM')} makes right angles"
    )


def check_holds(volume: Volume, extension: str) -> None:
    shear = shear_degrees(volume.affine)
    if volume.uneven:
        fault = f"no {extension} file can hold it: {describe_unevenness(volume.slice_origins())}"
    elif shear > LARGEST_SHEAR_DEGREES and not FORMATS[extension].holds_shear:
        fault = f"{extension} has axes at right angles, and this volume is sheared by {shear:.2f} degrees"
        fault += " (.nii.gz and .nrrd hold that)"
    elif FORMATS[extension].kind == "NIfTI":
        off = _measure_apart(volume.affine.astype(np.float32), volume.affine, volume.voxels.shape)
        if off > SAME_PLACE_MM:
            raise UsageError(
                f"{extension} has places in numbers of single precision, which are up to {off:.2g} mm off so far from"
                " the origin; .nrrd and .mha hold them"
            )
        return
    else:
        return
    raise UsageError(f"{fault}; resample it to a regular grid ({name_parameter('resample', 'MM')})")


def _verify_file(path: Path, kind: str, content: VolumeContent) -> None:
    grid = open_grid(path, kind, VOLUME)
    off = _measure_apart(grid.affine, content.affine, content.voxels.shape)
    if grid.shape_ijk != content.voxels.shape[::-1] or off > SAME_PLACE_MM or grid.scaled:
        raise OutputError("the volume file was not written rightly: its header reads back otherwise")


def _measure_apart(affine: NDArray[Any], second: NDArray[np.float64], shape: tuple[int, ...]) -> float:
    """Return how far, along an axis, the first or last voxel of a shape (nk, nj, ni) lies from its place in another."""
    last = np.array([*shape[::-1], 1.0]) - (1.0, 1.0, 1.0, 0.0)
    return max(float(np.abs((affine - second) @ end).max()) for end in (np.array([0.0, 0.0, 0.0, 1.0]), last))
