"""The files of a vertebrae job: formats of the label map, the name of the picture, checks before any work."""

from __future__ import annotations

import os
from pathlib import Path

from clrecon.errors import UsageError
from clrecon.jobs.shared.outputs import check_distinct, check_kept

NIFTI, SEGMENTATION = ("nii", "nii.gz"), ("dcm",)


def map_format(path: str | Path) -> str:
    """Return ``nii``, ``nii.gz`` or ``dcm``."""
    name = os.path.basename(os.fspath(path)).lower()
    for kind in (*NIFTI[::-1], *SEGMENTATION):
        if name.endswith(f".{kind}") and name != f".{kind}":
            return kind
    raise UsageError(f"a label map is written as .nii.gz, .nii (NIfTI) or .dcm (DICOM SEG), not {name[-40:]!r}")


def picture_beside(output: str | Path) -> str:
    """Return the name of the picture beside a label map: ``spine.nii.gz`` has ``spine.png``."""
    text = os.fspath(output)
    return text[: -len(map_format(output)) - 1] + ".png"


def check_files(
    source: str | Path, output: str | Path, picture: str | Path | None, report: str | Path | None
) -> list[tuple[str, str | Path]]:
    """Refuse outputs that cannot be written, before any work is done; return what each is, and its path."""
    from clrecon.labels.write_nifti import load_nibabel
    from clrecon.reading import tell_format
    from clrecon.rendering.pictures.pillow import load_pillow
    from clrecon.system.files import check_writable

    kind = map_format(output)
    if kind in NIFTI:
        load_nibabel()
    elif (found := tell_format(source)) is not None:
        raise UsageError(f"DICOM SEG belongs to a scan in DICOM, and this is {found}: write the label map as .nii.gz")
    if picture is not None and not os.fspath(picture).lower().endswith(".png"):
        raise UsageError(f"the picture of the discs is a .png file, not {os.path.basename(os.fspath(picture))[-40:]!r}")
    if picture is not None:
        load_pillow()
    named = (("the label map", output), ("the picture", picture), ("the report", report))
    owned = [(what, path) for what, path in named if path is not None]
    check_distinct(owned)
    for _, path in owned:
        check_writable(path)
    check_kept(owned, source)
    return list(owned)
