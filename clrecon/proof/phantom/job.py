"""The job that writes a phantom series."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress


def describe_kinds() -> dict[str, str]:
    """Return the name of each kind of phantom, and its description."""
    from clrecon.proof.phantom import KINDS

    return {name: kind.said for name, kind in KINDS.items()}


def make_phantom(
    output: str | Path, *, no_clobber: bool = False, progress: Progress | None = None, **settings: Any
) -> dict[str, Any]:
    """Write a phantom CT series with its truth.

    output: Folder for the DICOM files, ``truth.json`` and, of a scene, ``materials.nrrd``, or of chosen levels
        ``levels.nrrd``.
    no_clobber: A folder that holds anything stays and is an `OutputError`. **settings: Fields of
        `clrecon.proof.phantom.PhantomSettings`; those that are None keep their default.  ``size`` may be a text like
        ``"256x192"`` (columns x rows), ``missing`` one like ``"20-22,40"``.

    Returns: The truth, as in ``truth.json``.
    """
    from clrecon.proof.phantom import PhantomSettings, parse_missing, parse_size, write_phantom

    given = {name: value for name, value in settings.items() if value is not None}
    if isinstance(given.get("size"), str):
        given["size"] = parse_size(given["size"])
    if isinstance(given.get("missing"), str):
        given["missing"] = parse_missing(given["missing"])
    with keep_existing(no_clobber):
        return write_phantom(output, PhantomSettings(**given), progress=progress)
