"""Facts of an input of any format: what its voxels showed, how they were stored, what a listing says of it."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from clrecon.errors import ClreconError
from clrecon.geometry.certificate import Certificate
from clrecon.system.light_dataclass import asdict, dataclass, field
from clrecon.system.packages import ShownAsHtml


@dataclass(frozen=True)
class PixelFacts:
    """Figures of the pixels that were read, padding included, which was filled with `padding_hu`, None without any.

    stray: Number of values that lost bits of their own, see `clrecon.reading.dicom.pixels.voxels`.
    padding_text: Of padding that no header declares and that was found by its shape, or that masks tissue.
    disc: Value that fills the outside of a round field of view without a header that declares it.
    blank: Slices of one value alone among others, from 0.
    """

    padding_share: float
    hu_min: float
    hu_max: float
    padding_hu: float | None = None
    stray: int = 0
    stray_text: str = ""
    padding_text: str = ""
    disc: float | None = None
    blank: tuple[int, ...] = ()


class StoredValues(Protocol):
    """What a header says of the values of its slice; slope and intercept of the rescale to HU."""

    @property
    def bits_stored(self) -> int: ...
    @property
    def signed(self) -> bool: ...
    @property
    def slope(self) -> float: ...
    @property
    def intercept(self) -> float: ...


class StoredRange(NamedTuple):
    """The same of a file that has one type for all slices."""

    bits_stored: int
    signed: bool
    slope: float
    intercept: float


@dataclass(frozen=True)
class SeriesEntry:
    """One line of a listing; docs/contract.md explains the entries, and `as_dict` is their machine-readable form."""

    _SHOWN = ("number", "modality", "slices", "shape_ijk", "spacing_mm")
    number: int
    uid_hash: str | None
    description: str
    modality: str
    slices: int
    shape_ijk: list[int] | None
    spacing_mm: list[float] | None
    affine_ijk_to_lps_mm: list[list[float]] | None
    tilt_deg: float | None
    grid_residual_max_mm: float | None
    gap_mm: dict[str, float | None]
    uneven: bool | None
    warnings: list[str]
    problems: list[str]
    patient: int | None = None
    study: int | None = None
    kind: str = "stack"
    phases: list[dict[str, Any]] = field(default_factory=list)
    extent_mm: list[float] | None = None
    slice_thickness_mm: float | None = None
    dropped: dict[str, int] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class SeriesListing(ShownAsHtml):
    """The series at a path.

    chosen: Number of the series that `read_volume` reads for the same ``series``; None where it would not choose.
    skipped: Maps a reason to the number of files passed over.
    certificate: Of the chosen series, even if it is refused; None where none of its slices has a valid header.
    """

    series: list[SeriesEntry]
    chosen: int | None
    skipped: dict[str, int]
    warnings: list[str]
    certificate: Certificate | None = None
    refusal: ClreconError | None = None

    def __repr__(self) -> str:
        return f"SeriesListing({len(self.series)} series, chosen={self.chosen}, {len(self.warnings)} warnings)"
