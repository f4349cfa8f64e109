"""`make_stencil` equals a search over all offsets, in even, sheared and uneven stacks."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from uneven_volume import uneven

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.points.stencil import Lattice, Stencil, make_stencil

SHEARED = np.array([[0.7, 0.1, 0.05, -50.0], [-0.1, 0.5, 0.62, -30.0], [0.0, 0.05, 0.9, -146.0], [0.0, 0.0, 0.0, 1.0]])
THORACIC = np.diag((0.644531, 0.644531, 0.8, 1.0))


def volume_of(affine: np.ndarray, shape: tuple[int, int, int] = (7, 9, 11)) -> Volume:
    return Volume(np.zeros(shape, np.int8), affine)


def offsets_of(stencil: Stencil, k: int) -> set[tuple[int, int, int]]:
    """(di, dj, dk) of the members of the stencil of slice k."""
    begin, end = stencil.tables[k]
    return {(di, int(dj), int(dk)) for dj, dk, low, high in stencil.rows[begin:end] for di in range(low, high + 1)}


def offsets_by_search(volume: Volume, k: int, eps: float) -> set[tuple[int, int, int]]:
    """The same by the distances of all voxels from one in each row and column: offsets that no voxel has are out."""
    found = set()
    ijk = np.argwhere(np.ones(volume.voxels.shape, bool))[:, ::-1]
    places = volume.ijk_to_lps(ijk)
    for i, j in [(0, 0), (volume.shape_ijk[0] - 1, volume.shape_ijk[1] - 1), (0, volume.shape_ijk[1] - 1),
                 (volume.shape_ijk[0] - 1, 0)]:  # fmt: skip
        away = np.linalg.norm(places - volume.ijk_to_lps([[i, j, k]]), axis=1)
        found |= {tuple(row) for row in (ijk[away <= eps * (1 + 1e-6)] - (i, j, k)).tolist()}
    return found


@pytest.mark.parametrize("eps", [0.3, 0.644531, 0.8, 1.2, 2.0, 3.7, 50.0])
@pytest.mark.parametrize("which", ["thoracic", "sheared", "mirrored", "uneven", "uneven mirrored"])
def test_members_are_those_within_eps(which: str, eps: float) -> None:
    volume = {
        "thoracic": lambda: volume_of(THORACIC),
        "sheared": lambda: volume_of(SHEARED),
        "mirrored": lambda: volume_of(SHEARED @ np.diag((1.0, -1.0, -1.0, 1.0))),
        "uneven": uneven,
        "uneven mirrored": lambda: uneven(sign=-1.0),
    }[which]()
    stencil = make_stencil(Lattice.of(volume), eps)
    nk = volume.shape_ijk[2]
    assert stencil.tables.shape == (nk, 2)
    for k in range(nk):
        within = {offset for offset in offsets_of(stencil, k) if 0 <= k + offset[2] < nk}
        assert within == offsets_by_search(volume, k, eps)


def test_two_voxels_see_each_other_or_neither_does() -> None:
    volume = uneven()
    stencil = make_stencil(Lattice.of(volume), 1.9)
    seen = {(k, di, dj, dk) for k in range(volume.shape_ijk[2]) for di, dj, dk in offsets_of(stencil, k)}
    assert {(k + dk, -di, -dj, -dk) for k, di, dj, dk in seen} == seen
    assert any(dk for _, _, _, dk in seen)


def test_stencils_of_known_scans_have_the_members_of_the_design() -> None:
    """Members that the design of the clusters names: 19 at 0.8 mm gaps and eps 1.2, 275 at 4.25 mm and eps 6.4."""
    thoracic = make_stencil(Lattice((512, 512, 95), THORACIC), 1.2)
    assert (thoracic.in_plane, thoracic.members) == (9, (19, 19))
    lumbar = Lattice((512, 512, 99), np.diag((0.976562, 0.976562, 4.25, 1.0)))
    assert lumbar.default_eps == pytest.approx(6.375)
    assert make_stencil(lumbar, 6.4).members == (275, 275)


def test_an_eps_of_one_slice_gap_reaches_the_next_slice() -> None:
    gap = 0.1 + 0.2  # not 0.3
    lattice = Lattice((5, 5, 5), np.diag((1.0, 1.0, gap, 1.0)))
    assert make_stencil(lattice, 0.3).members == (3, 3)
    assert make_stencil(lattice, 0.3 * (1 - 3e-6)).is_alone


def test_the_diagonal_decides_whether_a_volume_lies_within_eps() -> None:
    """Of a box of 3 x 4 x 5 steps of 1 mm, and of an uneven stack of 6 slices."""
    box = Lattice((4, 5, 6), np.eye(4))
    assert make_stencil(box, 50.0**0.5).holds((4, 5, 6)) and not make_stencil(box, 7.0).holds((4, 5, 6))
    volume = uneven()
    corners = volume.ijk_to_lps([(i, j, k) for i in (0, 3) for j in (0, 4) for k in range(6)])
    longest = np.linalg.norm(corners[:, None] - corners, axis=2).max()
    lattice = Lattice.of(volume)
    assert make_stencil(lattice, longest).holds(volume.shape_ijk)
    assert not make_stencil(lattice, longest - 0.001).holds(volume.shape_ijk)


def test_slices_with_the_same_neighbours_share_a_table() -> None:
    places = np.array([(0.0, 0.0, z) for z in (0, 1, 2, 3, 4, 9)])
    tables = make_stencil(Lattice((3, 3, 6), np.eye(4), places), 1.0).tables.tolist()
    assert tables[1] == tables[2] == tables[3]
    assert len({tuple(table) for table in tables}) == 4


def test_rows_are_sorted_by_distance() -> None:
    stencil = make_stencil(Lattice((30, 30, 30), THORACIC), 3.0)
    middle = np.stack([(stencil.rows[:, 2] + stencil.rows[:, 3]) / 2, stencil.rows[:, 0], stencil.rows[:, 1]], axis=1)
    assert (np.diff(np.linalg.norm(middle * np.diag(THORACIC)[:3], axis=1)) > -1e-9).all()


def test_forward_rows_and_their_mirror_are_the_whole_stencil() -> None:
    for lattice in (Lattice((30, 30, 30), SHEARED), Lattice.of(uneven())):
        stencil = make_stencil(lattice, 2.4)
        forward = stencil.forward()
        for k in range(lattice.shape_ijk[2]):
            ahead = offsets_of(forward, k)
            assert all((dk, dj, di) > (0, 0, 0) for di, dj, dk in ahead)
            assert {offset for offset in offsets_of(stencil, k) if offset[::-1] > (0, 0, 0)} == ahead


def test_default_eps_takes_the_largest_step() -> None:
    assert Lattice((4, 4, 4), np.diag((2.0, 0.5, 1.0, 1.0))).default_eps == 3.0
    assert Lattice((4, 4, 1), np.diag((0.5, 0.5, 9.0, 1.0))).default_eps == 0.75  # a single slice has no gap
    own = uneven()
    assert Lattice.of(own).default_eps == pytest.approx(1.5 * 5.0)  # the widest gap of the uneven slices
    tilted = np.array([[0.5, 0, 0, 0], [0, 0.5, 1.0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1.0]])
    assert Lattice((4, 4, 4), tilted).largest_gap == pytest.approx(2.0)


@pytest.mark.parametrize("eps", [0.0, -1.0, float("nan"), float("inf"), "1", True, None])
def test_bad_eps_is_refused(eps) -> None:
    with refused(UsageError, 0.0, "distance"):
        make_stencil(Lattice((4, 4, 4), np.eye(4)), eps)
