"""Names of files that a view saves without asking: numbered, so that nothing is replaced."""

from __future__ import annotations

from pathlib import Path

DEFAULT_MESH = "clrecon-view.stl"
DEFAULT_PICTURE = "clrecon-view.png"


def free_name(wanted: str | Path) -> Path:
    """Return a name that no file has: the wanted one, else with the first number from 2 on that is free.

    >>> free_name("bone.stl")  # bone.stl is there already
    PosixPath('bone-2.stl')

    ``bone.nii.gz`` becomes ``bone-2.nii.gz``.
    """
    path = Path(wanted)
    ends = (
        "".join(path.suffixes[-2:]) if path.name.lower().endswith((".nii.gz", ".xyz.gz", ".seg.nrrd")) else path.suffix
    )
    stem = path.name.removesuffix(ends)
    number, tried = 1, path
    while tried.exists() or tried.is_symlink():
        number += 1
        tried = path.with_name(f"{stem}-{number}{ends}")
    return tried
