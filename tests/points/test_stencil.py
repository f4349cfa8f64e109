"""`make_stencil` equals a search over all offsets, in even, sheared and uneven stacks."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from uneven_volume import uneven

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.points.stencil import Lattice, Stencil, make_stencil

SHEARED = np.array([[0.7, 0.1, 0.05, -50.0], [-0.1, 0.5, 0.62, -30.0], [0.0, 0.05, 0.9, -146.0], [0.0, 0.0, 0.0, 1.0]])
THORACIC = np.diag((0.644531, 0.644531, 0.8, 1.0))


def empty_volume(affine: np.ndarray, shape: tuple[int, int, int] = (7, 9, 11)) -> Volume:
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


VOLUMES = {
    "thoracic": empty_volume(THORACIC),
    "sheared": empty_volume(SHEARED),
    "mirrored": empty_volume(SHEARED @ np.diag((1.0, -1.0, -1.0, 1.0))),
    "uneven": uneven(),
    "uneven mirrored": uneven(sign=-1.0),
}


@pytest.mark.parametrize("eps_mm", [0.3, 0.644531, 0.8, 1.2, 2.0, 3.7, 50.0])
@pytest.mark.parametrize("volume", VOLUMES.values(), ids=VOLUMES)
def test_members_of_a_stencil_are_the_voxels_within_eps(volume: Volume, eps_mm: float) -> None:
    stencil = make_stencil(Lattice.of(volume), eps=eps_mm)
    slices = range(volume.shape_ijk[2])
    assert stencil.tables.shape == (len(slices), 2)
    for k in slices:
        in_the_volume = {offset for offset in offsets_of(stencil, k) if k + offset[2] in slices}
        assert in_the_volume == offsets_by_search(volume, k, eps_mm), k


def test_two_voxels_are_members_of_each_other_or_neither_is() -> None:
    volume = uneven()
    stencil = make_stencil(Lattice.of(volume), eps=1.9)
    pairs = {(k, di, dj, dk) for k in range(volume.shape_ijk[2]) for di, dj, dk in offsets_of(stencil, k)}
    assert any(dk for _, _, _, dk in pairs), "some lie in other slices"
    assert {(k + dk, -di, -dj, -dk) for k, di, dj, dk in pairs} == pairs


@pytest.mark.parametrize(
    ("spacing", "eps_mm", "members"),
    [((0.644531, 0.644531, 0.8), 1.2, 19), ((0.976562, 0.976562, 4.25), 6.4, 275)],
    ids=["thoracic", "lumbar"],
)
def test_stencils_of_known_scans_have_as_many_members_as_counted(
    spacing: tuple[float, ...], eps_mm: float, members: int
) -> None:
    stencil = make_stencil(Lattice((512, 512, 99), np.diag((*spacing, 1.0))), eps=eps_mm)
    offsets = np.indices([2 * int(eps_mm / step) + 1 for step in spacing]).reshape(3, -1).T
    offsets -= [int(eps_mm / step) for step in spacing]
    assert np.count_nonzero(np.linalg.norm(offsets * spacing, axis=1) <= eps_mm) == members
    assert stencil.members == (members, members)


def test_members_in_the_plane_of_a_stencil_are_counted() -> None:
    """Steps of 0.645 mm: with the diagonal ones, 0.91 mm away, nine lie within 1.2 mm."""
    assert make_stencil(Lattice((512, 512, 95), THORACIC), eps=1.2).in_plane == 9


@pytest.mark.parametrize(
    ("eps_mm", "members"), [(0.3, 3), (0.3 * (1 - 3e-6), 1)], ids=["the gap but for rounding", "less than the gap"]
)
def test_an_eps_of_one_slice_gap_reaches_the_next_slices_despite_rounding(eps_mm: float, members: int) -> None:
    gap_mm = 0.1 + 0.2  # not 0.3
    stencil = make_stencil(Lattice((5, 5, 5), np.diag((1.0, 1.0, gap_mm, 1.0))), eps=eps_mm)
    assert stencil.members == (members, members)
    assert stencil.is_alone == (members == 1)


@pytest.mark.parametrize(("eps_mm", "holds"), [(np.sqrt(3**2 + 4**2 + 5**2), True), (7.0, False)])
def test_a_volume_lies_within_eps_where_its_diagonal_does(eps_mm: float, holds: bool) -> None:
    box = Lattice((4, 5, 6), np.eye(4))
    assert make_stencil(box, eps=eps_mm).holds((4, 5, 6)) == holds


@pytest.mark.parametrize(("shorter_mm", "holds"), [(0.0, True), (0.001, False)])
def test_an_uneven_volume_lies_within_eps_where_its_longest_distance_does(shorter_mm: float, holds: bool) -> None:
    volume = uneven()
    corners = volume.ijk_to_lps([(i, j, k) for i in (0, 3) for j in (0, 4) for k in range(6)])
    longest_mm = np.linalg.norm(corners[:, None] - corners, axis=2).max()
    assert make_stencil(Lattice.of(volume), eps=longest_mm - shorter_mm).holds(volume.shape_ijk) == holds


def test_slices_with_the_same_neighbours_share_a_table() -> None:
    """Slices at 0, 1, 2, 3, 4 and 9 mm, of which 1, 2 and 3 have one above and one below within 1 mm."""
    positions = np.array([(0.0, 0.0, z) for z in (0, 1, 2, 3, 4, 9)])
    tables = make_stencil(Lattice((3, 3, 6), np.eye(4), positions), eps=1.0).tables.tolist()
    assert tables[1] == tables[2] == tables[3]
    assert len({tuple(table) for table in tables}) == 4  # of slices 0, 1 to 3, 4 and 5


@pytest.mark.parametrize(("eps", "joins"), [(0.5, False), (1.0, True)])
def test_columns_are_joined_by_neighbours_in_their_row_and_not_in_the_next_slice(eps: float, joins: bool) -> None:
    """Each slice begins a voxel further right and 0.1 mm higher: the next slice has a neighbour in the next column."""
    sheared = np.array([[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.1, 0.0], [0.0, 0.0, 0.0, 1.0]])
    stencil = make_stencil(Lattice((3, 3, 3), sheared), eps)
    assert (1, 0, -1) in offsets_of(stencil, 1)
    assert stencil.joins_columns == joins


def test_rows_of_a_stencil_are_sorted_by_the_distance_of_their_middle() -> None:
    dj, dk, low, high = make_stencil(Lattice((30, 30, 30), THORACIC), eps=3.0).rows.T
    middles = np.stack([(low + high) / 2, dj, dk], axis=1) * np.diag(THORACIC)[:3]
    distances = np.linalg.norm(middles, axis=1)
    assert (np.diff(distances) > -tolerances.FLOAT64_PLACE_MM).all()


@pytest.mark.parametrize("lattice", [Lattice((30, 30, 30), SHEARED), Lattice.of(uneven())], ids=["sheared", "uneven"])
def test_forward_rows_hold_the_members_after_a_voxel_in_the_order_of_the_array(lattice: Lattice) -> None:
    stencil = make_stencil(lattice, eps=2.4)
    forward = stencil.forward()
    for k in range(lattice.shape_ijk[2]):
        after = {(di, dj, dk) for di, dj, dk in offsets_of(stencil, k) if (dk, dj, di) > (0, 0, 0)}
        assert offsets_of(forward, k) == after, k


LATTICES = {
    "columns 2 mm apart": (Lattice((4, 4, 4), np.diag((2.0, 0.5, 1.0, 1.0))), 1.5 * 2.0),
    "a single slice, which has no gap": (Lattice((4, 4, 1), np.diag((0.5, 0.5, 9.0, 1.0))), 1.5 * 0.5),
    "uneven slices, the widest gap 5 mm": (Lattice.of(uneven()), 1.5 * 5.0),
    "slices 4.25 mm apart": (Lattice((512, 512, 99), np.diag((0.976562, 0.976562, 4.25, 1.0))), 1.5 * 4.25),
}


@pytest.mark.parametrize(("lattice", "eps_mm"), LATTICES.values(), ids=LATTICES)
def test_the_default_eps_is_one_and_a_half_times_the_largest_step(lattice: Lattice, eps_mm: float) -> None:
    assert lattice.default_eps == pytest.approx(eps_mm)


def test_the_gap_of_tilted_slices_is_their_distance_and_not_their_step() -> None:
    tilted = np.array([[0.5, 0, 0, 0], [0, 0.5, 1.0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1.0]])
    assert Lattice((4, 4, 4), tilted).largest_gap == pytest.approx(2.0)


@pytest.mark.parametrize("eps", [0.0, -1.0, float("nan"), float("inf"), "1", True, None])
def test_an_eps_that_is_no_finite_length_above_0_is_refused(eps) -> None:
    with refused(UsageError, 0.0, "distance"):
        make_stencil(Lattice((4, 4, 4), np.eye(4)), eps=eps)
