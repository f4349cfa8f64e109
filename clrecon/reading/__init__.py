"""`read_volume` and `list_series` for every kind of input, told from its content, not its name."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from clrecon.errors import RefusedInputError, UsageError
from clrecon.reading.common.selection import Selection, check_rescale, check_voxel_size
from clrecon.reading.sources import Source, opened
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import escape_text

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.reading.common.source_facts import SeriesListing

_OTHER_FORMATS = ("NIfTI", "NRRD", "MetaImage", "OME-Zarr")
_NAMES = (".nii", ".nii.gz", ".hdr", ".img", ".img.gz", ".nrrd", ".nhdr", ".mha", ".mhd", ".zarr")
"""File extensions of these formats, only for messages."""
_ZARR_METADATA = ("zarr.json", ".zgroup", ".zarray", ".zattrs")
"""Files in a folder of Zarr, version 3 or 2."""


def read_selected(path: Source, selection: Selection, *, progress: Progress | None = None) -> Volume:
    """Read the part of an input that a selection names, see `read_volume`."""
    rescale, voxel_size = check_rescale(selection.rescale), check_voxel_size(selection.voxel_size)
    with opened(path, progress or ignore_progress) as inside:
        kind = tell_format(inside)
        _refuse_options(kind, selection)
        if kind is None:
            from clrecon.reading.dicom.reader import read_series

            return read_series(inside, selection, progress)
        from clrecon.reading.grids import read_grid

        return read_grid(Path(inside), kind, rescale=rescale, voxel_size=voxel_size, progress=progress)


def list_selected(
    path: Source, selection: Selection, *, pixels: bool = False, progress: Progress | None = None
) -> SeriesListing:
    """List an input, with the certificate of the part that a selection names, see `list_series`."""
    rescale, voxel_size = check_rescale(selection.rescale), check_voxel_size(selection.voxel_size)
    with opened(path, progress or ignore_progress) as inside:
        kind = tell_format(inside)
        _refuse_options(kind, selection)
        if kind is None:
            from clrecon.reading.dicom.reader import list_scan

            return list_scan(inside, selection, pixels=pixels, progress=progress)
        from clrecon.reading.grids import list_grid

        return list_grid(Path(inside), kind, rescale=rescale, voxel_size=voxel_size, pixels=pixels, progress=progress)


@explains_arguments
def read_volume(
    path: str | os.PathLike[str] | bytes | Sequence[bytes],
    series: int | str | None = None,
    *,
    phase: int | None = None,
    allow_gaps: bool = False,
    force: bool = False,
    follow_links: bool = False,
    rescale: tuple[float, float] | None = None,
    voxel_size: tuple[float, float, float] | None = None,
    progress: Progress | None = None,
) -> Volume:
    """Read a volume in HU and LPS mm, from DICOM, NIfTI, NRRD, MetaImage or OME-Zarr.

    Parameters
    ----------
    path : str, path-like, bytes or sequence of bytes
        A folder of DICOM files, searched with its subfolders; one DICOM file; or a file with a grid and its affine:
        NIfTI (.nii, .nii.gz, .hdr with .img), NRRD (.nrrd, .nhdr), MetaImage (.mha, .mhd), which needs the
        package SimpleITK; a folder of OME-Zarr, which needs zarr; or a zip or tar file of these.  Told from the
        content.  A text such as
        ``dicomweb+https://HOST/studies/UID/series/UID`` or ``s3://bucket/folder/`` is a URL; bytes are the content of
        one file, or of several, such as the instances of a series.
    series : int or str, optional
        Which series of a DICOM folder: its number in the listing (from 1), SeriesInstanceUID, its hash, the start of
        one of these, or description.  Default: the CT series with most slices; of those with a similar number original
        images come before derived ones, then the thinnest slices.  The warnings name the others and the reason.
    phase : int, optional
        Number of the phase, where a series holds several volumes at the same places (`list_series` lists them).
    allow_gaps : bool
        True: read a stack with missing slices; the existing slices are placed exactly, with a warning.
    force : bool
        True: also read data sets without preamble or meta header, with a guessed encoding, and ignore surplus bytes
        after the pixels; each gives a warning.
    follow_links : bool
        True: also read the files and folders that symbolic links out of the folder lead to, as in a git-annex or
        DataLad repository.  False: a series beside which such links stand is refused, because they may be its slices.
    rescale : (slope, intercept), optional
        Values are ``slope * stored + intercept``, regardless of the files: where a header lacks the rescale, is wrong
        about it, or a scanner has a scale of its own.  The certificate says that it was given.
    voxel_size : (i, j, k), optional
        mm between voxels, i along the last axis of the array: for Zarr whose metadata lack a scale or a unit, and for a
        Zarr array without metadata.
    progress : callable, optional
        Called as ``progress(stage, done, total)`` with stage "scan" or "read", or "no answer yet from NAME" where the
        disk hangs.

    Returns
    -------
    Volume
        ``voxels`` (nk, nj, ni) int16, int32 or float32; ``affine`` index (i, j, k) to LPS mm; ``report`` the
        certificate.  Unevenly spaced slices keep their own positions (``Volume.uneven``). For files other than DICOM
        the values are those of the file (with its slope and intercept): whole numbers of any stored type become int16
        or int32, others float32, NaN -1024.

    Raises
    ------
    NoDicomError
        There is nothing at the path, no DICOM, or no CT.
    RefusedInputError
        Files are corrupt, or geometry or values cannot be trusted; the message names files and figures.
    UsageError
        ``series`` matches no series or several; the ``phase`` does not exist; an option for DICOM is given with another
        format; a package is missing; ``path`` is empty; or a URL is wrong or wants other credentials.
    UnreachableError
        The server of a URL does not answer, or fails.
    """
    chosen = Selection(
        series=series, phase=phase, allow_gaps=allow_gaps, force=force, follow_links=follow_links, rescale=rescale,
        voxel_size=voxel_size,
    )  # fmt: skip
    return read_selected(path, chosen, progress=progress)


@explains_arguments
def list_series(
    path: str | os.PathLike[str] | bytes | Sequence[bytes],
    series: int | str | None = None,
    *,
    phase: int | None = None,
    allow_gaps: bool = False,
    force: bool = False,
    follow_links: bool = False,
    rescale: tuple[float, float] | None = None,
    voxel_size: tuple[float, float, float] | None = None,
    pixels: bool = False,
    progress: Progress | None = None,
) -> SeriesListing:
    """List everything at a path that `read_volume` can read, with the certificate of the part that it would read.

    Parameters
    ----------
    path, series, phase, allow_gaps, force, follow_links, rescale, voxel_size, progress
        As in `read_volume`.
    pixels : bool
        True: also read the voxels, for entries that depend on them.  False: read only headers.

    Returns
    -------
    SeriesListing
        One entry for a file other than DICOM.

    Raises
    ------
    NoDicomError, RefusedInputError, UsageError
        There is nothing to list; all DICOM files, or a file of another format, are corrupt; ``series`` or ``phase``
        names nothing or several; a package is missing; or an option for DICOM is given with another format.
    UnreachableError
        As in `read_volume`.
    """
    chosen = Selection(
        series=series, phase=phase, allow_gaps=allow_gaps, force=force, follow_links=follow_links, rescale=rescale,
        voxel_size=voxel_size,
    )  # fmt: skip
    return list_selected(path, chosen, pixels=pixels, progress=progress)


def _refuse_options(kind: str | None, selection: Selection) -> None:
    """Refuse what only DICOM has, all but the rescale, or only Zarr, the size of a voxel."""
    if selection.voxel_size is not None and kind != "OME-Zarr":
        name = name_parameter("voxel_size", "I,J,K")
        raise UsageError(f"{name} is for Zarr, and files of other formats say how far apart voxels are: leave it out")
    options = {field.name: getattr(selection, field.name) for field in fields(Selection)}
    given = [
        name
        for name, value in options.items()
        if name not in ("rescale", "voxel_size") and value is not None and value is not False
    ]
    if kind is not None and given:
        raise UsageError(f"{' and '.join(given)}: only for DICOM, and the input is {kind}")


def tell_format(path: str | os.PathLike[str]) -> str | None:
    """Return the format of an input other than DICOM; None leaves the input and its errors to the DICOM reader."""
    try:
        file = Path(path)
        is_given, is_file = bool(os.fspath(path).strip()), file.is_file()
        kind = None
        if is_given and is_file:
            from clrecon.reading.grids import tell_kind  # which a folder does not need

            kind = tell_kind(file)
        elif is_given and any((file / name).exists() for name in _ZARR_METADATA):
            kind = "OME-Zarr"
        name = file.name.lower()
        is_named = name.endswith(_NAMES) if is_file else name.endswith(".zarr") and file.is_dir()
    except (TypeError, ValueError, OSError):
        return None
    if kind in _OTHER_FORMATS:
        return kind
    if kind is None and is_named:
        pair = "; of a NIfTI pair give the .hdr" if name.endswith((".img", ".img.gz")) else ""
        raise RefusedInputError(
            f"{escape_text(file.name)} is no NIfTI, NRRD, MetaImage or OME-Zarr file, despite its name{pair}"
        )
    return None
