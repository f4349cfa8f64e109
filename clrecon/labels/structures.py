"""DICOM RT Structure Set (RTSTRUCT): contours in mm, rasterised on the slices of the scan they were drawn on.

A label map has one affine: an uneven stack gets an even grid of thin slices.  A quarter of the smallest gap gives every
voxel of the scan the label of its own slice, and a label the volume that its voxels have, half way to the neighbours.

Source: DICOM PS3.3 C.8.8.5 (Structure Set) and C.8.8.6 (ROI Contour).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, slice_normal
from clrecon.geometry.volume import Volume
from clrecon.labels.contours import fill_contours, unite_contours
from clrecon.labels.label_map import LabelMap, find_number
from clrecon.labels.segments import Painter, Wanted, empty_labels
from clrecon.reading.dicom.headers.multiframe import find_data_set
from clrecon.reading.dicom.parse.plain import EXPLICIT_LITTLE, IMPLICIT_LITTLE
from clrecon.reading.dicom.parse.values import Item, Schema, ValueProblem, read_sequences
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.paths import open_regular
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import count_of, escape_text, hash_uid

_PARTS_OF_GAP = (4.0, 2.0)
"""Slices to the smallest gap; the second where the first makes too many."""

MOST_SLICES = 4000
_MOST_ASIDE = 0.4
"""Pixels that a slice may lie off the line of all: with less than half a pixel the nearest label is its own."""


class LabelSlices(NamedTuple):
    """The slices of a label map of a scan, and for each (slices,) the slice of the scan whose labels it has."""

    affine: Float64Array
    nearest: NDArray[np.int64]


def label_slices(volume: Volume) -> LabelSlices:
    """Return the slices of a label map: those of an even scan, thinner ones of an uneven scan."""
    count = volume.shape_ijk[2]
    if not volume.uneven:
        return LabelSlices(volume.affine, np.arange(count))
    origins, normal = volume.slice_origins(), slice_normal(volume.affine)
    heights = origins @ normal
    turn = 1.0 if heights[-1] > heights[0] else -1.0
    heights = heights * turn
    gaps = np.diff(heights)
    line = (origins[-1] - origins[0]) / (heights[-1] - heights[0])  # mm per mm of height
    aside = (origins - origins[0] - (heights - heights[0])[:, None] * line) @ np.linalg.pinv(volume.affine[:3, :2]).T
    low, high = heights[0] - gaps[0] / 2.0, heights[-1] + gaps[-1] / 2.0
    step = next((gaps.min() / n for n in _PARTS_OF_GAP if (high - low) * n / gaps.min() <= MOST_SLICES), None)
    if step is None or np.abs(aside).max() > _MOST_ASIDE:
        raise UsageError(
            f"the slices of the scan are too uneven for contours: {gaps.min():.4g} to {gaps.max():.4g} mm apart, up to"
            f" {np.abs(aside).max():.2f} pixels off a line (at most {_MOST_ASIDE:g})"
        )
    places = np.arange(low + step / 2.0, high, step)
    affine = np.array(volume.affine)
    affine[:3, 2] = line * step
    affine[:3, 3] = origins[0] + (places[0] - heights[0]) * line
    return LabelSlices(affine, np.searchsorted((heights[1:] + heights[:-1]) / 2.0, places))


STRUCTURE_SET = "1.2.840.10008.5.1.4.1.1.481.3"
LARGEST_BYTES = 2**30
_MOST_CONTOURS = 1_000_000

ON_SLICE_MM, ON_SLICE_STEPS = 0.1, 0.1
"""Largest distance of a contour's points from their slice, in mm and in steps to the next slice: programs round to
0.01 mm, and some compute the positions of slices from even steps."""

_LEAST_POINTS = 3
"""Points that enclose something; rt_utils and others write contours of one and two as well."""

_ON_CENTRE = 0.01
"""Largest distance of corners from voxel centres, in voxels, at which contours run through voxel centres."""

Corners = NDArray[np.float64]
"""Corners (i, j) of a contour, shape (n, 2)."""

_XOR = ("CLOSEDPLANAR_XOR", "CLOSED_PLANAR_XOR")
_CLOSED = ("CLOSED_PLANAR", *_XOR)
_CHARACTERS, _ROIS, _CONTOURS_OF = 0x00080005, 0x30060020, 0x30060039
_NUMBER, _FRAME, _NAME = 0x30060022, 0x30060024, 0x30060026
_OWNER, _CONTOURS = 0x30060084, 0x30060040
_TYPE, _COUNT, _DATA = 0x30060042, 0x30060046, 0x30060050
_SCHEMA: Schema = {
    _CHARACTERS: None,
    _ROIS: {_NUMBER: None, _FRAME: None, _NAME: None},
    _CONTOURS_OF: {_OWNER: None, _CONTOURS: {_TYPE: None, _COUNT: None, _DATA: None}},
}


@dataclass(frozen=True)
class _Contour:
    """A closed contour as it stands in the file: its points, how many the file says they are, and its rule."""

    data: bytes
    count: int | None
    exclusive: bool


@dataclass
class _Structure:
    """One ROI: its name, the hash of its frame of reference, its closed contours, and the kinds of all others."""

    name: str
    frame_hash: str | None
    contours: list[_Contour] = field(default_factory=list)
    others: dict[str, int] = field(default_factory=dict)


def read_structures(
    path: Path, volume: Volume | None, wanted: Wanted, progress: Progress = ignore_progress
) -> LabelMap:
    """Read the ROIs of an RTSTRUCT as labels, by their numbers, on the slices of its scan, thinner ones of an uneven
    scan.

    A voxel has the label of an ROI where its centre is inside of the closed contours of its slice, see
    `clrecon.labels.contours`.  Only ROIs that are not wanted may overlap, or not fit the scan.
    """
    name = escape_text(path.name)
    if volume is None:
        raise UsageError(f"{name} is an RTSTRUCT: its contours need the scan they were drawn on, give its volume too")
    grid = label_slices(volume)
    structures = _parse_file(path, name)
    names = {number: one.name for number, one in structures.items()}
    shown = {number: text or f"label_{number}" for number, text in names.items()}
    chosen = set(structures)
    if wanted.labels is not None:
        chosen = {find_number(label, shown, structures) for label in wanted.labels}
    warnings: list[str] = []
    _check_frames(name, {number: structures[number] for number in chosen}, volume)
    ni, nj, _ = volume.shape_ijk
    voxels = empty_labels(name, (len(grid.nearest), nj, ni))
    painter = Painter(name, voxels, names, wanted)
    for done, number in enumerate(painter.order):
        raster = _Raster(name, structures[number], shown[number], volume)
        if number in chosen:
            raster.refuse_misplaced()
        for k, mask in raster.fill():
            for row in np.flatnonzero(grid.nearest == k):
                painter.paint(int(row), number, mask)
        if number in chosen:
            warnings += raster.describe()
            if wanted.labels is not None:
                raster.refuse_empty()
        progress("read", done + 1, len(painter.order))
    frame = volume.report.get("frame_of_reference_hash")
    return painter.finish(grid.affine, frame_of_reference_hash=frame, warnings=warnings)


def _check_frames(name: str, structures: dict[int, _Structure], volume: Volume) -> None:
    """Refuse ROIs of another frame of reference than the scan's; where one of both is not said, nothing is known."""
    ours = volume.report.get("frame_of_reference_hash")
    strange = [one for one in structures.values() if ours and one.frame_hash and one.frame_hash != ours]
    if strange:
        raise RefusedInputError(
            f"{len(strange)} of {len(structures)} ROIs of {name} belong to frame of reference {strange[0].frame_hash},"
            f" the CT to {ours} (hashes): it is not verified that their coordinates agree; choose the RTSTRUCT of"
            " this series"
        )


class _Raster:
    """The contours of one ROI on the slices of a scan."""

    def __init__(self, file: str, structure: _Structure, shown: str, volume: Volume):
        self._file, self._structure = file, structure
        self._shown = f"ROI {escape_text(shown, 60)}"
        self._short = self._beyond = self._misplaced = self._repeated = self._crossed = 0
        self._off_mm = 0.0
        self._voxels = 0
        self._on_centres = bool(structure.contours)
        ni, nj, _ = volume.shape_ijk
        self._shape, self._pixel_mm = (nj, ni), volume.spacing[:2]
        self._slices = self._place(volume)

    def _place(self, volume: Volume) -> dict[int, tuple[list[Corners], list[Corners]]]:
        """Return the corners of the united and of the exclusive contours of each slice."""
        slices: dict[int, tuple[list[Corners], list[Corners]]] = {}
        normal = slice_normal(volume.affine)
        heights = volume.slice_origins() @ normal
        gaps = np.abs(np.diff(volume.slice_origins(border=1) @ normal))
        allowed = np.maximum(ON_SLICE_MM, ON_SLICE_STEPS * np.minimum(gaps[1:], gaps[:-1]))
        for contour in self._structure.contours:
            points = _points_of(contour, self._file, self._shown)
            if len(points) < _LEAST_POINTS:
                self._short += 1
                continue
            ijk = volume.lps_to_ijk(points)
            k = int(np.rint(ijk[:, 2].mean()))
            if not 0 <= k < len(heights):
                self._beyond += 1
                continue
            off = float(np.abs(points @ normal - heights[k]).max())
            self._off_mm = max(self._off_mm, off)
            self._misplaced += off > allowed[k]
            corners = ijk[:, :2]
            self._on_centres &= bool(np.abs(corners - np.rint(corners)).max() <= _ON_CENTRE)
            slices.setdefault(k, ([], []))[contour.exclusive].append(corners)
        return slices

    def fill(self) -> Iterator[tuple[int, NDArray[np.bool_]]]:
        """Yield the slices that have contours, and their voxels, shape (nj, ni)."""
        for k, (united, exclusive) in sorted(self._slices.items()):
            mask = self._unite(united, exclusive)
            self._voxels += np.count_nonzero(mask)
            yield k, mask

    def _unite(self, united: list[Corners], exclusive: list[Corners]) -> NDArray[np.bool_]:
        try:
            union = unite_contours(united, self._shape, self._pixel_mm)
        except ValueError as error:
            raise RefusedInputError(
                f"{self._file}: {self._shown} has a slice that cannot be filled: {error}"
            ) from error
        self._repeated += union.repeated
        self._crossed += union.crossing > 0
        return union.inside | fill_contours(exclusive, self._shape)

    def refuse_misplaced(self) -> None:
        """Refuse an ROI whose contours do not lie on the slices."""
        if self._misplaced:
            raise RefusedInputError(
                f"{self._file}: {self._misplaced} of {len(self._structure.contours)} contours of {self._shown} lie"
                f" between the slices of the scan, or not parallel to them (up to {self._off_mm:.2f} mm off; allowed:"
                f" {ON_SLICE_MM:g} mm or a tenth of the step): they were drawn on another series, choose that one"
            )

    def refuse_empty(self) -> None:
        """Refuse an ROI without any voxel, when all of it was filled."""
        if not self._voxels:
            why = "; ".join(self.describe()) or f"{self._shown}: its contours hold no voxel centre"
            raise RefusedInputError(f"{self._file} has no voxel for the label that was chosen: {why}")

    def describe(self) -> list[str]:
        """Return warnings about what is not in the label map, and about what was decided."""
        return [f"{self._shown}{said}" for said in (*self._describe_omissions(), *self._describe_rules())]

    def _describe_omissions(self) -> list[str]:
        parts = []
        if self._structure.others:
            kinds = ", ".join(f"{count} {escape_text(kind, 30)}" for kind, count in self._structure.others.items())
            parts.append(f": {kinds} left out, only closed planar contours enclose voxels")
        if self._short:
            parts.append(f": {count_of(self._short, 'contour')} of fewer than {_LEAST_POINTS} points left out")
        if self._beyond:
            parts.append(f": {count_of(self._beyond, 'contour')} beyond the slices of the scan left out")
        if not self._structure.contours:
            parts.append(" has no closed contour and no voxel")
        elif self._slices:
            span = max(self._slices) - min(self._slices) + 1
            if span > len(self._slices):
                parts.append(
                    f": {span - len(self._slices)} of {span} slices from its first to its last have no contour and stay"
                    " empty"
                )
        return parts

    def _describe_rules(self) -> list[str]:
        parts = []
        if self._repeated:
            parts.append(f": {count_of(self._repeated, 'contour')} written twice, each counts once")
        if self._crossed:
            parts.append(f": contours cross on {count_of(self._crossed, 'slice')} and were united")
        if self._off_mm > ON_SLICE_MM:
            parts.append(f": contours lie up to {self._off_mm:.2f} mm off their slices, a tenth of the step is allowed")
        if self._slices and self._on_centres:
            parts.append(
                ": the contours run through voxel centres, as rt_utils writes them: only about half of the voxels on"
                " the outline belong to the label"
            )
        return parts


def _points_of(contour: _Contour, file: str, shown: str) -> NDArray[np.float64]:
    """Return the points (n, 3) of a contour, LPS mm."""
    words = contour.data.rstrip(b" \0")
    try:
        numbers = np.array([float(word) for word in words.split(b"\\")] if words else [])
    except ValueError:
        numbers = np.array([np.nan])
    points, count = len(numbers) // 3, contour.count
    if not np.isfinite(numbers).all() or len(numbers) % 3 or (count is not None and count != points):
        raise RefusedInputError(
            f"{file} is corrupt: a contour of {shown} has {len(numbers)} numbers"
            f"{'' if count is None else f' for {count} points'}, three finite ones each are needed"
        )
    return numbers.reshape(-1, 3)


def _parse_file(path: Path, name: str) -> dict[int, _Structure]:
    from pydicom.filereader import read_file_meta_info

    try:
        syntax = str(read_file_meta_info(path).get("TransferSyntaxUID", ""))
        if syntax not in (IMPLICIT_LITTLE, EXPLICIT_LITTLE):
            raise RefusedInputError(
                f"{name} is stored with transfer syntax {escape_text(syntax)}: of RTSTRUCT uncompressed little endian"
                " is read, convert it"
            )
        with open_regular(path) as file:
            data = file.read(LARGEST_BYTES + 1)
        if len(data) > LARGEST_BYTES:
            raise RefusedInputError(f"{name} is larger than {LARGEST_BYTES:,} bytes: no RTSTRUCT is read from it")
        top = read_sequences(
            data,
            find_data_set(data),
            _SCHEMA,
            implicit=syntax == IMPLICIT_LITTLE,
            little_endian=True,
            items_limit=_MOST_CONTOURS,
        )
        return _collect_structures(top, name)
    except ValueProblem as problem:
        raise RefusedInputError(f"{name} is a corrupt DICOM file: {problem}") from problem
    except ClreconError:
        raise
    except Exception as error:  # pydicom raises many error types for corrupt values
        raise RefusedInputError(f"{name} is no usable RTSTRUCT: {type(error).__name__}") from error


def _collect_structures(top: Item, name: str) -> dict[int, _Structure]:
    decode = _decoder(top.values.get(_CHARACTERS, b""))
    structures: dict[int, _Structure] = {}
    for item in top.sequences.get(_ROIS, ()):
        number = _whole(item.values.get(_NUMBER), name)
        if number in structures:
            raise RefusedInputError(f"{name} is corrupt: two ROIs have number {number}")
        frame = item.values.get(_FRAME, b"").decode("ascii", "replace").strip(" \0")
        structures[number] = _Structure(decode(item.values.get(_NAME, b"")), hash_uid(frame))
    if not structures:
        raise RefusedInputError(f"{name} is an RTSTRUCT without any ROI")
    for item in top.sequences.get(_CONTOURS_OF, ()):
        number = _whole(item.values.get(_OWNER), name)
        if number not in structures:
            raise RefusedInputError(f"{name} is corrupt: contours belong to ROI {number}, which it does not list")
        _take_contours(structures[number], item.sequences.get(_CONTOURS, ()), name)
    if 0 not in structures:
        return structures
    return dict(enumerate(structures.values(), start=1))  # no label has the number 0


def _take_contours(structure: _Structure, contours: Iterable[Item], name: str) -> None:
    for item in contours:
        kind = item.values.get(_TYPE, b"").decode("ascii", "replace").strip(" \0").upper() or "contours of no type"
        if kind in _CLOSED:
            count = item.values.get(_COUNT)
            number = None if count is None else _whole(count, name)
            structure.contours.append(_Contour(item.values.get(_DATA, b""), number, kind in _XOR))
        else:
            structure.others[kind] = structure.others.get(kind, 0) + 1


def _whole(value: bytes | None, name: str) -> int:
    try:
        return int((value or b"").strip(b" \0"))
    except ValueError:
        raise RefusedInputError(f"{name} is corrupt: the number of an ROI or of points is no whole number") from None


def _decoder(characters: bytes) -> Callable[[bytes], str]:
    """Return the function that turns names into text, by the character sets of the file."""
    from pydicom.charset import convert_encodings, decode_bytes

    terms = [term.strip() for term in characters.decode("ascii", "replace").rstrip(" \0").split("\\")]
    encodings = convert_encodings(terms if len(terms) > 1 else terms[0] or "ISO_IR 6")

    def decode(value: bytes) -> str:
        return str(decode_bytes(value.rstrip(b" \0"), encodings, set())).strip()

    return decode
