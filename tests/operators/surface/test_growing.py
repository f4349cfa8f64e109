"""Surfaces that grow from seeds: exactly those triangles of the whole surface whose cells hang together with one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from refusals import refused
from slab_surfaces import assert_same
from surface_volumes import MIRRORED, OBLIQUE, SHAPES, assert_sound, random_volume, smooth_volume
from tolerances import float32_unit
from uneven_volume import uneven
from variants import daily

from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.labels import LabelMap
from clrecon.opencl import Stopwatch
from clrecon.operators.masks.mask import Mask
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.extraction import keep_bricks
from clrecon.operators.surface.growing import FARTHEST_TOLD_MM, growing_needs
from clrecon.operators.surface.seeds import AUTO_SHARE, SEED_REACH_MM
from clrecon.operators.surface.slabs import SampleGrid
from clrecon.proof.phantom import PhantomSettings, make_phantom
from clrecon.proof.surface.extract import extract_isosurface as extract_twin
from clrecon.proof.surface.growing import choose_largest, count_visited, grow_cells, label_cells


def blocks(affine: np.ndarray = OBLIQUE, dtype: str = "int16") -> Volume:
    """Three blocks of 100 HU in air: a large hollow one, a small one, and one voxel that touches the border."""
    voxels = np.full((16, 18, 70), -100, dtype)
    voxels[3:13, 3:15, 5:40] = 100
    voxels[6:10, 7:11, 15:30] = -100
    voxels[4:9, 4:9, 50:60] = 100
    voxels[8, 17, 69] = 100
    return Volume(voxels, affine)


class LargestByTwin:
    """Cells of the largest components by the twin, which the paper's frontier enters one by one; counts of them."""

    def __init__(self, share: float = AUTO_SHARE):
        self.share = share
        self.cells: dict[str, int] = {}

    def __call__(self, inside: np.ndarray) -> np.ndarray:
        count, numbers = label_cells(inside)
        sizes = np.bincount(numbers[numbers >= 0], minlength=count)
        chosen = choose_largest(sizes, self.share)
        cells = np.asarray(chosen[numbers] & (numbers >= 0))
        seeds = [tuple(np.argwhere(numbers == number)[0]) for number in np.flatnonzero(chosen)]
        frontier = grow_cells(inside, seeds)
        assert (frontier.cells == cells).all()
        assert frontier.visited == count_visited(cells)
        self.cells = {
            "visited": frontier.visited, "grown": int(cells.sum()), "active": int((numbers >= 0).sum()),
            "all": cells.size,
        }  # fmt: skip
        return cells


def assert_grown_surface_equals_twin(volume: Volume, device: Any, level: Any, **options: Any) -> None:
    twin = LargestByTwin()
    vertices, normals, triangles = extract_twin(volume, level, grown=twin, **options)
    mesh = extract_isosurface(volume, level, device=device, grow_from="auto", **options)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= 3.0 * float32_unit(vertices)
    assert mesh.report["cells"] == twin.cells


@pytest.mark.every_device
@pytest.mark.parametrize("shape", daily(14, SHAPES))
def test_surface_grown_in_random_voxels_equals_the_twin_at_sizes_of_words(
    shape: tuple[int, int, int], device: Any
) -> None:
    if np.prod(shape) > 10_000:
        shape = (2, 2, shape[2])  # the twin takes seconds for more; the size of words is that of a row
    assert_grown_surface_equals_twin(random_volume(shape, high=9), device, level=7)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("below", [True, False])
@pytest.mark.parametrize("affine", [OBLIQUE, MIRRORED], ids=["oblique", "mirrored"])
def test_grown_surface_closed_or_open_above_or_below_a_level_equals_the_twin(
    affine: Any, closed: bool, below: bool, device: Any
) -> None:
    volume = random_volume((6, 9, 40), high=9, affine=affine)
    assert_grown_surface_equals_twin(volume, device, level=2, closed=closed, below=below)


@pytest.mark.parametrize("dtype", daily(1, ["uint8", "float32"]))
def test_grown_surface_of_a_range_equals_the_twin(dtype: str, device: Any) -> None:
    assert_grown_surface_equals_twin(random_volume((6, 9, 40), dtype=dtype, high=9), device, level=(2, 4))


@pytest.mark.parametrize("dtype", daily(1, ["uint8", "float32"]))
def test_grown_surface_of_uneven_slices_equals_the_twin(dtype: str, device: Any) -> None:
    assert_grown_surface_equals_twin(uneven(random_volume((6, 9, 40), dtype=dtype, high=9).voxels), device, level=7)


def test_grown_surface_by_the_golden_search_equals_the_twin(device: Any) -> None:
    assert_grown_surface_equals_twin(smooth_volume((9, 10, 40)), device, level=100, vertex_rule="golden-search")


@pytest.mark.release
def test_cells_grown_on_a_spine_of_many_components_are_those_of_the_twin(device: Any) -> None:
    voxels, affine, _ = make_phantom(PhantomSettings(size=(64, 64), slices=24, spacing=(2.4, 2.4, 3.3), noise=40.0))
    volume = Volume(voxels, affine)
    assert_grown_surface_equals_twin(volume, device, level=226)
    growing = extract_isosurface(volume, 226, device=device, grow_from="auto").report["growing"]
    assert growing["components"] > 10  # measured 16


SMALL_BLOCK_KJI = (5, 5, 50)
LONE_VOXEL_IJK = (69.0, 17.0, 8.0)


@pytest.fixture
def voxel_of_small_block() -> np.ndarray:
    """A mask of one voxel of the second of `blocks`."""
    chosen = np.zeros(blocks().voxels.shape, bool)
    chosen[SMALL_BLOCK_KJI] = True
    return chosen


@pytest.mark.every_device
def test_a_mask_grows_the_same_surface_as_a_label_of_its_voxels(voxel_of_small_block: np.ndarray, device: Any) -> None:
    volume = blocks()
    labels = LabelMap(voxel_of_small_block.astype(np.uint8), volume.affine)
    mask = Mask.from_array(volume, voxel_of_small_block, device=device)
    assert_same(
        extract_isosurface(volume, 0, device=device, grow_from=mask),
        extract_isosurface(volume, 0, device=device, grow_from=(labels, 1)),
    )


@pytest.mark.every_device
def test_the_largest_a_mask_and_a_point_together_grow_all_three_blocks(
    voxel_of_small_block: np.ndarray, device: Any
) -> None:
    volume = blocks()
    mask = Mask.from_array(volume, voxel_of_small_block, device=device)
    point = tuple(volume.ijk_to_lps([LONE_VOXEL_IJK])[0])
    grown = extract_isosurface(volume, 0, device=device, grow_from=["auto", mask, point])
    assert_same(grown, extract_isosurface(volume, 0, device=device))


def test_a_mask_of_fewer_slices_is_refused_as_a_seed(voxel_of_small_block: np.ndarray, device: Any) -> None:
    volume = blocks()
    mask = Mask.from_array(Volume(volume.voxels[1:], volume.affine), voxel_of_small_block[1:], device=device)
    with refused(UsageError, 15, 18, 70):
        extract_isosurface(volume, 0, device=device, grow_from=mask)


@pytest.mark.oclgrind
def test_surface_grown_in_a_small_volume_equals_the_twin(device: Any) -> None:
    assert_grown_surface_equals_twin(random_volume((3, 5, 33), high=9), device, level=7)


def chosen_of_whole(whole: Any, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles that are left of a mesh of which only some triangles stay."""
    used, left = np.unique(whole.triangles[triangles], return_inverse=True)
    return whole.vertices[used], left.reshape(-1, 3)


OUTSIDE_IJK, HOLLOW_IJK = (5.5, 8.5, 8.5), (15.0, 9.0, 8.0)
"""Places at the outside of the large block, and at the wall of its hollow."""


@pytest.mark.parametrize(("seed", "in_hollow"), [(OUTSIDE_IJK, False), (HOLLOW_IJK, True)], ids=["outside", "hollow"])
def test_a_grown_component_is_that_of_the_whole_mesh_bit_for_bit(seed: Any, in_hollow: bool, device: Any) -> None:
    volume = blocks()
    whole = extract_isosurface(volume, 0, device=device)
    grown = extract_isosurface(volume, 0, device=device, grow_from=volume.ijk_to_lps([seed])[0])

    ijk = volume.lps_to_ijk(whole.vertices)
    of_hollow = ((ijk > (13, 5, 4)) & (ijk < (31, 12, 11))).all(axis=1)
    of_outside = (ijk[:, 0] < 41) & ~of_hollow
    chosen = np.asarray(of_hollow if in_hollow else of_outside)
    vertices, triangles = chosen_of_whole(whole, chosen[whole.triangles].all(axis=1))
    assert np.array_equal(grown.vertices, vertices)
    assert np.array_equal(grown.triangles, triangles)
    growing = grown.report["growing"]
    assert (growing["components"], growing["components_taken"]) == (4, 1)  # three blocks and a hollow


@pytest.mark.parametrize(("seed", "in_hollow"), [(OUTSIDE_IJK, False), (HOLLOW_IJK, True)], ids=["outside", "hollow"])
def test_a_grown_component_is_closed_and_that_of_a_hollow_is_wound_inwards(
    seed: Any, in_hollow: bool, device: Any
) -> None:
    volume = blocks()
    quality = extract_isosurface(volume, 0, device=device, grow_from=volume.ijk_to_lps([seed])[0]).quality()
    assert (quality["closed"], quality["manifold"], quality["unused_vertices"]) == (True, True, 0)
    assert (quality["volume_ml"] < 0) == in_hollow


def test_seeds_at_every_component_grow_the_whole_surface(device: Any) -> None:
    volume = blocks()
    seeds = volume.ijk_to_lps([OUTSIDE_IJK, HOLLOW_IJK, (55.0, 6.0, 4.0), LONE_VOXEL_IJK])
    grown = extract_isosurface(volume, 0, device=device, grow_from=seeds)
    assert_same(grown, extract_isosurface(volume, 0, device=device))


CELLS_OF_ALL = 17 * 19 * 71  # of 16 x 18 x 70 voxels and a border
CELLS_OF_A_VOXEL = 8


def test_growing_from_auto_leaves_the_lone_voxel_out_and_reports_its_cells(device: Any) -> None:
    mesh = extract_isosurface(blocks(), 0, device=device, grow_from="auto")
    assert_sound(mesh)
    growing = mesh.report["growing"]
    assert growing["from"] == ["auto"]
    assert growing["components_taken"] == 3  # two blocks and a hollow
    assert growing["largest_left_out_cells"] == CELLS_OF_A_VOXEL
    assert growing["cells_left_out_share"] == pytest.approx(CELLS_OF_A_VOXEL / mesh.report["cells"]["active"])


def test_growing_visits_more_cells_than_are_active_and_fewer_than_there_are(device: Any) -> None:
    cells = extract_isosurface(blocks(), 0, device=device, grow_from="auto").report["cells"]
    assert cells["grown"] + CELLS_OF_A_VOXEL == cells["active"] < cells["visited"] < cells["all"] == CELLS_OF_ALL


def test_the_whole_surface_visits_all_cells(device: Any) -> None:
    cells = extract_isosurface(blocks(), 0, device=device).report["cells"]
    assert cells == {"visited": CELLS_OF_ALL, "all": CELLS_OF_ALL}


@pytest.fixture
def labels_of_blocks() -> LabelMap:
    """Label 7 at a voxel of the small block, and 9 at one in the hollow, which no corner of bone is near."""
    numbers = np.zeros(blocks().voxels.shape, np.uint8)
    numbers[SMALL_BLOCK_KJI] = 7
    numbers[8, 8, 20] = 9
    return LabelMap(numbers, blocks().affine, names={7: "small", 9: "hollow"})


@pytest.mark.parametrize("closed", [True, False])
def test_a_label_grows_the_surface_of_the_block_that_has_one_of_its_voxels(
    closed: bool, labels_of_blocks: LabelMap, device: Any
) -> None:
    """The small block is voxels 50 to 59, 4 to 8 and 4 to 8; 0 HU between -100 and 100 lies half a voxel off."""
    volume = blocks()
    small = extract_isosurface(volume, 0, device=device, closed=closed, grow_from=(labels_of_blocks, "small"))
    ijk = volume.lps_to_ijk(small.vertices)
    assert ijk.min(axis=0) == pytest.approx((49.5, 3.5, 3.5), abs=0.005)  # whole HU from -0.5 on are inside
    assert ijk.max(axis=0) == pytest.approx((59.5, 8.5, 8.5), abs=0.005)  # half a HU of 200 a voxel is 0.0025
    assert small.report["growing"]["from"] == ["label small"]


@pytest.mark.parametrize("closed", [True, False])
def test_all_labels_grow_the_blocks_that_have_their_voxels(
    closed: bool, labels_of_blocks: LabelMap, device: Any
) -> None:
    by_all, by_small = (
        extract_isosurface(blocks(), 0, device=device, closed=closed, grow_from=seeds)
        for seeds in ([labels_of_blocks], (labels_of_blocks, "small"))
    )
    assert_same(by_all, by_small)


@pytest.mark.parametrize("closed", [True, False])
def test_a_label_without_a_voxel_at_the_surface_is_refused_as_a_seed(
    closed: bool, labels_of_blocks: LabelMap, device: Any
) -> None:
    with refused(UsageError, "label", "components"):
        extract_isosurface(blocks(), 0, device=device, closed=closed, grow_from=(labels_of_blocks, 9))


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("slices", [1, 3, 7])
def test_slabs_grow_the_same_surface(slices: int, closed: bool, device: Any) -> None:
    volume = smooth_volume((19, 20, 40))
    expected = extract_isosurface(volume, 300, device=device, closed=closed, grow_from="auto")
    resident = DeviceVolume(volume, device=device)
    grid = SampleGrid(volume, choose_iso_rule(volume, 300, closed=closed), grows=True)
    resident.most_slices[grid.kind] = slices
    mesh = extract_isosurface(resident, 300, closed=closed, grow_from="auto")
    assert mesh.report["slabs"] > 1
    assert mesh.report["cells"] == expected.report["cells"]
    assert_same(mesh, expected)


def test_a_surface_grown_with_the_bricks_of_a_resident_volume_is_the_same(device: Any) -> None:
    """Bricks know their lowest and highest values; a volume gets them once more than one surface is asked for."""
    with DeviceVolume(smooth_volume(), device=device) as resident:
        first = extract_isosurface(resident, 250, grow_from="auto")
        keep_bricks(resident, resident.whole(Stopwatch()))
        assert_same(extract_isosurface(resident, 250, grow_from="auto"), first)


@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        (
            (-250.0, -300.0, 900.0),
            r"seed -250,-300,900 lies outside of the volume, which runs from x .* mm \(LPS\): check",
        ),
        ("spine", "grow_from is 'auto', a point of three numbers in LPS mm, a label or a mask, not 'spine'"),
        ((1.0, 2.0), "a point of three numbers"),
        ((1.0, float("nan"), 2.0), "a point of three numbers"),
        ([], "a point of three numbers"),
    ],
)
def test_what_is_no_seed_is_refused(seeds: Any, words: str, device: Any) -> None:
    with pytest.raises(UsageError, match=words):
        extract_isosurface(blocks(), 0, device=device, grow_from=seeds)


@pytest.fixture
def block_in_air() -> Volume:
    """A block of 500 HU from 4 to 8 along x and y and from 4 to 7 along z, in voxels of 1 mm."""
    voxels = np.full((12, 40, 90), -1000, np.int16)
    voxels[4:8, 4:9, 4:9] = 500
    return Volume(voxels, np.eye(4))


def test_a_seed_in_air_is_refused_with_its_distance_from_the_surface(block_in_air: Volume, device: Any) -> None:
    from_the_block = 30 - 8.5  # mm: the block ends half a voxel behind x = 8
    with refused(UsageError, 30, -1000, from_the_block, 0):  # x of the seed, its HU, and the level
        extract_isosurface(block_in_air, 0, device=device, grow_from=(30, 6, 6))


def test_a_seed_farther_from_the_surface_than_is_searched_is_refused(block_in_air: Volume, device: Any) -> None:
    x = 80
    assert x - 8.5 > FARTHEST_TOLD_MM
    with refused(UsageError, x, FARTHEST_TOLD_MM, SEED_REACH_MM):
        extract_isosurface(block_in_air, 0, device=device, grow_from=(x, 6, 6))


def test_a_seed_in_air_grows_the_nearer_of_two_surfaces_within_10_mm(block_in_air: Volume, device: Any) -> None:
    """The seed at x = 16 lies 7.5 mm from the block, which ends at 8.5, and 9.5 mm from another that begins at 25.5."""
    two_blocks = block_in_air.voxels.copy()
    two_blocks[4:8, 4:9, 26:31] = 500
    grown = extract_isosurface(block_in_air.with_voxels(two_blocks), 0, device=device, grow_from=(16, 6, 6))
    assert_same(grown, extract_isosurface(block_in_air, 0, device=device))


def test_growing_with_the_trilinear_topology_is_refused(device: Any) -> None:
    with refused(UsageError, "surface", "topology", "grow_from"):
        extract_isosurface(blocks(), 0, device=device, topology="trilinear", grow_from="auto")


def test_growing_in_a_volume_without_a_surface_is_refused(device: Any) -> None:
    with refused(NoSurfaceError, 5000):
        extract_isosurface(blocks(), 5000, device=device, grow_from="auto")


def test_growing_needs_bits_and_numbers_of_the_cells_of_each_row() -> None:
    volume = smooth_volume((7, 4, 70))
    rows, words = (7 + 2) * (4 + 2), 3  # with a border; 72 samples a row
    bits = 4 * rows * words
    assert growing_needs(SampleGrid(volume, choose_iso_rule(volume, 300))) == {
        "inside mask": bits, "active cells": bits, "begins of runs": 1.5 * bits, "grown samples": bits,
        "rows of cells": 20 * rows,
    }  # fmt: skip


def test_growing_without_room_for_the_bits_of_the_volume_is_refused(device: Any) -> None:
    # Slabs of the volume fit; what growing needs of all its 66 x 42 rows of cells is 205,128 bytes.
    with refused(DeviceError, 150_000, "surface"):
        extract_isosurface(smooth_volume((40, 64, 64)), 300, device=device, grow_from="auto", memory=150_000)


@pytest.fixture(scope="module")
def rms_by_rule(device: Any) -> dict[str, float]:
    """The rms distance of the surface from a sphere of 10 voxels by each vertex rule."""
    k, j, i = np.indices((31, 31, 31)) - 15.2
    volume = Volume((100.0 * (10.0 - np.sqrt(i**2 + j**2 + k**2))).astype(np.float32), np.eye(4))

    def rms(rule: str) -> float:
        mesh = extract_isosurface(volume, 0, device=device, vertex_rule=rule)
        assert mesh.report["vertex_rule"] == rule
        return float(np.sqrt(np.mean((np.linalg.norm(mesh.vertices - 15.2, axis=1) - 10.0) ** 2)))

    return {rule: rms(rule) for rule in ("linear", "golden", "golden-search")}


def test_vertices_at_a_golden_section_lie_ten_times_farther_off_than_linear_ones(rms_by_rule: dict[str, float]) -> None:
    assert rms_by_rule["linear"] < 0.02  # measured 0.005
    assert rms_by_rule["golden"] > 0.2  # measured 0.22


def test_vertices_by_a_golden_search_lie_nearly_as_well_as_linear_ones(rms_by_rule: dict[str, float]) -> None:
    assert rms_by_rule["golden-search"] == pytest.approx(rms_by_rule["linear"], abs=0.01)  # measured 0.005 apart
