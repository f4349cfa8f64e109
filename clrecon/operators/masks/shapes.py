"""What `Mask` is built on, step by step: bits that are joined, dilation and erosion by balls in mm, components."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import UsageError
from clrecon.geometry import Volume, slice_normal, slice_voxel_ml
from clrecon.geometry.affine import Float64Array, checked_points
from clrecon.opencl import Device
from clrecon.operators.masks import runs, voxel_mask
from clrecon.operators.masks.regions import checked_mm
from clrecon.operators.masks.voxel_mask import VoxelMask, mask_bytes, zero_words
from clrecon.points.stencil import SLACK, Lattice, Stencil, make_stencil
from clrecon.system.arguments import explains_arguments
from clrecon.system.text import format_digits

PIECE_WORDS = {
    "8": ocl.kernel_constant("masks/row_pieces.h", "CPU_PIECE_WORDS"),
    "1": ocl.kernel_constant("masks/row_pieces.h", "GPU_PIECE_WORDS"),
}
"""Words of a row that a work-item holds, by LANES."""

_MOST_VISITS = 1e11
"""Most visits of a row of the ball at a row of the volume: some minutes."""

_HALO_BITS = 32
"""Furthest that bits go along a row that is cut into pieces: a word."""

_ANY_NUMBER = 1 << 30
"""More voxels than any ball reaches."""


def ball_of(volume: Volume, radius: float, *, by_slice: bool = False) -> Stencil:
    """Return the voxels within ``radius * (1 + 1e-6)`` mm of a voxel, in the volume or in its own slice."""
    return _checked(make_stencil(Lattice.of(volume), radius), volume, radius, by_slice)


def reaches_beyond(volume: Volume, radius: float, *, by_slice: bool = False) -> bool:
    """Tell whether the balls round all voxels surely hold places beyond the volume."""
    ni, nj, _ = volume.shape_ijk
    lengths = np.linalg.norm(volume.affine[:3, :2], axis=0)
    ends = volume.slice_origins(1)[[0, -1]]
    along_k = np.inf if by_slice else float(np.linalg.norm(ends[1] - ends[0]))
    return bool(radius >= min(ni * lengths[0], nj * lengths[1], along_k))


def whole_ball_of(volume: Volume, radius: float, *, by_slice: bool = False) -> Stencil:
    """Return the same as `ball_of` with the rows beyond the volume, whose slices go on in the steps of its ends."""
    nk = volume.shape_ijk[2]
    origins = volume.slice_origins(1)
    heights = origins @ slice_normal(volume.affine)
    gap = float(min(abs(heights[1] - heights[0]), abs(heights[-1] - heights[-2])))
    beyond = int(radius * (1.0 + SLACK) / gap) + 1
    shape = _ANY_NUMBER, _ANY_NUMBER, beyond + 1
    if volume.uneven:
        lattice = Lattice((*shape[:2], nk + 2 * beyond), volume.affine, volume.slice_origins(beyond))
        ball = make_stencil(lattice, radius)
        ball = replace(ball, tables=ball.tables[beyond : beyond + nk])
    else:
        ball = make_stencil(Lattice(shape, volume.affine), radius)
        ball = replace(ball, tables=np.repeat(ball.tables[:1], nk, axis=0))
    return _checked(ball, volume, radius, by_slice)


def _checked(ball: Stencil, volume: Volume, radius: float, by_slice: bool) -> Stencil:
    if by_slice:
        # the rows of each voxel's own slice
        in_slice = ball.rows[:, 1] == 0
        before = np.concatenate([[0], np.cumsum(in_slice)]).astype(np.int32)
        ball = replace(ball, rows=ball.rows[in_slice], tables=before[ball.tables])
    visits = float((ball.tables[:, 1] - ball.tables[:, 0]).sum(dtype=np.int64)) * volume.shape_ijk[1]
    if visits > _MOST_VISITS:
        raise UsageError(
            f"a ball of {radius:g} mm makes {visits:.1e} visits of rows of the volume, {_MOST_VISITS:.0e} are allowed:"
            " choose a smaller radius"
        )
    return ball


def _split_rows(rows: NDArray[np.int32], most: int | None) -> NDArray[np.int32]:
    """Return rows (dj, dk, centre, half), the widest first, for rows (dj, dk, lowest di, highest di)."""
    low, high = rows[:, 2].astype(np.int64), rows[:, 3].astype(np.int64)
    half = (high - low) // 2
    if most is not None:
        half = np.minimum(half, most)
    # As many rows of one width as it takes, evenly: two where the number of voxels is even.
    count = -(-(high - low + 1) // (2 * half + 1))
    which = np.repeat(np.arange(len(rows)), count)
    rank = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    room = (high - low - 2 * half)[which]
    centre = low[which] + half[which] + np.where(rank == 0, 0, room * rank // np.maximum(count[which] - 1, 1))
    balls = np.stack([rows[which, 0], rows[which, 1], centre, half[which]], axis=1)
    return balls[np.lexsort((balls[:, 2], balls[:, 0], balls[:, 1], -balls[:, 3]))].astype(np.int32)


def _split_tables(ball: Stencil, most: int | None) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the rows of `_split_rows` of all tables, and where each table begins and ends."""
    parts: list[NDArray[np.int32]] = []
    done: dict[tuple[int, int], tuple[int, int]] = {}
    tables, count = np.empty_like(ball.tables), 0
    for k, (begin, end) in enumerate(ball.tables.tolist()):
        if (begin, end) not in done:
            parts.append(_split_rows(ball.rows[begin:end], most))
            done[begin, end] = count, count + len(parts[-1])
            count += len(parts[-1])
        tables[k] = done[begin, end]
    return np.concatenate(parts), tables


def spread_bits(device: Device, mask: VoxelMask, ball: Stencil, *, erode: bool = False, beyond: bool = False) -> Any:
    """Return the words of a mask that is dilated or eroded, (nk, nj, words) uint32.

    mask: Without zeros behind its rows.
    ball: For each slice the rows that its voxels look at; not only balls, but the voxel itself is among them.
    erode: Keep the voxels whose ball has no voxel that is not set; else set those whose ball has one that is set.
    beyond: What lies beyond the volume is set, else it is not.  The ball must then have its rows beyond, see
        `whole_ball_of`, where it matters: of erosion with False, of dilation with True.
    """
    ni, nj, nk = mask.shape_ijk
    words = mask.words
    piece = PIECE_WORDS[device.kernel_variants["LANES"]]
    halo = 0 if words <= piece and (ball.rows[:, 2] == -ball.rows[:, 3]).all() else 1
    step = piece - 2 * halo
    pieces = -(-words // step)
    rows, tables = _split_tables(ball, _HALO_BITS if halo else None)
    spread_d = ocl.allocate(device, 4 * words * nj * nk)
    program = ocl.load_program(device, "masks/balls.cl", {"LANES": device.kernel_variants["LANES"]})
    ocl.launch(
        device, program["spread_ball"], nj * nk * pieces, mask=mask.mask_d,
        row_extents=mask.row_extents_d, reach_j=int(np.abs(rows[:, 0]).max()), reach_k=int(np.abs(rows[:, 1]).max()),
        stencil=ocl.upload(device, rows), tables=ocl.upload(device, tables), spread=spread_d, ni=ni, nj=nj,
        nk=nk, words=words, pieces=pieces, piece=step, halo=halo, shifted=int(rows[:, 2].any()),
        flip=0xFFFFFFFF if erode else 0, beyond=0xFFFFFFFF if erode != beyond else 0,
    )  # fmt: skip
    return spread_d


PLACE_TOLERANCE_MM = 0.01
"""Voxels of two volumes that are no farther apart than this have the same position."""

Bits = TypeVar("Bits", bound="MaskBits")


class MaskBits:
    """One bit for each voxel of a volume, on a device; what `clrecon.Mask` is made of."""

    def __init__(self, volume: Volume, mask_d: Any, name: str, *, device: Device, memory: int | None = None):
        self.scan, self.device = volume, device
        self.memory, self.name = memory, name
        self._mask_d = mask_d
        self._extents: VoxelMask | None = None
        self._count: int | None = None

    def __reduce__(self) -> NoReturn:
        """Refuse to be pickled or copied: buffers stay with their process."""
        raise TypeError("a Mask belongs to its process: send to_numpy(), and make one there")

    def __repr__(self) -> str:
        ni, nj, nk = self.shape_ijk
        return f"Mask({self.name}: {self.count:,} of {ni} x {nj} x {nk} voxels)"

    @property
    def shape_ijk(self) -> tuple[int, int, int]:
        """Voxels along i, j and k."""
        return self.scan.shape_ijk

    @property
    def count(self) -> int:
        """Number of chosen voxels."""
        if self._count is None:
            self._count = voxel_mask.count_bits(self.device, self._mask_d, self.shape_ijk)
        return self._count

    @property
    def share(self) -> float:
        """Share of the volume's voxels that are chosen, 0 to 1."""
        return self.count / self.scan.voxels.size

    @property
    def ml(self) -> float:
        """Volume of the chosen voxels, ml; each slice reaches half way to its neighbours."""
        slice_ml = slice_voxel_ml(self.scan)
        if not self.scan.uneven:
            return self.count * float(slice_ml[0])
        return float(np.count_nonzero(self.to_numpy(), axis=(1, 2)) @ slice_ml)

    @property
    def bounds(self) -> Float64Array:
        """Lowest and highest corner of the box around the chosen voxels, shape (2, 3), LPS mm; NaN without any."""
        chosen = self.to_numpy()
        k, j = np.nonzero(chosen.any(axis=2))
        if not len(k):
            return np.full((2, 3), np.nan)
        rows = chosen[k, j]  # the ends of a row hold all between them
        ends = (rows.argmax(axis=1), rows.shape[1] - 1 - rows[:, ::-1].argmax(axis=1))
        places = np.concatenate([self.scan.ijk_to_lps(np.column_stack([i, j, k])) for i in ends])
        return np.array([places.min(axis=0), places.max(axis=0)])

    @property
    def bits(self) -> VoxelMask:
        """The words on the device, with the extents of the rows, for operators."""
        if self._extents is None:
            self._extents = voxel_mask.find_extents(self.device, self._mask_d, self.shape_ijk)
        return self._extents

    def layers(self) -> Iterator[NDArray[np.bool_]]:
        """Yield the chosen voxels of each slice, shape (nj, ni), bool: an eighth of the memory of `to_numpy`."""
        ni, nj, nk = self.shape_ijk
        words = ocl.download(self.device, np.empty((nk, nj, -(-ni // 32)), "<u4"), self._mask_d)
        for layer in words.view(np.uint8):
            yield np.unpackbits(layer, axis=1, count=ni, bitorder="little").view(np.bool_)

    def to_numpy(self) -> NDArray[np.bool_]:
        """Return the chosen voxels, shape (nk, nj, ni), bool."""
        array = np.empty(self.shape_ijk[::-1], np.bool_)
        for whole, layer in zip(array, self.layers(), strict=True):
            whole[...] = layer
        return array

    __array_ufunc__ = None  # an array and a mask have no common operators

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the chosen voxels, shape (nk, nj, ni), bool, for numpy: always a copy."""
        if copy is False:
            raise ValueError("the bits of a mask are an array only as a copy")
        return self.to_numpy().astype(np.bool_ if dtype is None else dtype, copy=False)

    # Logic

    def __and__(self: Bits, other: Bits) -> Bits:
        return self._combined(other, "and")

    def __or__(self: Bits, other: Bits) -> Bits:
        return self._combined(other, "or")

    def __xor__(self: Bits, other: Bits) -> Bits:
        return self._combined(other, "xor")

    def __sub__(self: Bits, other: Bits) -> Bits:
        return self._combined(other, "and not")

    def __invert__(self: Bits) -> Bits:
        self._check_budget(2)
        made_d = voxel_mask.invert(self.device, self._mask_d, self.shape_ijk)
        return self._made(made_d, f"not ({self.name})")

    def _combined(self: Bits, other: Bits, operation: str) -> Bits:
        if not isinstance(other, MaskBits):
            return NotImplemented
        self._check_frame(other.scan)
        self._check_budget(3)
        other_d = other._mask_d
        if other.device is not self.device:  # a device failed, and another took over
            ni, nj, nk = self.shape_ijk
            words = ocl.download(other.device, np.empty(-(-ni // 32) * nj * nk, np.uint32), other_d)
            other_d = ocl.upload(self.device, words)
        made_d = voxel_mask.combine(self.device, self._mask_d, other_d, self.shape_ijk, operation)
        return self._made(made_d, f"({self.name}) {operation} ({other.name})")

    # How

    def _made(self: Bits, mask_d: Any, name: str) -> Bits:
        return type(self)(self.scan, mask_d, name, device=self.device, memory=self.memory)

    def _check_budget(self, masks: int, **more: int) -> None:
        size = mask_bytes(self.shape_ijk)["mask of the voxels"]
        ocl.check_budget(self.device, {f"{masks} masks of the voxels": masks * size, **more}, self.memory)

    def _check_frame(self, volume: Volume) -> None:
        """Refuse a volume whose voxels lie elsewhere."""
        scan = self.scan
        if volume is scan:
            return
        if volume.shape_ijk != scan.shape_ijk:
            raise UsageError(f"the mask has {scan.shape_ijk} voxels, the other volume {volume.shape_ijk}")
        ni, nj, _ = scan.shape_ijk
        turned = np.abs((volume.affine - scan.affine)[:3, :2] * (ni, nj)).max()
        away = max(float(turned), float(np.abs(volume.slice_origins() - scan.slice_origins()).max()))
        if away > PLACE_TOLERANCE_MM:
            raise UsageError(f"the voxels of the mask and of the other volume lie up to {format_digits(away)} mm apart")

    # Balls

    @explains_arguments
    def dilate(self: Bits, mm: float, *, by_slice: bool = False) -> Bits:
        """Choose all voxels within a distance of a chosen voxel.

        The distance is that of the voxels' centres in the patient: the result is that of a distance transform in mm
        that is at most `mm` (1 + 1e-6).  Tilted, oblique and uneven stacks are exact.

        mm: Above 0; below every step of the voxels nothing changes.
        by_slice: Within each slice alone, by discs.
        """
        return self._made(self._spread(mm, by_slice), f"({self.name}) dilated by {mm:g} mm")

    @explains_arguments
    def erode(self: Bits, mm: float, *, by_slice: bool = False) -> Bits:
        """Choose the voxels that have no other voxel than chosen ones within a distance.

        Nothing beyond the volume is chosen, so that what reaches its border is eroded from there too.

        mm, by_slice: As for `dilate`.
        """
        return self._made(self._erode(mm, by_slice), f"({self.name}) eroded by {mm:g} mm")

    @explains_arguments
    def open(self: Bits, mm: float, *, by_slice: bool = False) -> Bits:
        """Erode, then dilate: all balls of this radius that fit into what is chosen and into the volume.

        mm, by_slice: As for `dilate`.
        """
        eroded = self._made(self._erode(mm, by_slice), self.name)
        return self._made(eroded._spread(mm, by_slice), f"({self.name}) opened by {mm:g} mm")

    @explains_arguments
    def close(self: Bits, mm: float, *, by_slice: bool = False) -> Bits:
        """Dilate, then erode: gaps into which no ball of this radius fits are filled.

        What lies beyond the volume counts as chosen for the erosion, so that all that was chosen stays.

        mm, by_slice: As for `dilate`.
        """
        dilated = self._made(self._spread(mm, by_slice), self.name)
        return self._made(dilated._spread(mm, by_slice, erode=True, beyond=True), f"({self.name}) closed by {mm:g} mm")

    @explains_arguments
    def dilate_within(self: Bits, room: Bits, mm: float) -> Bits:
        """Choose the voxels of another mask that short ways over faces of its voxels join with chosen ones.

        A way takes a step along i, j or k at a time; along each axis it may be as long as `mm`, in whole steps rounded
        up.  Along an axis whose step is longer than `mm` there is none.

        room: Of the same volume.
        mm: Above 0.
        """
        radius = checked_mm(mm, "the length of the ways")
        steps = np.array(self.scan.spacing)
        most = np.where(steps <= radius * (1.0 + SLACK), np.ceil(radius / steps - SLACK), 0).astype(int)
        reached = self
        for done in range(int(most.max())):
            self._check_budget(4)
            cross = _cross_of(self.scan, most > done)
            spread = self._made(spread_bits(self.device, reached.bits, cross), self.name)
            reached = reached | (spread & room)
            ocl.wait(self.device)  # the masks of commands that wait in the queue are all in memory
        return self._made(reached._mask_d, f"({self.name}) dilated by {mm:g} mm within ({room.name})")

    def _erode(self, mm: float, by_slice: bool) -> Any:
        radius = checked_mm(mm, "the radius of the ball")
        if not reaches_beyond(self.scan, radius, by_slice=by_slice):
            return self._spread(mm, by_slice, erode=True, whole=True)
        self._check_budget(2)
        return zero_words(self.device, mask_bytes(self.shape_ijk)["mask of the voxels"] // 4)

    def _spread(
        self, mm: float, by_slice: bool, *, erode: bool = False, beyond: bool = False, whole: bool = False
    ) -> Any:
        radius = checked_mm(mm, "the radius of the ball")
        ball = (whole_ball_of if whole else ball_of)(self.scan, radius, by_slice=by_slice)
        size, extents = mask_bytes(self.shape_ijk).values()
        rows = 2 * ball.rows.nbytes + ball.tables.nbytes
        needs = {"2 masks of the voxels": 2 * size, "row extents": extents, "rows of the ball": rows}
        ocl.check_budget(self.device, needs, self.memory)
        return spread_bits(self.device, self.bits, ball, erode=erode, beyond=beyond)

    # Components

    @explains_arguments
    def fill_holes(self: Bits, *, by_slice: bool = False) -> Bits:
        """Choose the voxels that chosen ones enclose too.

        Enclosed is what no way over faces of voxels that are not chosen joins with the border of the volume.

        by_slice: In each slice alone: what its chosen voxels enclose in the slice.
        """
        self._check_budget(3)
        device, shape = self.device, self.shape_ijk
        size = mask_bytes(self.shape_ijk)["mask of the voxels"]
        rest = voxel_mask.find_extents(device, voxel_mask.invert(device, self._mask_d, shape), shape)
        holes = runs.find_components(device, rest, by_slice=by_slice, beside=2 * size, memory=self.memory)
        filled_d = ocl.allocate(device, size)
        ocl.copy_buffer(device, self._mask_d, filled_d, size)
        if holes.count:
            marks_d = runs.mark_at_border(device, holes, shape, by_slice=by_slice)
            runs.write_runs(self.device, holes, marks_d, filled_d, self.shape_ijk, wanted=0)
        return self._made(filled_d, f"({self.name}) with holes filled" + " slice by slice" * by_slice)

    def grow(self: Bits, points_mm: ArrayLike) -> Bits:
        """Choose the components that hold a point: chosen voxels joined with it by faces of chosen voxels.

        points_mm: array_like, shape (n, 3) or (3,). LPS mm; each belongs to the voxel whose centre is nearest along
            the axes of the volume.
        """
        points = checked_points(points_mm)
        if not len(points) or not np.isfinite(points).all():
            raise UsageError(f"to grow needs points that are numbers, these are {len(points)} points")
        device, shape = self.device, self.shape_ijk
        size = mask_bytes(self.shape_ijk)["mask of the voxels"]
        voxels = self._find_voxels(points)
        parts = runs.find_components(device, self.bits, beside=size, memory=self.memory)
        if not parts.count:
            raise UsageError(f"no voxel is chosen ({self.name}): nothing can grow")
        marks_d, components = runs.mark_with_voxels(device, parts, shape, voxels)
        if (components < 0).any():
            raise UsageError(self._describe_miss(points[components < 0][0], "lies in a voxel that is not chosen"))
        grown_d = zero_words(device, size // 4)
        runs.write_runs(self.device, parts, marks_d, grown_d, self.shape_ijk)
        return self._made(grown_d, f"({self.name}) grown from {len(points)} point{'s' * (len(points) != 1)}")

    @explains_arguments
    def components(self: Bits, most: int = 100) -> list[Bits]:
        """Return the components as masks, the largest first: chosen voxels that are joined by faces of chosen voxels.

        Parameters
        ----------
        most : int
            Smaller ones than so many are left out.
        """
        parts, sizes = self._measure_components(most)
        largest = np.argsort(-sizes, kind="stable")[:most]
        return [self._choose(parts, largest[n : n + 1], f"component {n + 1}") for n in range(len(largest))]

    @explains_arguments
    def keep_largest(self: Bits, count: int = 1) -> Bits:
        """Return the `count` largest components in one mask; joined as in `components`."""
        parts, sizes = self._measure_components(count)
        label = "the largest component" if count == 1 else f"the {count} largest components"
        return self._choose(parts, np.argsort(-sizes, kind="stable")[:count], label)

    def _measure_components(self, wanted: int) -> tuple[runs.Components, Float64Array]:
        if isinstance(wanted, bool) or not isinstance(wanted, int | np.integer) or wanted < 1:
            raise UsageError(f"a number of components is a whole number from 1 on, not {wanted!r}")
        size = mask_bytes(self.shape_ijk)["mask of the voxels"]
        parts = runs.find_components(self.device, self.bits, beside=2 * size, memory=self.memory)
        if not parts.count:
            return parts, np.empty(0)
        return parts, runs.RunList.read(self.device, parts, self.shape_ijk).sum_ml(self.scan, parts.count)

    def _choose(self: Bits, parts: runs.Components, numbers: NDArray[np.integer], label: str) -> Bits:
        chosen_d = zero_words(self.device, mask_bytes(self.shape_ijk)["mask of the voxels"] // 4)
        if len(numbers):
            marks = np.zeros(4 * -(-parts.count // 4), np.uint8)
            marks[numbers] = 1
            runs.write_runs(self.device, parts, ocl.upload(self.device, marks), chosen_d, self.shape_ijk)
        return self._made(chosen_d, f"{label} of ({self.name})")

    def _find_voxels(self, points: Float64Array) -> NDArray[np.int32]:
        ijk = np.floor(self.scan.lps_to_ijk(points) + 0.5)
        outside = ((ijk < 0) | (ijk >= self.shape_ijk)).any(axis=1)
        if outside.any():
            raise UsageError(self._describe_miss(points[outside][0], "lies outside of the volume"))
        return ijk.astype(np.int32)

    def _describe_miss(self, point: Float64Array, problem: str) -> str:
        """Return the message for a point that nothing can grow from."""
        position = ", ".join(f"{x:.1f}" for x in point)
        least = np.inf
        for chosen, origin in zip(self.to_numpy(), self.scan.slice_origins(), strict=True):
            rows = np.argwhere(chosen)
            if len(rows):
                places = origin + rows[:, ::-1] @ self.scan.affine[:3, :2].T
                least = min(least, float(np.linalg.norm(places - point, axis=1).min()))
        near = f"no voxel is chosen ({self.name})"
        if np.isfinite(least):
            near = f"the nearest voxel that is chosen ({self.name}) is {least:.1f} mm away"
        return f"the point ({position}) mm {problem}: {near}"


def _cross_of(volume: Volume, axes: NDArray[np.bool_]) -> Stencil:
    """Return the neighbours of a voxel by its faces along some of the axes i, j, k, and itself."""
    rows = [[0, 0, -int(axes[0]), int(axes[0])]]
    rows += [[step, 0, 0, 0] for step in (-1, 1) if axes[1]] + [[0, step, 0, 0] for step in (-1, 1) if axes[2]]
    nk = volume.shape_ijk[2]
    tables = np.tile(np.array([[0, len(rows)]], np.int32), (nk, 1))
    in_plane = 1 + 2 * int(axes[0]) + 2 * int(axes[1])
    members = in_plane + 2 * int(axes[2])
    return Stencil(np.array(rows, np.int32), tables, in_plane, (members, members), int(axes[0]))
