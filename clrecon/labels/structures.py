"""DICOM RT Structure Set (RTSTRUCT): contours in mm, rasterised on the slices of the scan they were drawn on.

Source: DICOM PS3.3 C.8.8.5 (Structure Set) and C.8.8.6 (ROI Contour).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.headers.multiframe import find_data_set
from clrecon.dicom.parse.sequences import Item, Schema, read_sequences
from clrecon.dicom.parse.values import ValueProblem
from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.geometry.affine import slice_normal
from clrecon.geometry.volume import Volume
from clrecon.labels.contours import fill_contours
from clrecon.labels.fine_slices import label_slices
from clrecon.labels.label_map import LabelMap
from clrecon.labels.names import find_number
from clrecon.labels.overlap import Painter
from clrecon.labels.stream import empty_labels
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.regular_files import open_regular
from clrecon.system.text import count_of, escape_text, hash_uid

__all__ = ["STRUCTURE_SET", "read_structures"]

STRUCTURE_SET = "1.2.840.10008.5.1.4.1.1.481.3"
IMPLICIT_LITTLE, EXPLICIT_LITTLE = "1.2.840.10008.1.2", "1.2.840.10008.1.2.1"
LARGEST_BYTES = 2**30
MOST_CONTOURS = 1_000_000

ON_SLICE_MM = 0.1
"""Largest distance of a contour's points from their slice; writers round to 0.01 mm."""

NAMES_SHOWN = 5

_CLOSED = ("CLOSED_PLANAR", "CLOSED_PLANAR_XOR", "CLOSEDPLANAR_XOR")
_CHARACTERS, _ROIS, _CONTOURS_OF = 0x00080005, 0x30060020, 0x30060039
_NUMBER, _FRAME, _NAME = 0x30060022, 0x30060024, 0x30060026
_OWNER, _CONTOURS = 0x30060084, 0x30060040
_TYPE, _COUNT, _DATA = 0x30060042, 0x30060046, 0x30060050
_SCHEMA: Schema = {
    _CHARACTERS: None,
    _ROIS: {_NUMBER: None, _FRAME: None, _NAME: None},
    _CONTOURS_OF: {_OWNER: None, _CONTOURS: {_TYPE: None, _COUNT: None, _DATA: None}},
}


@dataclass
class _Structure:
    """One ROI: its name, the hash of its frame of reference, and its contours as they stand in the file."""

    name: str
    frame_hash: str | None
    contours: list[bytes] = field(default_factory=list)
    others: dict[str, int] = field(default_factory=dict)
    counts: list[int | None] = field(default_factory=list)


def read_structures(
    path: Path,
    volume: Volume | None,
    only: tuple[str | int, ...] | None = None,
    progress: Progress = ignore_progress,
) -> LabelMap:
    """Read the ROIs of an RTSTRUCT as labels on the slices of its scan.

    A voxel has the label of an ROI where its centre is inside of the closed contours of its slice (even-odd: a contour
    within another is a hole).  The label's number is the ROI's.  Of an uneven scan the map has thinner slices, see
    `clrecon.labels.fine_slices`.

    Parameters
    ----------
    path : Path
    volume : Volume or None
        The scan.
    only : tuple of str or int, optional
        The ROIs that are wanted; only the others may overlap, and only the wanted ones have to fit the scan.
    progress : callable
        Called as ``progress("read", ROIs done, all ROIs)``.

    Raises
    ------
    UsageError
        There is no scan, its slices are too uneven, or a wanted ROI does not exist.
    RefusedInputError
        The file is corrupt, a contour lies between the slices or is not parallel to them, the ROI has another frame of
        reference than the scan, or ROIs overlap.
    """
    name = escape_text(path.name)
    if volume is None:
        raise UsageError(f"{name} is an RTSTRUCT: its contours need the scan they were drawn on, give its volume too")
    grid = label_slices(volume)
    structures = _parse(path, name)
    names = {number: one.name for number, one in structures.items()}
    shown = {number: text or f"label_{number}" for number, text in names.items()}
    wanted = set(structures) if only is None else {find_number(label, shown, structures) for label in only}
    warnings: list[str] = []
    _check_frames(name, {number: structures[number] for number in wanted}, volume)
    ni, nj, _ = volume.shape_ijk
    voxels = empty_labels(name, (len(grid.nearest), nj, ni))
    painter = Painter(name, voxels, names, only)
    for done, number in enumerate(painter.order):
        found = _Raster(name, structures[number], shown[number], volume)
        if number in wanted:
            found.refuse_misplaced()
            warnings += found.describe()
        for k, contours in sorted(found.slices.items()):
            mask = fill_contours(contours, (nj, ni))
            for place in np.flatnonzero(grid.nearest == k):
                painter.paint(int(place), number, mask)
        progress("read", done + 1, len(painter.order))
    frame = volume.report.get("frame_of_reference_hash")
    return painter.finish(grid.affine, frame_of_reference_hash=frame, warnings=warnings)


def _check_frames(name: str, structures: dict[int, _Structure], volume: Volume) -> None:
    """Refuse ROIs of another frame of reference than the scan's; where one of both is not said, nothing is known.

    Raises
    ------
    RefusedInputError
    """
    ours = volume.report.get("frame_of_reference_hash")
    strange = [one for one in structures.values() if ours and one.frame_hash and one.frame_hash != ours]
    if strange:
        raise RefusedInputError(
            f"{len(strange)} of {len(structures)} ROIs of {name} belong to frame of reference {strange[0].frame_hash},"
            f" the CT to {ours} (hashes): the scanner does not vouch that they lie together; choose the RTSTRUCT of"
            " this series"
        )


class _Raster:
    """The contours of one ROI on the slices of a scan.

    Attributes
    ----------
    slices : dict of int to list of ndarray (n, 2)
        Corners (i, j) of the contours of each slice.
    """

    def __init__(self, file: str, structure: _Structure, shown: str, volume: Volume):
        self._file, self._structure = file, structure
        self._shown = f"ROI {escape_text(shown, 60)}"
        self.slices: dict[int, list[NDArray[np.float64]]] = {}
        self._beyond = self._misplaced = 0
        self._off_mm = 0.0
        normal = slice_normal(volume.affine)
        heights = volume.slice_origins() @ normal
        for value, count in zip(structure.contours, structure.counts, strict=True):
            points = _points_of(value, count, file, self._shown)
            ijk = volume.lps_to_ijk(points)
            k = int(np.rint(ijk[:, 2].mean()))
            if not 0 <= k < len(heights):
                self._beyond += 1
                continue
            off = float(np.abs(points @ normal - heights[k]).max())
            if off > ON_SLICE_MM:
                self._misplaced += 1
                self._off_mm = max(self._off_mm, off)
            self.slices.setdefault(k, []).append(ijk[:, :2])

    def refuse_misplaced(self) -> None:
        """Refuse an ROI whose contours do not lie on the slices.

        Raises
        ------
        RefusedInputError
        """
        if self._misplaced:
            raise RefusedInputError(
                f"{self._file}: {self._misplaced} of {len(self._structure.contours)} contours of {self._shown} lie"
                f" between the slices of the scan, or not parallel to them (up to {self._off_mm:.2f} mm off): they were"
                " drawn on another series, choose that one"
            )

    def describe(self) -> list[str]:
        """Return warnings about what is not in the label map."""
        said = []
        if self._structure.others:
            kinds = ", ".join(f"{count} {escape_text(kind, 30)}" for kind, count in self._structure.others.items())
            said.append(f"{self._shown}: {kinds} left out, only closed planar contours enclose voxels")
        if self._beyond:
            said.append(f"{self._shown}: {count_of(self._beyond, 'contour')} beyond the slices of the scan left out")
        if not self._structure.contours:
            said.append(f"{self._shown} has no closed contour and no voxel")
        elif self.slices:
            span = max(self.slices) - min(self.slices) + 1
            if span > len(self.slices):
                said.append(
                    f"{self._shown}: {span - len(self.slices)} of {span} slices from its first to its last have no"
                    " contour and stay empty"
                )
        return said


def _points_of(value: bytes, count: int | None, file: str, shown: str) -> NDArray[np.float64]:
    """Return the points (n, 3) of a contour, LPS mm.

    Raises
    ------
    RefusedInputError
        They are no numbers, not three for each point, fewer than three points, or not as many as the file says.
    """
    try:
        numbers = np.array([float(word) for word in value.rstrip(b" \0").split(b"\\")])
    except ValueError:
        numbers = np.array([np.nan])
    points = len(numbers) // 3
    if not np.isfinite(numbers).all() or len(numbers) % 3 or points < 3 or (count is not None and count != points):
        raise RefusedInputError(
            f"{file} is corrupt: a contour of {shown} has {len(numbers)} numbers"
            f"{'' if count is None else f' for {count} points'}, three finite ones each are needed, and three points"
        )
    return numbers.reshape(-1, 3)


def _parse(path: Path, name: str) -> dict[int, _Structure]:
    """Return the ROIs by their numbers.

    Raises
    ------
    RefusedInputError
        The file is corrupt or compressed, or has no ROI.
    """
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
            items_limit=MOST_CONTOURS,
        )
        return _collect(top, name)
    except ValueProblem as problem:
        raise RefusedInputError(f"{name} is a corrupt DICOM file: {problem}") from problem
    except ClreconError:
        raise
    except Exception as error:  # pydicom raises many error types for corrupt values
        raise RefusedInputError(f"{name} is no usable RTSTRUCT: {type(error).__name__}") from error


def _collect(top: Item, name: str) -> dict[int, _Structure]:
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
        _take(structures[number], item.sequences.get(_CONTOURS, ()), name)
    return _from_one(structures)


def _from_one(structures: dict[int, _Structure]) -> dict[int, _Structure]:
    """Return ROIs under numbers that labels can have: their own, or from 1 on where one of them is 0."""
    if 0 not in structures:
        return structures
    return dict(enumerate(structures.values(), start=1))


def _take(structure: _Structure, contours: Iterable[Item], name: str) -> None:
    for item in contours:
        kind = item.values.get(_TYPE, b"").decode("ascii", "replace").strip(" \0").upper() or "contours of no type"
        if kind in _CLOSED:
            count = item.values.get(_COUNT)
            structure.contours.append(item.values.get(_DATA, b""))
            structure.counts.append(None if count is None else _whole(count, name))
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
