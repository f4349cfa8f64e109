"""Dilation and erosion of masks by balls in mm: the host side of cl/masks/balls.cl."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume, slice_normal
from clrecon.opencl import Device, Program, Stopwatch, allocate, kernel_constant, launch, load_program, upload
from clrecon.operators.masks.band_mask import VoxelMask
from clrecon.points.stencil import SLACK, Lattice, Stencil, make_stencil

PIECE_WORDS = {
    "8": kernel_constant("masks/row_pieces.h", "CPU_PIECE_WORDS"),
    "1": kernel_constant("masks/row_pieces.h", "GPU_PIECE_WORDS"),
}
"""Words of a row that a work-item holds, by LANES."""

MOST_VISITS = 1e11
"""Most visits of a row of the ball at a row of the volume: some minutes."""

HALO_BITS = 32
"""Furthest that bits go along a row that is cut into pieces: a word."""

ANY_NUMBER = 1 << 30
"""More voxels than any ball reaches."""


def prepare_balls(device: Device) -> Program:
    """Build the kernels."""
    return load_program(device, "masks/balls.cl", {"LANES": device.kernel_variants["LANES"]})


def ball_of(volume: Volume, radius: float, *, by_slice: bool = False) -> Stencil:
    """Return the voxels within ``radius * (1 + 1e-6)`` mm of a voxel, for each slice, as far as they are in the volume.

    The places of the voxels count: those of oblique, tilted and uneven stacks too.

    radius: mm, above 0.
    by_slice: In the voxel's own slice alone: a disc.
    """
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
    shape = ANY_NUMBER, ANY_NUMBER, beyond + 1
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
        ball = _flat(ball)
    visits = float((ball.tables[:, 1] - ball.tables[:, 0]).sum(dtype=np.int64)) * volume.shape_ijk[1]
    if visits > MOST_VISITS:
        raise UsageError(
            f"a ball of {radius:g} mm makes {visits:.1e} visits of rows of the volume, {MOST_VISITS:.0e} are allowed:"
            " choose a smaller radius"
        )
    return ball


def _flat(ball: Stencil) -> Stencil:
    """Return the rows of each voxel's own slice."""
    own = ball.rows[:, 1] == 0
    before = np.concatenate([[0], np.cumsum(own)]).astype(np.int32)
    return replace(ball, rows=ball.rows[own], tables=before[ball.tables])


def _split(rows: NDArray[np.int32], most: int | None) -> NDArray[np.int32]:
    """Return rows (dj, dk, centre, half), the widest first, for rows (dj, dk, lowest di, highest di)."""
    low, high = rows[:, 2].astype(np.int64), rows[:, 3].astype(np.int64)
    half = (high - low) // 2
    if most is not None:
        half = np.minimum(half, most)
    # As many rows of one width as it takes, evenly: two where the number of voxels is even.
    count = -(-(high - low + 1) // (2 * half + 1))
    which = np.repeat(np.arange(len(rows)), count)
    place = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    room = (high - low - 2 * half)[which]
    centre = low[which] + half[which] + np.where(place == 0, 0, room * place // np.maximum(count[which] - 1, 1))
    made = np.stack([rows[which, 0], rows[which, 1], centre, half[which]], axis=1)
    return made[np.lexsort((made[:, 2], made[:, 0], made[:, 1], -made[:, 3]))].astype(np.int32)


def _split_tables(ball: Stencil, most: int | None) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the rows of `_split` of all tables, and where each table begins and ends."""
    parts: list[NDArray[np.int32]] = []
    done: dict[tuple[int, int], tuple[int, int]] = {}
    tables, count = np.empty_like(ball.tables), 0
    for k, (begin, end) in enumerate(ball.tables.tolist()):
        if (begin, end) not in done:
            parts.append(_split(ball.rows[begin:end], most))
            done[begin, end] = count, count + len(parts[-1])
            count += len(parts[-1])
        tables[k] = done[begin, end]
    return np.concatenate(parts), tables


def table_bytes(ball: Stencil) -> int:
    """Return about how many bytes the rows of a ball take on the device."""
    return 2 * ball.rows.nbytes + ball.tables.nbytes


def spread_bits(
    device: Device,
    mask: VoxelMask,
    ball: Stencil,
    *,
    erode: bool = False,
    beyond: bool = False,
    stopwatch: Stopwatch | None = None,
) -> Any:
    """Return the words of a mask that is dilated or eroded.

    mask: Without zeros behind its rows.
    ball: For each slice the rows that its voxels look at; not only balls, but the voxel itself is among them.
    erode: Keep the voxels whose ball has no voxel that is not set; else set those whose ball has one that is set.
    beyond: What lies beyond the volume is set, else it is not.  The ball must then have its rows beyond, see
        `whole_ball_of`, where it matters: of erosion with False, of dilation with True.

    Returns: buffer, (nk, nj, words) uint32
    """
    ni, nj, nk = mask.shape_ijk
    words = mask.words
    piece = PIECE_WORDS[device.kernel_variants["LANES"]]
    halo = 0 if words <= piece and (ball.rows[:, 2] == -ball.rows[:, 3]).all() else 1
    step = piece - 2 * halo
    pieces = -(-words // step)
    rows, tables = _split_tables(ball, HALO_BITS if halo else None)
    spread_d = allocate(device, 4 * words * nj * nk)
    launch(
        device, prepare_balls(device)["spread_ball"], nj * nk * pieces, stopwatch=stopwatch, mask=mask.mask_d,
        row_extents=mask.row_extents_d, reach_j=int(np.abs(rows[:, 0]).max()), reach_k=int(np.abs(rows[:, 1]).max()),
        stencil=upload(device, rows), tables=upload(device, tables), spread=spread_d, ni=ni, nj=nj,
        nk=nk, words=words, pieces=pieces, piece=step, halo=halo, shifted=int(rows[:, 2].any()),
        flip=0xFFFFFFFF if erode else 0, beyond=0xFFFFFFFF if erode != beyond else 0,
    )  # fmt: skip
    return spread_d
