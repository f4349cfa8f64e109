"""`LabelMap`: one whole number for each voxel, the affine that places the voxels, and the names of the numbers.

Names come from files that strangers wrote: in messages they are escaped, in file names they are letters and digits.
A map is written as NIfTI-1, by nibabel, with its names in the label table of Caret and Connectome Workbench.
"""

from __future__ import annotations

import gzip
import html
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Grid, Volume
from clrecon.geometry.affine import checked_affine
from clrecon.geometry.grid import may_change
from clrecon.geometry.images import Image, make_nibabel, make_sitk, place_in_header, take_nibabel, take_sitk
from clrecon.geometry.resample import LARGEST_SHEAR_DEGREES, shear_degrees
from clrecon.geometry.vtk import make_image_data, take_image_data
from clrecon.reading.grids.grid_file import LABEL_MAP, import_extra
from clrecon.system.arguments import Space, explains_arguments
from clrecon.system.files import replace_file
from clrecon.system.packages import ShownAsHtml, public_function
from clrecon.system.paths import keep_existing
from clrecon.system.text import escape_text

_SUFFIX_LENGTH = 40
_LABELS_LISTED = 60

_LEVEL = re.compile(r"(c|th?|l|s)(0?[1-9]|1[0-9])")
_VERTEBRA = ("vertebra", "vertebrae", "vert", "level")
"""Words beside the level in names of vertebrae: TotalSegmentator's ``vertebrae_L3``, 3D Slicer's ``L3 vertebra``."""


def check_name(name: str) -> str:
    """Return a name as one printable line of limited length."""
    if not isinstance(name, str):
        raise UsageError(f"the name of a label is text, not {type(name).__name__}")
    return escape_text(name.strip())


def list_labels(names: Mapping[int, str], numbers: Collection[int]) -> str:
    """Return the labels that occur for a message: ``27 vertebrae_L5, 28 vertebrae_L4``."""
    shown = [f"{number} {names[number]}" for number in sorted(numbers)][:_LABELS_LISTED]
    more = len(numbers) - len(shown)
    return (", ".join(shown) or "none") + (f" and {more} more" if more > 0 else "")


def _parts(name: str) -> list[str]:
    return [part for part in re.split(r"[^a-z0-9]+", name.casefold()) if part]


def _level(text: str) -> str | None:
    """Return the level of the spine that a name says, ``l3`` of ``vertebrae_L3``, ``Vertebra L03``; None if several."""
    levels = {(match[1][0], int(match[2])) for part in _parts(text) if (match := _LEVEL.fullmatch(part))}
    others = [part for part in _parts(text) if not _LEVEL.fullmatch(part) and part not in _VERTEBRA]
    if len(levels) != 1 or others:
        return None
    letter, number = levels.pop()
    return f"{letter}{number}"


def find_number(label: str | int, names: Mapping[int, str], present: Collection[int]) -> int:
    """Return the number of `label`: itself, else that of the exact name, else of the only name that says the same level
    of the spine, else of the only one that has it as a part; `present` are those that occur.
    """
    text = str(label).strip()
    wanted = text.casefold()
    named = [number for number, name in names.items() if name.casefold() == wanted]
    if not named and re.fullmatch(r"[0-9]{1,9}", text):
        named = [int(text)]
    if not named and (level := _level(text)) is not None:
        named = [number for number, name in names.items() if _level(name) == level]
    if not named:
        parts = _parts(text)
        named = [number for number, name in names.items() if len(parts) == 1 and parts[0] in _parts(name)]
    named = [number for number in named if number in present] or named
    if len(named) > 1:
        raise UsageError(
            f"'{escape_text(text)}' names several labels: {list_labels(names, named)};"
            " give the number or the whole name"
        )
    if not named or named[0] not in present:
        lack = "is not in the label map" if not named or named[0] not in names else "has no voxel in the label map"
        advice = ""
        if _level(text) is not None and any(re.fullmatch(r"vertebra_[0-9]+", name) for name in names.values()):
            advice = ". These are numbers and no levels: give clrecon vertebrae the level of one of them"
        raise UsageError(f"label '{escape_text(text)}' {lack}; there are: {list_labels(names, present)}{advice}")
    return named[0]


def label_suffix(name: str) -> str:
    """Return a name as part of a file name: letters, digits, dot, hyphen and underscore, at most 40; else ``label``."""
    safe = re.sub(r"[^A-Za-z0-9._-]+", "_", name)[:_SUFFIX_LENGTH].strip("._-")
    return safe or "label"


def file_suffixes(names: Mapping[int, str]) -> dict[int, str]:
    """Return `label_suffix` of each name, with the number added where two files would have one name (ignoring case)."""
    suffixes = {number: label_suffix(name) for number, name in names.items()}
    counts = Counter(suffix.casefold() for suffix in suffixes.values())
    unique = {n: s if counts[s.casefold()] == 1 else f"{s}_{n}" for n, s in suffixes.items()}
    if len({suffix.casefold() for suffix in unique.values()}) < len(unique):  # a suffix with number is also a name
        return {number: f"label_{number}" for number in names}
    return unique


def check_wanted(label: str | int | Iterable[str | int] | None) -> tuple[str | int, ...] | None:
    if label is None:
        return None
    wanted = (label,) if isinstance(label, str | int) else tuple(label)
    if not all(isinstance(one, str | int) for one in wanted):
        raise UsageError("labels are chosen by number or name")
    if not wanted:
        raise UsageError("no label is chosen: name one, or leave the choice out for all")
    return wanted


LARGEST_NUMBER = 65_535
"""Largest label number; numbers go to a device as 16 bits."""


class LabelMap(Grid, ShownAsHtml):
    """Whole numbers that tell to which structure each voxel belongs; 0 is no structure.

    ``voxels`` are uint8 or uint16 and cannot be written: an array that its owner can still change is copied, since the
    map knows which labels it has.

    Parameters
    ----------
    voxels : array_like, shape (nk, nj, ni)
        Whole numbers from 0 to 65,535, indexed ``voxels[k, j, i]``.
    affine : array_like, shape (4, 4), or Volume or LabelMap
        Index (i, j, k) to LPS mm, as for a `Volume`; the grid may differ from that of the volume.  Of a volume or
        another map of the same shape: its places and its frame of reference.
    names : mapping of int to str, optional
        Names of the numbers; a number without a name is called ``label_N``.
    frame_of_reference_hash : str, optional
        Hash of the frame of reference that the file names (DICOM SEG), as in the report of a volume.
    warnings : sequence of str, optional
        Doubtful points of the file.

    Raises
    ------
    UsageError
        ``voxels`` has not three axes, is empty, or holds other values than whole numbers in range; ``affine`` is not an
        affine, or of another shape or uneven slices; or a name is not text.
    """

    @explains_arguments
    def __init__(
        self,
        voxels: ArrayLike,
        affine: ArrayLike | Grid,
        names: Mapping[int, str] | None = None,
        *,
        frame_of_reference_hash: str | None = None,
        warnings: Sequence[str] = (),
    ):
        checked = _checked_voxels(voxels)
        if isinstance(affine, Grid):
            _check_even(affine)
            if affine.shape != checked.shape:
                raise UsageError(f"the labels have shape {checked.shape}, the grid they are to lie on {affine.shape}")
            facts = vars(affine) if isinstance(affine, LabelMap) else getattr(affine, "report", {})
            frame_of_reference_hash = frame_of_reference_hash or facts.get("frame_of_reference_hash")
            affine = affine.affine
        super().__init__(checked, checked_affine(affine))
        self._names = {int(number): check_name(name) for number, name in (names or {}).items()}
        self.frame_of_reference_hash = frame_of_reference_hash
        self.warnings = tuple(warnings)

    def __setstate__(self, state: dict[str, object]) -> None:
        super().__setstate__(state)
        self._voxels.flags.writeable = False

    @cached_property
    def counts(self) -> dict[int, int]:
        """Number of voxels of each label number that occurs, without 0."""
        total = np.zeros(int(self._voxels.max()) + 1, dtype=np.int64)
        for plane in self._voxels:
            counted = np.bincount(plane.ravel())
            total[: len(counted)] += counted
        return {int(number): int(total[number]) for number in np.flatnonzero(total) if number}

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers that occur, ascending, without 0."""
        return tuple(self.counts)

    @property
    def names(self) -> dict[int, str]:
        """Name of each number that occurs, and of each that the file names."""
        return {number: self.name(number) for number in sorted({*self.counts, *self._names} - {0})}

    @explains_arguments
    def name(self, number: int) -> str:
        """Return the name of ``number``, ``label_N`` where the file gives none."""
        return self._names.get(number) or f"label_{number}"

    @explains_arguments
    def find(self, label: str | int) -> int:
        """Return the number of a label.

        Parameters
        ----------
        label : str or int
            Number; or name, in upper or lower case; or one part of a name: ``T12`` finds ``vertebrae_T12``.

        Raises
        ------
        UsageError
            No label or several labels have this name, or no voxel has the label; the message lists the labels of the
            map.
        """
        return find_number(label, self.names, self.counts)

    @explains_arguments
    def choose(self, label: Iterable[int | str] | int | str | None) -> tuple[int, ...]:
        """Return the numbers of one or several labels, each once; of all that occur for None.

        Raises
        ------
        UsageError
            The sequence is empty, or as for `find`.
        """
        wanted = check_wanted(label)
        return self.numbers if wanted is None else tuple(dict.fromkeys(self.find(one) for one in wanted))

    @explains_arguments
    def voxels_of(self, label: Iterable[int | str] | int | str) -> NDArray[np.bool_]:
        """Return which voxels have one of some labels, chosen as by `choose`; shape (nk, nj, ni)."""
        return np.isin(self._voxels, self.choose(label))

    @explains_arguments
    def only(self, label: Iterable[int | str] | int | str) -> LabelMap:
        """Return a map with some of the labels, chosen as by `choose`, their numbers and names, and 0 elsewhere."""
        numbers = self.choose(label)
        voxels = np.where(np.isin(self._voxels, numbers), self._voxels, 0).astype(self._voxels.dtype, copy=False)
        names = {number: name for number, name in self._names.items() if number in numbers}
        return self.changed(voxels, names)

    @explains_arguments
    def label(self, label: Iterable[int | str] | int | str, volume: Volume | None = None, *, device: Any = None) -> Any:
        """Return the voxels of a label, or of several, as a `clrecon.Mask`.

        ``labels & mask`` and ``labels - mask`` are maps of what lies inside and outside of a mask; ``labels | mask``
        has the mask's voxels without a label as a new label, named as the mask.

        Parameters
        ----------
        label : int, str or iterable of them
            As `choose` takes them.
        volume : Volume or DeviceVolume, optional
            Whose voxels are chosen, on any grid, as `clrecon.Mask.from_labels`; by default those of the map itself.
        device : Device, str or int, optional
            See `clrecon.device`; errors are those of `clrecon.Mask.from_labels`.
        """
        scan = Volume(self._voxels, self._affine) if volume is None else volume
        return public_function("Mask").from_labels(scan, self, label, device=device)

    @explains_arguments
    def resample(self, to: Volume) -> LabelMap:
        """Return the map on the grid of a volume, as `clrecon.resample_labels` brings it there.

        Uneven slices are refused, and else what that refuses.
        """
        _check_even(to)
        placed = public_function("resample_labels")(self, to)
        return self.changed(placed.voxels, affine=to.affine, warnings=placed.warnings)

    def changed(self, voxels: NDArray[Any], names: Mapping[int, str] | None = None, **place: Any) -> LabelMap:
        """Return a map with other voxels and names, and whatever else of `LabelMap` is given."""
        fields = {
            "affine": self._affine,
            "frame_of_reference_hash": self.frame_of_reference_hash,
            "warnings": self.warnings,
        }
        return LabelMap(voxels, names=self._names if names is None else names, **{**fields, **place})

    @explains_arguments
    def save(self, path: str | os.PathLike[str], *, no_clobber: bool = False) -> int:
        """Write the map to .nii.gz or .nii, with its names in a label table, as a whole or not at all.

        Parameters
        ----------
        path : str or path
        no_clobber : bool
            True: a file of that name stays and is an `OutputError`.

        Returns
        -------
        int
            Size of the file in bytes.

        Raises
        ------
        UsageError
            The path has another extension, or nibabel is not installed.
        OutputError
            The file cannot be written; an older one is intact.
        """
        name = os.fspath(path).lower()
        if not name.endswith((".nii", ".nii.gz")):
            raise UsageError(f"a label map is written as .nii.gz or .nii, not {escape_text(name[-40:])!r}")
        content = encode_nifti(self, packed=name.endswith(".gz"))
        with keep_existing(keep=no_clobber):
            return replace_file(path, lambda stream: stream.write(content), expected_bytes=len(content))

    def to_sitk(self) -> Any:
        """Return the map as ``SimpleITK.Image`` of whole numbers, a copy in LPS mm; names do not go with it.

        Raises
        ------
        UsageError
            The axes are sheared, which such an image cannot hold, or SimpleITK is not installed.
        """
        return make_sitk(*self._at_right_angles()[:2])

    @classmethod
    @explains_arguments
    def from_sitk(cls, image: Any, names: Mapping[int, str] | None = None) -> LabelMap:
        """Make a map of a ``SimpleITK.Image`` of three axes, LPS mm; its voxels are a copy.

        Parameters
        ----------
        image : SimpleITK.Image
            Of whole numbers from 0 to 65,535, which may be stored as real ones.
        names : mapping of int to str, optional
            As of a `LabelMap`.

        Raises
        ------
        UsageError
            It is no such image, or SimpleITK is not installed.
        """
        voxels, affine = take_sitk(image)
        return cls(_as_whole(voxels), affine, names)

    def to_pyvista(self) -> Any:
        """Return the map as ``pyvista.ImageData`` in LPS mm: point data ``label``, names in a field array ``LABELS``.

        Memory and axes are as of `Volume.to_pyvista`: sheared ones are refused.
        """
        image = make_image_data(self._at_right_angles(), "label")
        image.field_data["LABELS"] = [f"{number} {name}" for number, name in self.names.items()] or [""]
        return image

    @classmethod
    @explains_arguments
    def from_pyvista(
        cls, image: Any, names: Mapping[int, str] | None = None, *, name: str | None = None, space: Space | None = None
    ) -> LabelMap:
        """Make a map of a ``pyvista.ImageData`` with a whole number at each point, which may be stored as a real one.

        Parameters
        ----------
        image, name, space
            As of `Volume.from_pyvista`.
        names : mapping of int to str, optional
            As of a `LabelMap`; None: those of the field array ``LABELS``, which `to_pyvista` writes.
        """
        voxels, affine = take_image_data(image, name, space)
        if names is None and "LABELS" in image.field_data:
            rows = [str(text).partition(" ")[::2] for text in image.field_data["LABELS"]]
            names = {int(number): text for number, text in rows if re.fullmatch("[0-9]{1,5}", number)}
        return cls(_as_whole(voxels), affine, names)

    def _at_right_angles(self) -> Image:
        shear = shear_degrees(self._affine)
        if shear > LARGEST_SHEAR_DEGREES:
            raise UsageError(
                f"this image has axes at right angles, but those of the label map are sheared by {shear:.2f} degrees:"
                " to_nibabel() and save() hold them"
            )
        return Image(self._voxels, self._affine, None)

    def to_nibabel(self) -> Any:
        """Return the map as ``nibabel.Nifti1Image``: array (i, j, k) on the memory of the voxels, affine to RAS mm.

        Names do not go with it: `save` writes them.

        Raises
        ------
        UsageError
            nibabel is not installed.
        """
        return make_nibabel(self._voxels, self._affine)

    @classmethod
    @explains_arguments
    def from_nibabel(cls, image: Any, names: Mapping[int, str] | None = None) -> LabelMap:
        """Make a map of an image of nibabel, whose affine leads to RAS mm.

        Parameters
        ----------
        image : nibabel.spatialimages.SpatialImage
            Of whole numbers from 0 to 65,535, which may be stored as real ones.
        names : mapping of int to str, optional
            As of a `LabelMap`; `clrecon.read_labels` of a file takes those of its label table.

        Raises
        ------
        UsageError
            It is no such image, does not say where it lies, or nibabel is not installed.
        """
        voxels, affine = take_nibabel(image)
        return cls(_as_whole(voxels), affine, names)

    def __repr__(self) -> str:
        ni, nj, nk = self.shape_ijk
        di, dj, dk = self.spacing
        return f"LabelMap({ni} x {nj} x {nk}, spacing {di:.4g} x {dj:.4g} x {dk:.4g} mm, {len(self.numbers)} labels)"


_CARET_CODE = 30
"""Code of the extension that holds Caret's XML, which has a table of labels."""


def load_nibabel() -> Any:
    return import_extra("nibabel", LABEL_MAP)


def encode_nifti(labels: LabelMap, *, packed: bool) -> bytes:
    """Return the bytes of the file, for .nii.gz packed; the same labels give the same bytes."""
    nibabel = load_nibabel()
    image = nibabel.Nifti1Image(np.asarray(labels.voxels).transpose(2, 1, 0), None)
    place_in_header(image.header, labels.affine)
    table = "".join(
        f'<Label Key="{number}" Red="1" Green="1" Blue="1" Alpha="1">{html.escape(name, quote=False)}</Label>'
        for number, name in labels.names.items()
    )
    text = f'<?xml version="1.0" encoding="UTF-8"?><CaretExtension><VolumeInformation Index="0"><LabelTable>{table}'
    text += "</LabelTable></VolumeInformation></CaretExtension>"
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(_CARET_CODE, text.encode("utf-8")))
    content = bytes(image.to_bytes())
    return gzip.compress(content, compresslevel=6, mtime=0) if packed else content


def _as_whole(voxels: NDArray[Any]) -> NDArray[Any]:
    """Return real numbers that are whole, within the range of labels, as such; others as they are."""
    if voxels.dtype.kind != "f" or not (voxels == np.rint(voxels)).all() or abs(voxels).max() > LARGEST_NUMBER:
        return voxels
    return voxels.astype(np.int32)


def _check_even(grid: Grid) -> None:
    if getattr(grid, "uneven", False):
        raise UsageError("the slices of the volume are uneven, no label map has such: clrecon.resample_labels")


def _checked_voxels(voxels: ArrayLike) -> NDArray[Any]:
    try:
        array = np.asarray(voxels)
    except ValueError as error:
        raise UsageError(f"labels are an array of whole numbers: {error}") from error
    if array.ndim != 3:
        raise UsageError(f"labels have three axes (k, j, i), these have shape {array.shape}")
    if array.size == 0:
        raise UsageError(f"the label map is empty: its shape is {array.shape}")
    if array.dtype == np.bool_:
        array = array.astype(np.uint8)
    if array.dtype.kind not in "iu":
        raise UsageError(f"labels are whole numbers, these are {array.dtype}: convert them first")
    low, high = int(array.min()), int(array.max())
    if low < 0 or high > LARGEST_NUMBER:
        raise UsageError(f"labels run from 0 to {LARGEST_NUMBER:,}, these from {low:,} to {high:,}")
    data = np.ascontiguousarray(array, dtype=np.uint8 if array.dtype.itemsize == 1 else np.uint16)
    if may_change(data):
        data = data.copy() if np.shares_memory(data, voxels if isinstance(voxels, np.ndarray) else array) else data
        data.flags.writeable = False
    return data
