"""`PhantomSettings`, its validation, and where the slices of a phantom lie in the patient.

Positions are rounded to the decimal strings that a DICOM header can hold *before* the affine is taken from them,
so that voxels, written files and truth all belong to exactly the same affine.
"""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import compose_affine
from clrecon.phantom.ghosts import ghost_places

__all__ = [
    "KINDS",
    "TABLE_NAMES",
    "Kind",
    "PhantomSettings",
    "Placement",
    "format_decimal",
    "parse_size",
    "place_slices",
]

Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class Kind:
    """A kind of phantom: its description, and its default settings."""

    said: str
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.25)
    noise: float = 0.0
    point_spread_mm: float = 0.0
    table: str | None = None
    """Table under bodies of this kind; None for an analytic shape, which lies on nothing."""
    is_scene: bool = False


def _scene(said: str, spacing: tuple[float, float, float], table: str = "none") -> Kind:
    return Kind(said, spacing, noise=12.0, point_spread_mm=0.5, table=table, is_scene=True)


KINDS = {
    "spine": Kind("thoracic and lumbar spine in a trunk", noise=12.0, point_spread_mm=0.5, table="own"),
    "sphere": Kind("ball"),
    "torus": Kind("ring"),
    "cylinder": Kind("cylinder with flat ends"),
    "plane": Kind("oblique slab"),
    "skull": _scene("dry skull, a specimen without soft tissue", (0.9, 0.9, 1.5)),
    "head": _scene("the skull in soft tissue, with air in sinuses and throat", (0.9, 0.9, 1.5)),
    "bones": _scene("dry bones that lie apart", (0.9, 0.9, 1.5)),
    "limb": _scene("lower leg, off the centre", (0.9, 0.9, 1.5)),
    "pair": _scene("two legs of two sizes, air between them", (0.9, 0.9, 1.5)),
    "pelvis": _scene("pelvis with a hip prosthesis and a screw at the ceiling of 12 bits", (1.5, 1.5, 1.5)),
    "contrast": _scene("trunk with heart and vessels brighter and larger than the spine", (1.4, 1.4, 2.0)),
    "water": _scene("cylinder of water in an acrylic shell", (1.0, 1.0, 1.5)),
    "empty": _scene("a table with nothing on it", (1.7, 1.7, 2.0), "curved"),
}
"""Every kind with its description and defaults."""

TABLE_NAMES = ("none", "flat", "curved", "headrest")
"""Tables that a body may lie on.  If none is named, a spine lies on a curved couch of its own."""

CENTRE_LPS_MM = (-3.5, -142.25, -418.75)
"""Centre of the volume, away from zero as on a real couch, so that an origin lost by a program shows."""


def parse_size(text: str) -> tuple[int, int]:
    """Read ``"256"`` or ``"256x192"`` as (columns, rows).

    Raises
    ------
    UsageError
        `text` has another form.
    """
    parts = text.lower().split("x")
    if len(parts) > 2 or not all(re.fullmatch(r" *[0-9]{1,9} *", part) for part in parts):
        raise UsageError(f"size {text!r} is not understood: use columns or columns x rows, like 256 or 256x192")
    return int(parts[0]), int(parts[-1])


def format_decimal(value: float) -> str:
    """Write a number as a DICOM decimal string: at most 16 characters, as many digits as fit.

    Raises
    ------
    UsageError
        The number is not finite.
    """
    if not math.isfinite(value):
        raise UsageError(f"{value} cannot be written as a decimal string")
    value = float(value) + 0.0  # no minus zero
    text = repr(value)
    if text.endswith(".0"):
        text = text[:-2]
    digits = 16
    while len(text) > 16:
        digits -= 1
        text = f"{value:.{digits}g}"
    return "0" if float(text) == 0.0 else text


@dataclass(frozen=True)
class PhantomSettings:
    """What a phantom shows and how it is sampled.

    Attributes
    ----------
    kind : str
        One of `KINDS`.  ``plane`` is an oblique slab with finite faces, so that it has an area and a volume.
    size : (columns, rows)
        Extents of a slice in pixels.
    slices : int
        Number of slices.
    spacing : (dj, di, dk)
        mm, in DICOM's order: distance between rows, between columns, and between neighbouring slices **along the
        slice normal**.  With a tilted gantry the slice step itself is longer: ``dk / cos(tilt)``.  Default: that of
        the kind, so that 256 x 256 pixels hold it whole.
    tilt : float
        Gantry tilt in degrees: slices rotated about the patient's x axis while the table still moves along z, so
        the slice step is not parallel to the slice normal (a shear).  At most 45 either way.
    oblique : (about_x, about_y, about_z)
        Degrees by which the whole frame (slices and slice step) is then rotated rigidly about the patient's x,
        then y, then z axis.
    noise : float
        Standard deviation of white Gaussian noise in HU; default 12, 0 for an analytic shape.
    point_spread_mm : float
        Standard deviation of the Gaussian point spread in mm; default 0.5, 0 for an analytic shape.
    seed : int
        Same settings and seed give the same bytes; another seed moves the shape by part of a voxel, and gives other
        noise and texture.
    inside_hu, outside_hu : float
        HU of an analytic shape and of its surroundings (not used by other kinds).
    radius_mm : float, optional
        Sphere radius, torus centre-line radius, cylinder radius, or half the thickness of the plane's slab.
        Default: a part of the field of view.
    table : {"none", "flat", "curved", "headrest"}, optional
        Table that the body lies on; default: nothing, the spine's own couch, a curved table for the kind ``empty``.
        Not for analytic shapes.
    table_gap_mm : float
        Gap between body and table: at 0 they touch, below 0 the body sinks in.  The spine's own couch ignores it.
    prone : bool
        The patient lies on the face: the table is at the front, and the image's rows and columns are turned by half a
        turn about z, as a scanner does it (PatientPosition HFP).
    ghosts : bool
        Of a spine: two slices of the stack are foreign, a screen capture and a sagittal view, the folder has a
        sagittal localizer, and the table is the curved one unless another is named.
    transfer_syntax : {"explicit", "implicit"}
        Value representations in the files, both little endian and uncompressed.

    Raises
    ------
    UsageError
        From the constructor, with the numbers, when a value cannot be used.
    """

    kind: str = "spine"
    size: tuple[int, int] = (256, 256)
    slices: int = 120
    spacing: tuple[float, float, float] = None  # type: ignore[assignment]  # three numbers once constructed
    tilt: float = 0.0
    oblique: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise: float = None  # type: ignore[assignment]  # a number once constructed
    point_spread_mm: float = None  # type: ignore[assignment]  # a number once constructed
    seed: int = 0
    inside_hu: float = 1000.0
    outside_hu: float = -1000.0
    radius_mm: float | None = None
    table: str | None = None
    table_gap_mm: float = 0.0
    prone: bool = False
    ghosts: bool = False
    transfer_syntax: str = "explicit"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UsageError(f"unknown phantom kind {self.kind!r}: use one of {', '.join(KINDS)}")
        if self.transfer_syntax not in ("explicit", "implicit"):
            raise UsageError(f"unknown transfer syntax {self.transfer_syntax!r}: use explicit or implicit")
        for name in ("spacing", "noise", "point_spread_mm"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(KINDS[self.kind], name))
        # Lists (from a command line) become tuples, so that equal settings compare and describe equal.
        for name, length in (("size", 2), ("spacing", 3), ("oblique", 3)):
            value = tuple(getattr(self, name))
            if len(value) != length:
                raise UsageError(f"{name} needs {length} values, got {len(value)}: {value}")
            object.__setattr__(self, name, value)
        for name, extent in (("columns", self.size[0]), ("rows", self.size[1])):
            _check_integer(name, extent, 8, 4096)
        _check_integer("slices", self.slices, 1, 9999)
        _check_integer("seed", self.seed, 0, 2**31 - 1)
        for name, step in zip(("row spacing dj", "column spacing di", "slice gap dk"), self.spacing, strict=True):
            _check_number(name, step, 0.05, 50.0, "mm")
        _check_number("tilt", self.tilt, -45.0, 45.0, "degrees")
        for name, angle in zip(("oblique about x", "oblique about y", "oblique about z"), self.oblique, strict=True):
            _check_number(name, angle, -360.0, 360.0, "degrees")
        _check_number("noise", self.noise, 0.0, 1000.0, "HU")
        _check_number("point spread", self.point_spread_mm, 0.0, 20.0, "mm")
        _check_number("inside HU", self.inside_hu, -1024.0, 30000.0, "HU")
        _check_number("outside HU", self.outside_hu, -1024.0, 30000.0, "HU")
        if abs(self.inside_hu - self.outside_hu) < 1.0:
            raise UsageError(f"inside ({self.inside_hu:g}) and outside ({self.outside_hu:g}) differ by less than 1 HU")
        if self.radius_mm is not None:
            _check_number("radius", self.radius_mm, 1e-3, 1e4, "mm")
            if KINDS[self.kind].table is not None:
                raise UsageError(f"a {self.kind} has no radius: it is for sphere, torus, cylinder and plane")
        _check_number("gap between body and table", self.table_gap_mm, -100.0, 500.0, "mm")
        self._check_lying()
        if self.ghosts:
            if self.kind != "spine":
                raise UsageError(f"a {self.kind} has no ghosts: they are for the spine")
            ghost_places(self.slices)

    def _check_lying(self) -> None:
        if self.table is not None and self.table not in TABLE_NAMES:
            raise UsageError(f"unknown table {self.table!r}: use one of {', '.join(TABLE_NAMES)}")
        lies = self.table is not None or self.table_gap_mm != 0.0 or self.prone
        if lies and KINDS[self.kind].table is None:
            raise UsageError(f"a {self.kind} lies on nothing: table, gap and prone are for spine and the other bodies")
        if self.table_gap_mm != 0.0 and self.table_used in ("none", "own"):
            names = ", ".join(TABLE_NAMES[1:])
            raise UsageError(f"a gap of {self.table_gap_mm:g} mm needs a table: name one of {names}")

    @property
    def table_used(self) -> str:
        """Name of the table: the given one, else that of the kind; ``own`` for the spine's own couch, which is too thin
        to be a ghost.
        """
        return self.table or ("curved" if self.ghosts else KINDS[self.kind].table) or "none"

    @property
    def shape_kji(self) -> tuple[int, int, int]:
        """(slices, rows, columns), the shape of the voxels."""
        return self.slices, self.size[1], self.size[0]

    def as_dict(self) -> dict[str, Any]:
        """All settings as plain JSON types; `table`, `table_gap_mm`, `prone`, `ghosts` where they are not the default.

        UIDs are derived from these texts, so the defaults are left out: phantoms of earlier versions keep their UIDs.
        """
        plain = {
            name: list(value) if isinstance(value, tuple) else value for name, value in dataclasses.asdict(self).items()
        }
        for name, default in (("table", None), ("table_gap_mm", 0.0), ("prone", False), ("ghosts", False)):
            if plain[name] == default:
                del plain[name]
        return plain


def _check_integer(name: str, value: Any, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise UsageError(f"{name} must be a whole number from {low} to {high}, got {value}")


def _check_number(name: str, value: Any, low: float, high: float, unit: str) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not low <= value <= high:
        raise UsageError(f"{name} must be a number from {low:g} to {high:g} {unit}, got {value}")


@dataclass(frozen=True)
class Placement:
    """Where the slices lie: the decimal strings of the files, and the affine that these strings give.

    Attributes
    ----------
    orientation : list of 6 str
        Row cosines, then column cosines.
    pixel_spacing : list of 2 str
        dj, di in mm.
    positions : list of lists of 3 str
        Centre of pixel (0, 0) of every slice, LPS mm.
    slice_thickness, tilt : str
        dk in mm and the gantry tilt in degrees.
    affine : ndarray, shape (4, 4)
        Index (i, j, k) to LPS mm.
    """

    orientation: list[str]
    pixel_spacing: list[str]
    positions: list[list[str]]
    slice_thickness: str
    tilt: str
    affine: Float64Array


def _rotation(oblique: tuple[float, float, float]) -> Float64Array:
    """Return the rotation about x, then y, then z, degrees."""
    matrix = np.eye(3)
    for axis, angle in enumerate(oblique):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[first, second], [first, second]] = c
        turn[first, second], turn[second, first] = -s, s
        matrix = turn @ matrix
    return matrix


def place_slices(settings: PhantomSettings) -> Placement:
    """Compute orientation and positions of all slices, centred on `CENTRE_LPS_MM`.

    Parameters
    ----------
    settings : PhantomSettings

    Returns
    -------
    Placement
    """
    dj, di, dk = settings.spacing
    tilt = math.radians(settings.tilt)
    rotation = _rotation(settings.oblique)
    if settings.prone:
        rotation = rotation @ np.diag((-1.0, -1.0, 1.0))
    row = rotation @ (1.0, 0.0, 0.0)
    column = rotation @ (0.0, math.cos(tilt), -math.sin(tilt))
    step = rotation @ (0.0, 0.0, dk / math.cos(tilt))

    orientation = [format_decimal(value) for value in (*row, *column)]
    pixel_spacing = [format_decimal(dj), format_decimal(di)]
    cosines = np.array([float(text) for text in orientation])
    i_step, j_step = cosines[:3] * float(pixel_spacing[1]), cosines[3:] * float(pixel_spacing[0])
    middle = np.array((*settings.size, settings.slices), dtype=np.float64) / 2.0 - 0.5
    first = np.array(CENTRE_LPS_MM) - middle @ np.array((i_step, j_step, step))
    positions = [[format_decimal(value) for value in first + k * step] for k in range(settings.slices)]
    written = np.array(positions, dtype=np.float64)
    k_step = (written[-1] - written[0]) / (settings.slices - 1) if settings.slices > 1 else step
    return Placement(
        orientation=orientation,
        pixel_spacing=pixel_spacing,
        positions=positions,
        slice_thickness=format_decimal(dk),
        tilt=format_decimal(settings.tilt),
        affine=compose_affine(i_step, j_step, k_step, written[0]),
    )
