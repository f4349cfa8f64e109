"""What of a folder a view can show: its series and files, each with a thumbnail and words whether it can be read."""

from __future__ import annotations

import io
import os
import tempfile
from base64 import b64encode
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import ClreconError, UsageError
from clrecon.exchange.formats import MESH_INPUTS
from clrecon.geometry import Volume
from clrecon.jobs.inputs import is_cloud_file
from clrecon.reading import list_selected, read_selected, tell_format
from clrecon.reading.archives import is_archive, unpacked
from clrecon.reading.common.selection import Selection
from clrecon.reading.common.source_facts import SeriesEntry
from clrecon.reading.dicom.reader import list_slices
from clrecon.rendering.looks.window import WINDOWS
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress
from clrecon.system.text import count_of, escape_text
from clrecon.viewer.model.saved_view import VIEW_FORMAT

_THUMBNAIL = 160
"""Pixels of the longer side."""

_LEAST_SPREAD, _ENDS = 0.1, (0.5, 99.5)
"""Share of the window that lies between these percentiles of a thumbnail; below it they are its window."""

_LARGEST_GRID = 256 << 20
"""Bytes of a file with a grid that is read for its thumbnail."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One thing that can be opened, or the reason why it cannot.

    path: Input of the view; `selection` says which part of it.
    title, words: What it is.
    verdict: What may be wrong with it; `is_refused` where it cannot be opened.
    button: What opening it does; empty where it cannot be opened.
    thumbnail: Address of a picture with its data; empty: none.
    """

    path: Path
    title: str
    words: str
    selection: Selection = Selection()
    verdict: str = ""
    is_refused: bool = False
    button: str = "Open"
    thumbnail: str = ""

    def describe(self) -> dict[str, Any]:
        names = ("title", "words", "verdict", "is_refused", "button", "thumbnail")
        return {name: getattr(self, name) for name in names}


def find_choices(folder: Path, archives: ExitStack, progress: Progress) -> list[Choice]:
    """List what can be opened in a folder: series, other scans, meshes; archives stay unpacked in `archives`."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    roots, meshes = [folder], [path for path in files if _is_mesh(path)]
    choices = []
    for path in files:
        if path not in meshes and is_archive(path):
            try:
                roots.append(Path(archives.enter_context(unpacked(path, progress))))
            except ClreconError as error:
                choices.append(_refuse_file(path, error))
    for root in roots:
        choices += _list_series(root, progress)
    grids = [path for path in (*files, *roots[1:]) if path not in meshes and _is_grid(path)]
    choices += [_describe_grid(path, progress) for path in grids]  # an archive of one file stands for it
    choices += [_describe_file(path) for path in meshes]
    return sorted(choices, key=lambda choice: choice.is_refused)


def find_saved_view(folder: Path) -> Path | None:
    """Return the saved view that lies in a folder, if there is one alone."""
    saved = [path for path in folder.rglob(f"*{VIEW_FORMAT}") if path.is_file()]
    return saved[0] if len(saved) == 1 else None


def _describe_file(path: Path) -> Choice:
    size = path.stat().st_size / 1e6
    return Choice(path=path, title=escape_text(path.name, 80), words=f"mesh or point cloud, {size:.1f} MB")


def _describe_grid(path: Path, progress: Progress) -> Choice:
    title, size = escape_text(path.name, 80), path.stat().st_size
    try:
        (entry,) = list_selected(path, Selection(), progress=progress).series
        picture = ""
        if size <= _LARGEST_GRID:
            picture = draw_thumbnail(read_selected(path, Selection(), progress=progress))
        return Choice(path=path, title=title, words=_say_grid(entry), verdict=_say_doubts(entry), thumbnail=picture)
    except ClreconError as error:
        return _refuse_file(path, error)


def _is_mesh(path: Path) -> bool:
    """Tell whether the name of a file is that of a mesh or cloud; a text beside a scan is more likely one to read."""
    suffix = path.suffix.lower()
    return suffix in MESH_INPUTS or (suffix != ".txt" and is_cloud_file(path))


def _is_grid(path: Path) -> bool:
    """Tell whether a file is no DICOM: its name or its content says so, and describing it whether it can be read."""
    try:
        return tell_format(path) is not None
    except ClreconError:
        return True


def _refuse_file(path: Path, error: ClreconError) -> Choice:
    title = escape_text(path.name, 80)
    return Choice(path=path, title=title, words="", verdict=str(error), is_refused=True, button="")


def _list_series(root: Path, progress: Progress) -> Iterator[Choice]:
    """Give a choice for each DICOM series; a folder without DICOM has none."""
    if _is_grid(root):
        return
    try:
        listing = list_selected(root, Selection(), progress=progress)
    except ClreconError:  # what is no DICOM has a choice of its own, or is counted as left out
        return
    for entry in sorted(listing.series, key=lambda entry: (entry.modality != "CT", -entry.slices)):
        yield _describe_series(root, entry, progress)


def _describe_series(root: Path, entry: SeriesEntry, progress: Progress) -> Choice:
    title = f"{escape_text(entry.description, 80) or f'series {entry.number}'} · {entry.modality}"
    selection, verdict = Selection(series=entry.number), _say_doubts(entry)
    button = "Open"
    if entry.kind != "stack":
        words = f"{entry.kind}, {count_of(entry.slices, 'picture')}"
        return Choice(path=root, title=title, words=words, verdict="no volume", is_refused=True, button="")
    if entry.problems:
        verdict, button = entry.problems[0], ""
        bridged = Selection(series=entry.number, allow_gaps=True)
        relisted = list_selected(root, bridged, progress=progress).series
        if not next(each for each in relisted if each.number == entry.number).problems:
            selection, button = bridged, "Open with gaps"
    return Choice(
        path=root, title=title, words=_say_grid(entry), selection=selection, verdict=verdict,
        is_refused=not button, button=button, thumbnail=_draw_series(root, selection, progress) if button else "",
    )  # fmt: skip


def _say_grid(entry: SeriesEntry) -> str:
    words = [count_of(entry.slices, "slice")]
    if entry.shape_ijk is not None:
        words.append(f"{entry.shape_ijk[0]} × {entry.shape_ijk[1]}")
    if entry.spacing_mm is not None:
        words.append(f"{' × '.join(f'{mm:.3g}' for mm in entry.spacing_mm)} mm")
    return " · ".join(words)


def _say_doubts(entry: SeriesEntry) -> str:
    return entry.warnings[0] if entry.warnings else ""


def _draw_series(root: Path, selection: Selection, progress: Progress) -> str:
    """Return the thumbnail of a series: two slices in its middle are read, or all where one file has several."""
    try:
        slices = list_slices(root, selection)
        if any(frames > 1 for _, _, frames in slices):
            return draw_thumbnail(read_selected(root, selection, progress=progress))
        middle = max(0, len(slices) // 2 - 1)
        with tempfile.TemporaryDirectory(prefix="clrecon-") as folder:
            for number, (path, _, _) in enumerate(slices[middle : middle + 2]):
                os.symlink(path.resolve(), Path(folder) / f"{number}.dcm")
            pair = Selection(allow_gaps=True, force=selection.force, follow_links=True)
            return draw_thumbnail(read_selected(folder, pair, progress=progress))
    except (ClreconError, OSError):  # two slices alone may be refused where all are not: the choice has no picture
        return ""


def draw_thumbnail(volume: Volume) -> str:
    """Return a slice of a volume in the window of soft tissue, or of labels, as an address with its data.

    The middle one, or if that has one value the one of widest range.  A flat slice is shown in a window of its own.
    """
    load_pillow()
    from PIL import Image

    low, high = WINDOWS["soft"]
    if volume.voxels.min() >= 0:  # labels, or no HU
        low, high = 0.0, max(1.0, float(volume.voxels.max()))
    layer = volume.voxels[volume.shape_ijk[2] // 2]
    if layer.min() == layer.max():
        layer = max(volume.voxels, key=np.ptp)
    layer = np.nan_to_num(layer.astype(np.float64), nan=low, posinf=high, neginf=low)
    if np.ptp(np.percentile(layer.clip(low, high), _ENDS)) < _LEAST_SPREAD * (high - low):
        low, high = np.percentile(layer, _ENDS)
        if low == high:
            low, high = layer.min() - 1.0, layer.max() + 1.0
    grey = np.clip((layer - low) * (255.0 / (high - low)), 0.0, 255.0).astype(np.uint8)
    mm = np.linalg.norm(volume.affine[:3, :2], axis=0) * volume.shape_ijk[:2]
    size = np.maximum(1, np.rint(_THUMBNAIL * mm / mm.max())).astype(int)
    return to_address(Image.fromarray(grey).resize((int(size[0]), int(size[1]))))


def to_address(image: Any) -> str:
    """Return a picture of Pillow as an address with its data."""
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=75, optimize=True)
    return "data:image/jpeg;base64," + b64encode(stream.getvalue()).decode("ascii")


def checked_choice(choices: list[Choice], number: Any) -> Choice:
    """Return the choice of a number, from 0, that can be opened."""
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(choices):
        raise UsageError(f"there is no choice {number!r:.40}: there are {len(choices)}, numbered from 0")
    if choices[number].is_refused:
        raise UsageError(f"{choices[number].title} cannot be opened: {choices[number].verdict}")
    return choices[number]
