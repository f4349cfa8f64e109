"""`PhantomSettings` and its validation; ghosts.

Ghosts are foreign slices in the stack of a phantom and a localizer in its folder, as they come from real archives."""

from __future__ import annotations

import dataclasses
import re
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import column_spacing, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom.spine_parts import THORACOLUMBAR, SpineChoice, format_levels, parse_levels
from clrecon.proof.phantom.spine_plan import fit_slices, spine_choice
from clrecon.proof.phantom.vertebra import LARGEST_GAP_MM
from clrecon.system.options import option
from clrecon.system.text import unknown_name

if TYPE_CHECKING:
    from pydicom.dataset import FileDataset


FEWEST_SLICES = 12
"""Fewest slices of a phantom with ghosts: two foreign ones with real ones between, before and behind them."""

PLACES = (0.35, 0.65)
"""Foreign slices as shares of the stack."""

BACKGROUND_HU, TEXT_HU = -1000, 2000


def ghost_places(slices: int) -> tuple[int, int]:
    """Return the numbers of the two foreign slices of a stack."""
    if slices < FEWEST_SLICES:
        raise UsageError(f"{slices} slices have no room for ghosts: at least {FEWEST_SLICES} are needed")
    first, second = (round(share * slices) for share in PLACES)
    return first, second


def draw_ghosts(voxels: NDArray[np.int16], seed: int) -> dict[str, Any]:
    """Replace two slices by a screen capture and a sagittal view; return what the truth says of them."""
    capture, sagittal = ghost_places(len(voxels))
    view = _sagittal(voxels)
    rows = np.arange(voxels.shape[1]) * view.shape[0] // voxels.shape[1]
    voxels[sagittal] = view[rows][:, np.arange(voxels.shape[2]) * view.shape[1] // voxels.shape[2]]
    voxels[capture] = _screen_capture(voxels.shape[1:], seed)
    return {
        "slices": [
            {"slice": capture, "shows": "a screen capture"},
            {"slice": sagittal, "shows": "a sagittal view of the stack"},
        ]
    }


def _sagittal(voxels: NDArray[np.int16]) -> NDArray[np.int16]:
    """Return the highest value along each row of the volume: columns run along j, rows from the last slice down."""
    return voxels.max(axis=2)[::-1]


def _screen_capture(shape: tuple[int, ...], seed: int) -> NDArray[np.int16]:
    """Draw a frame, and lines of letters that are filled rectangles."""
    rows, columns = shape
    page = np.full(shape, BACKGROUND_HU, np.int16)
    edge = max(1, min(rows, columns) // 64)
    page[edge : 2 * edge] = page[-2 * edge : -edge] = TEXT_HU
    page[:, edge : 2 * edge] = page[:, -2 * edge : -edge] = TEXT_HU
    rng = np.random.default_rng([seed, 7])
    height = max(2, rows // 24)
    for top in range(3 * height, rows - 2 * height, 2 * height):
        left = 4 * edge
        while left < columns - 8 * edge:
            width = int(rng.integers(1, 4)) * edge
            if rng.random() < 0.7:
                page[top : top + height, left : left + width] = TEXT_HU
            left += width + edge
    return page


def make_localizer(
    slice_header: FileDataset, voxels: NDArray[np.int16], affine: Float64Array, number: int, instance: str
) -> tuple[FileDataset, NDArray[np.int16]]:
    """Return header and HU of a sagittal localizer of the stack, in the series of its slices."""
    from pydicom.uid import UID

    header = deepcopy(slice_header)
    view = np.ascontiguousarray(_sagittal(voxels))
    _, dj, dk = column_spacing(affine)
    along = affine[:3, 1] / np.linalg.norm(affine[:3, 1])
    down = slice_normal(affine)
    if down @ affine[:3, 2] > 0.0:
        down = -down
    middle = ((voxels.shape[2] - 1) / 2.0, 0.0, len(voxels) - 1.0)
    header.file_meta.MediaStorageSOPInstanceUID = header.SOPInstanceUID = UID(instance)
    header.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
    header.InstanceNumber = str(number)
    header.ImagePositionPatient = [f"{value:.8g}" for value in affine[:3, :3] @ middle + affine[:3, 3]]
    header.ImageOrientationPatient = [f"{value + 0.0:.8g}" for value in (*along, *down)]
    header.Rows, header.Columns = view.shape
    header.PixelSpacing = [f"{dk:.8g}", f"{dj:.8g}"]
    return header, view


@dataclass(frozen=True)
class Scanner:
    """What a scanner makes of HU: the values in its files are ``slope * HU + offset``, in `unit`.

    unit: RescaleType of the files.
    cupping_hu: What beam hardening takes away at the centre of the field of view, falling with the square of the
        radius.
    streaks: Strength of the streaks of metal, see `clrecon.proof.phantom.sampling.add_streaks`.
    padding: Value outside of the round field of view; None where it is a square.
    """

    kvp: int = 120
    slope: float = 1.0
    offset: float = 0.0
    unit: str = "HU"
    cupping_hu: float = 0.0
    streaks: float = 0.0
    padding: int | None = None

    def to_values(self, hu: float) -> float:
        return self.slope * hu + self.offset


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
    size: tuple[int, int] = (256, 256)
    slices: int = 120
    scanner: Scanner = Scanner()
    bone_and_tissue_hu: tuple[float, float] | None = None
    """HU of both sides of most of the surface of bone; None where there are several bones or tissues."""


def _scene(words: str, spacing: tuple[float, float, float], table: str = "none", **more: Any) -> Kind:
    return Kind(words, spacing, **{"noise": 12.0, "point_spread_mm": 0.5, "table": table, "is_scene": True, **more})


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
    "jaw": _scene(
        "mandible with an implant in a cone beam: grey values of its own, cupping, streaks, a round field of view",
        (0.4, 0.4, 0.4),
        noise=40.0,
        point_spread_mm=0.24,
        size=(220, 220),
        slices=90,
        scanner=Scanner(kvp=90, slope=0.8, offset=350.0, cupping_hu=160.0, streaks=1.0, padding=0),
        bone_and_tissue_hu=(1400.0, 50.0),
    ),
    "longbone": _scene(
        "shaft with trabeculae in micro-CT, in mg HA/cm3",
        (0.02, 0.02, 0.02),
        noise=60.0,
        point_spread_mm=0.011,
        size=(200, 200),
        slices=100,
        scanner=Scanner(kvp=55, slope=0.4, unit="MGML"),
        bone_and_tissue_hu=(2600.0, 0.0),
    ),
    "hand": _scene(
        "hand on a table, fingers along the slices' step",
        (0.7, 0.7, 0.7),
        "flat",
        noise=15.0,
        point_spread_mm=0.4,
        size=(168, 80),
        slices=208,
        bone_and_tissue_hu=(1250.0, 60.0),
    ),
    "hip": _scene(
        "one hip with a prosthesis and its streaks",
        (0.8, 0.8, 1.6),
        noise=15.0,
        size=(200, 176),
        slices=64,
        scanner=Scanner(streaks=1.0),
        bone_and_tissue_hu=(1350.0, 60.0),
    ),
    "mouse": _scene(
        "hind part of a mouse in a holder",
        (0.12, 0.12, 0.12),
        noise=40.0,
        point_spread_mm=0.07,
        size=(220, 220),
        slices=88,
        scanner=Scanner(kvp=70),
        bone_and_tissue_hu=(1300.0, 40.0),
    ),
}
"""Every kind with its description and defaults."""

TABLE_NAMES = ("none", "flat", "curved", "headrest")
"""Tables that a body may lie on.  If none is named, a spine lies on a curved couch of its own."""

CENTRE_LPS_MM = (-3.5, -142.25, -418.75)
"""Centre of the volume, away from zero as on a real couch, so that an origin lost by a program shows."""

_MOST_BEND = 60.0
"""Largest kyphosis and scoliosis that is added, degrees."""

_CHOOSING = ("levels", "facet_gap_mm", "kyphosis_deg", "scoliosis_deg")
_SPINE_ONLY = (*_CHOOSING, "uneven_mm", "phases", "ghosts")
_LATER = ("table", "table_gap_mm", "prone", *_SPINE_ONLY, "missing")
"""Settings that older phantoms did not have."""
_SAID = {"uneven_mm": "uneven slices", "facet_gap_mm": "facet joints"}
_SAID_PLURAL = dict.fromkeys(("levels", "phases", "ghosts", "uneven_mm", "facet_gap_mm"), "they are")


def parse_size(text: str) -> tuple[int, int]:
    """Read ``"256"`` or ``"256x192"`` as (columns, rows)."""
    parts = text.lower().split("x")
    if len(parts) > 2 or not all(re.fullmatch(r" *[0-9]{1,9} *", part) for part in parts):
        raise UsageError(f"size {text!r} is not understood: use columns or columns x rows, like 256 or 256x192")
    return int(parts[0]), int(parts[-1])


def parse_missing(text: str) -> tuple[int, ...]:
    """Read numbers of slices such as ``"20-22,40"``."""
    numbers: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r" *([0-9]{1,4})(?: *- *([0-9]{1,4}))? *", part, re.ASCII)
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise UsageError(f"missing slices {text[:40]!r} are not understood: use numbers from 1, like 20-22,40")
        numbers += range(int(match[1]), int(match[2] or match[1]) + 1)
    return tuple(numbers)


_spine_option = partial(option, group="spine")


@dataclass(frozen=True)
class PhantomSettings:
    """What a phantom shows and how it is sampled.

    Options say in their help what they do; beside that:

    kind: One of `KINDS`.  ``plane`` is an oblique slab with finite faces, so that it has an area and a volume.
    size: (columns, rows).
    slices: None: as many as whole vertebrae of `levels` need.
    spacing: (dj, di, dk). mm, in DICOM's order: distance between rows, between columns, and between neighbouring slices
        **along the slice normal**.  With a tilted gantry the slice step itself is longer: ``dk / cos(tilt)``.  Default:
        that of the kind, so that 256 x 256 pixels hold it whole.
    tilt: Slices rotated about the patient's x axis while the table still moves along z, so the slice step is not
        parallel to the slice normal (a shear).  At most 45 degrees either way.
    oblique: (about_x, about_y, about_z). Degrees by which the whole frame (slices and slice step) is then rotated
        rigidly about the patient's x, then y, then z axis.
    seed: Same settings and seed give the same bytes.
    inside_hu, outside_hu: HU of an analytic shape and of its surroundings (not used by other kinds).
    radius_mm: Sphere radius, torus centre-line radius, cylinder radius, or half the thickness of the plane's slab.
        Default: a part of the field of view.
    table: Default: nothing, the spine's own couch, a curved table for the kind ``empty``. Not for analytic shapes.
    table_gap_mm: Below 0 the body sinks in.  The spine's own couch ignores it.
    prone: The table is at the front, and the image's rows and columns are turned by half a turn about z, as a scanner
        does it (PatientPosition HFP).
    ghosts: A screen capture and a sagittal view in the stack; the table is the curved one unless another is named.
    levels: From C1 to L5, in the middle of the stack.  Their joints are 2 mm wide or more.  Default: T1 to L5 with T12
        in the middle, as far as the slices show them.
    facet_gap_mm: At most 1.5 mm.
    kyphosis_deg, scoliosis_deg: Added to the natural curve, from -60 to 60; vertebrae stay rigid.
    uneven_mm: At most 0.4 of the mean gap.
    missing: From 1 as in file names; not the first and not the last.
    transfer_syntax: {"explicit", "implicit"}. Value representations in the files, both little endian and uncompressed.
    """

    kind: str = option(
        "--kind K",
        "kind of phantom, see below (default: spine)",
        default="spine",
        parse=str.lower,
        first=True,
        words=KINDS,
    )
    size: tuple[int, int] = option(  # two numbers once constructed
        "--size N", "columns and rows, as 256 or 256x192 (default: by kind, mostly 256)", parse=parse_size, first=True
    )
    slices: int = option(  # a number once constructed
        "--slices N", "number of slices (default: as the levels need, otherwise by kind, mostly 120)", first=True
    )
    spacing: tuple[float, float, float] = option(  # three numbers once constructed
        "--spacing DJ DI DK",
        "mm between rows, columns, slices (default: by kind, of a spine 1 1 1.25)",
        parse=float,
        first=True,
    )
    tilt: float = option("--tilt DEG", "gantry tilt (default: 0)", default=0.0, first=True)
    oblique: tuple[float, float, float] = option(
        "--oblique X Y Z", "degrees about the patient's axes", default=(0.0, 0.0, 0.0), parse=float
    )
    noise: float = option(  # a number once constructed
        "--noise HU", "standard deviation of the noise (default: 12, of an analytic shape 0)", first=True
    )
    point_spread_mm: float = option(  # a number once constructed
        "--point-spread MM", "standard deviation of the blur (default: 0.5, of an analytic shape 0)"
    )
    seed: int = option(
        "--seed N", "place within a voxel, noise and texture (default: 0)", group="seed", default=0, first=True
    )
    inside_hu: float = 1000.0
    outside_hu: float = -1000.0
    radius_mm: float | None = option("--radius MM", "radius of an analytic shape")
    table: str | None = option(
        "--table T",
        "what a body lies on: none, flat, curved or headrest",
        parse=str.lower,
        first=True,
        words=TABLE_NAMES,
    )
    table_gap_mm: float = option("--table-gap MM", "gap between body and table (default: 0, they touch)", default=0.0)
    prone: bool = option("--prone", "the patient lies face down")
    ghosts: bool = option("--ghosts", "add two foreign slices and a localizer to a spine")
    levels: str | None = _spine_option("--levels C1-L5", "vertebrae to show, such as L4-L5 or C3-C7,T1-T5", first=True)
    facet_gap_mm: float | None = _spine_option("--facet-gap MM", "distance of neighbours in the facet joints")
    kyphosis_deg: float = _spine_option(
        "--kyphosis DEG", "angle between the first and the last level; positive: the back is round", default=0.0
    )
    scoliosis_deg: float = _spine_option(
        "--scoliosis DEG",
        "angle between the first and the last level; positive: the middle lies to the left",
        default=0.0,
    )
    uneven_mm: float = _spine_option("--uneven MM", "vary the gaps between slices by up to this much", default=0.0)
    missing: tuple[int, ...] = option(
        "--missing N,M-O",
        "leave out slices by number, such as 20-22,40",
        group="missing",
        default=(),
        parse=parse_missing,
    )
    phases: int = _spine_option("--phases N", "series at the same positions, each with more contrast medium", default=1)
    transfer_syntax: str = "explicit"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UsageError(unknown_name("phantom kind", self.kind, KINDS))
        if self.transfer_syntax not in ("explicit", "implicit"):
            raise UsageError(f"unknown transfer syntax {self.transfer_syntax!r}: use explicit or implicit")
        for name in ("spacing", "noise", "point_spread_mm", "size"):
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
        if self.slices is not None:
            _check_integer("slices", self.slices, 1, 9999)
        _check_integer("seed", self.seed, 0, 2**31 - 1)
        for name, step in zip(("row spacing dj", "column spacing di", "slice gap dk"), self.spacing, strict=True):
            _check_number(name, step, 0.005, 50.0, "mm")
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
        self._check_spine()
        self._check_series()

    def _check_spine(self) -> None:
        _check_number("kyphosis", self.kyphosis_deg, -_MOST_BEND, _MOST_BEND, "degrees")
        _check_number("scoliosis", self.scoliosis_deg, -_MOST_BEND, _MOST_BEND, "degrees")
        if self.facet_gap_mm is not None:
            _check_number("gap of the facet joints", self.facet_gap_mm, 0.0, LARGEST_GAP_MM, "mm")
        _check_number("unevenness", self.uneven_mm, 0.0, 0.4 * self.spacing[2], "mm (0.4 of the mean gap)")
        _check_integer("phases", self.phases, 1, 20)
        if self.levels is not None:
            object.__setattr__(self, "levels", format_levels(parse_levels(self.levels)))
        if self.kind != "spine":
            for name in _SPINE_ONLY:
                if not self._is_default(name):
                    noun = _SAID.get(name) or name.removesuffix("_deg").removesuffix("_mm").replace("_", " ")
                    raise UsageError(f"a {self.kind} has no {noun}: {_SAID_PLURAL.get(name, 'it is')} for the spine")
        if self.slices is None or self.levels is not None:
            choice, slices = self.spine_choice, self.slices
            if choice is not None and self.levels is not None:
                slices = fit_slices(choice, self.size, self.spacing, self.seed, self._directions, self.slices)
            object.__setattr__(self, "slices", slices or KINDS[self.kind].slices)

    def _check_series(self) -> None:
        missing = tuple(self.missing)
        if all(isinstance(number, (int, np.integer)) for number in missing):
            missing = tuple(sorted(missing, key=int))
        object.__setattr__(self, "missing", missing)
        for number in missing:
            _check_integer("the number of a missing slice", number, 2, self.slices - 1)
        if len(set(missing)) < len(missing):
            raise UsageError("a slice is named more than once among those that are missing")
        if self.phases * self.slices > 9999:
            raise UsageError(f"{self.phases} phases of {self.slices} slices are more than 9999 files")
        if self.ghosts:
            if self.uneven_mm or self.missing or self.phases > 1:
                raise UsageError("ghosts are for an even series of one phase without missing slices")
            ghost_places(self.slices)

    def _is_default(self, name: str) -> bool:
        return bool(getattr(self, name) == getattr(PhantomSettings, name))

    @property
    def _directions(self) -> tuple[float, tuple[float, float, float], bool]:
        return self.tilt, self.oblique, self.prone

    @property
    def spine_choice(self) -> SpineChoice | None:
        """What is chosen of a spine; None without levels, bend and facets."""
        if self.kind != "spine" or all(map(self._is_default, _CHOOSING)):
            return None
        return spine_choice(
            parse_levels(self.levels) if self.levels is not None else THORACOLUMBAR,
            (self.kyphosis_deg, self.scoliosis_deg),
            self.facet_gap_mm,
            centred=self.levels is not None,
            directions=self._directions,
            length_mm=None if self.slices is None else self.slices * self.spacing[2],
        )

    def _check_lying(self) -> None:
        if self.table is not None and self.table not in TABLE_NAMES:
            raise UsageError(unknown_name("table", self.table, TABLE_NAMES))
        lies = self.table is not None or self.table_gap_mm != 0.0 or self.prone
        if lies and KINDS[self.kind].table is None:
            raise UsageError(f"a {self.kind} lies on nothing: table, gap and prone are for spine and the other bodies")
        if self.table_gap_mm != 0.0 and self.table_used in ("none", "own"):
            names = ", ".join(TABLE_NAMES[1:])
            raise UsageError(f"a gap of {self.table_gap_mm:g} mm needs a table: name one of {names}")

    @property
    def table_used(self) -> str:
        """Name of the table; ``own`` is the spine's own couch, which is too thin to be a ghost."""
        return self.table or ("curved" if self.ghosts else KINDS[self.kind].table) or "none"

    @property
    def shape_kji(self) -> tuple[int, int, int]:
        return self.slices, self.size[1], self.size[0]

    def as_dict(self) -> dict[str, Any]:
        """All settings as JSON types; UIDs derive from them: later settings are left out where default."""
        plain = {
            name: list(value) if isinstance(value, tuple) else value for name, value in dataclasses.asdict(self).items()
        }
        for name in filter(self._is_default, _LATER):
            del plain[name]
        return plain


def _check_integer(name: str, value: Any, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise UsageError(f"{name} must be a whole number from {low} to {high}, got {value}")


def _check_number(name: str, value: Any, low: float, high: float, unit: str) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not low <= value <= high:
        raise UsageError(f"{name} must be a number from {low:g} to {high:g} {unit}, got {value}")
