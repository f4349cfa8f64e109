"""Slabs of the sample grid: the slices that a part of a surface needs, and how many fit a device."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

from clrecon.geometry import Volume, is_left_handed
from clrecon.geometry.iso_rule import IsoRule
from clrecon.operators.primitives.scan import BitRows
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.system.light_dataclass import dataclass

BRICKS = "brick ranges"
"""Name of the object that surfaces keep for a whole volume."""


@dataclass(frozen=True)
class SampleGrid(BitRows):
    """The samples of a volume with its border, packed in the inside mask; kept for the whole grid where it `grows`."""

    volume: Volume
    rule: IsoRule
    grows: bool = False

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """Number of samples (gi, gj, gk)."""
        gi, gj, gk = (n + 2 * self.rule.border for n in self.volume.shape_ijk)
        return gi, gj, gk

    @property
    def kind(self) -> str:
        """Key of the grid: grids with the same key need the same memory."""
        grown = "grown " * self.grows
        return f"{grown}{self.rule.topology} surface with a border of {self.rule.border}"

    @property
    def row_shift(self) -> int:
        """A word's number is its row times 2^row_shift plus its place in the row; rows have a multiple of 32 words."""
        return max(5, (self.words - 1).bit_length())

    @property
    def flag_words(self) -> int:
        return 1 << (self.row_shift - 5)

    @property
    def winds_backwards(self) -> bool:
        """The winding of the case table is reversed: in a left-handed volume, or to enclose values below the level."""
        return is_left_handed(self.volume.affine) != (self.rule.inside == "below")


@dataclass(frozen=True)
class Slab:
    """Slices `first` to ``end - 1`` of a sample grid, with the neighbouring slices that their part of a surface needs.

    The slab's rows own the vertices on edges towards slice `end`. Its triangles also refer to vertices of slice `end`,
    whose owners need one slice more.  Gradients need one more slice at both ends.
    """

    grid: SampleGrid
    first: int
    end: int

    @property
    def slices(self) -> int:
        """Slices whose vertices and cells belong to the slab."""
        return self.end - self.first

    @property
    def is_whole(self) -> bool:
        return self.slices == self.grid.shape[2]

    @property
    def mask_slices(self) -> int:
        return min(self.end + 2, self.grid.shape[2]) - self.first

    @property
    def rows(self) -> int:
        """Rows whose vertices and cells belong to the slab."""
        return self.slices * self.grid.shape[1]

    @property
    def mask_rows(self) -> int:
        return self.mask_slices * self.grid.shape[1]

    @property
    def counted_rows(self) -> int:
        """Rows whose vertices are counted: one slice more than the slab's own."""
        return (min(self.end + 1, self.grid.shape[2]) - self.first) * self.grid.shape[1]

    @property
    def voxel_slices(self) -> tuple[int, int]:
        """First and end of the slices of the volume that the slab reads."""
        border, nk = self.grid.rule.border, self.grid.volume.shape_ijk[2]
        return max(self.first - border - 1, 0), min(self.end - border + 2, nk)

    @property
    def arguments(self) -> dict[str, int]:
        """Arguments about the place of the slab, for kernels."""
        (ni, nj, nk), rule = self.grid.volume.shape_ijk, self.grid.rule
        return {
            "ni": ni,
            "nj": nj,
            "nk": nk,
            "border": rule.border,
            "first_slice": self.voxel_slices[0],
            "first_sample_slice": self.first,
            "gk": self.mask_slices,
            "words": self.grid.words,
        }

    def scratch(self) -> dict[str, int]:
        """Return the most bytes of every buffer between the volume and the mesh, by description."""
        counted_words = self.counted_rows * self.grid.words
        cell_vertices = 8 * self.counted_rows + 2 * self.rows * self.grid.words
        grown = 4 * self.grid.shape[1] * self.grid.shape[2] * (self.grid.words + 1)
        return {
            **({"grown samples": grown} if self.grid.grows else {}),
            **({"cell vertices": cell_vertices} if self.grid.rule.topology == "trilinear" else {}),
            "inside mask": 4 * self.mask_rows * self.grid.words,
            "word counts": 4 * counted_words,
            "row extents": 4 * self.mask_rows,
            "row counts": 12 * self.counted_rows,
            "word flags": 4 * self.counted_rows * self.grid.flag_words,
            "active words": 4 * self.rows * self.grid.words,
        }

    def volume_bytes(self) -> int:
        first, end = self.voxel_slices
        ni, nj, _ = self.grid.volume.shape_ijk
        return (end - first) * ni * nj * int(self.grid.volume.voxels.dtype.itemsize)

    def needs(self, output: Mapping[str, int] | None = None) -> dict[str, int]:
        """Return the bytes of every buffer that exists at the same time."""
        return {"volume": self.volume_bytes(), **self.scratch(), **(output or {})}


OUTPUT_SHARE = 8
"""With slabs, an eighth of the memory is kept free for the mesh.  Bone needs less, noise more; a slab whose mesh does
not fit is halved."""

MOST_WORDS = 2**32
"""Word numbers of a slab have 32 bits, of which the place in the row takes `SampleGrid.row_shift`."""


def plan_slabs(grid: SampleGrid, resident: DeviceVolume) -> int:
    """Return the number of slices in a slab: all if the whole grid fits the device, else as many as fit."""
    gk = grid.shape[2]
    limits = resident.limits
    mesh_bytes = min(limits.total_bytes // OUTPUT_SHARE, limits.buffer_bytes)

    def needs(slices: int) -> dict[str, int]:
        # A slab in the middle of the grid: no other slab with as many slices needs more.
        first = max(0, min(2, gk - slices))
        return Slab(grid, first, first + slices).needs({} if slices == gk else {"mesh": mesh_bytes})

    # A slab classifies two more slices than it owns.
    most_mask_slices = (MOST_WORDS - 1) // (grid.shape[1] << grid.row_shift)
    most = None if gk <= most_mask_slices else most_mask_slices - 2
    slices = resident.plan(grid.kind, gk, needs, counted=(BRICKS,), most=most)
    if slices == 0:
        first = min(2, gk - 1)
        needed = sum(Slab(grid, first, first + 1).needs().values())
        raise limits.refusal(f"one slice with its neighbours needs {needed:,} bytes, and room for its mesh")
    return slices
