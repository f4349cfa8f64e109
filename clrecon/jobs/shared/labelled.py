"""The scan of a job and its label map, in the order that finds a wrong file soonest."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap


def read_with_labels(
    read_scan: Callable[[], Volume], path: str | Path | None, read_map: Callable[[Volume | None], LabelMap | None]
) -> tuple[Volume, LabelMap | None]:
    """Read the labels, then the scan; but labels that take long to unpack after it, to be held against its grid.

    path: File of the labels.
    read_map: Reads the labels; gets the scan if it was read first.
    """
    if path is None:
        return read_scan(), None
    from clrecon.labels.reader import is_large_map

    if is_large_map(path):
        volume = read_scan()
        return volume, read_map(volume)
    labels = read_map(None)
    return read_scan(), labels
