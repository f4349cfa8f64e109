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
from clrecon.operators.surface.growing import growing_needs
from clrecon.operators.surface.seeds import AUTO_SHARE
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


class Twin:
    """The cells of the largest components by the twin; the frontier agrees."""

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


def assert_twin(volume: Volume, device: Any, level: Any, **options: Any) -> None:
    twin = Twin()
    vertices, normals, triangles = extract_twin(volume, level, grown=twin, **options)
    mesh = extract_isosurface(volume, level, device=device, grow_from="auto", **options)
    assert np.array_equal(mesh.triangles, triangles)
    assert np.abs(mesh.vertices - vertices).max() <= 3.0 * float32_unit(vertices)
    assert mesh.report["cells"] == twin.cells


@pytest.mark.every_device
@pytest.mark.parametrize("shape", daily(14, SHAPES))
def test_the_part_of_noise_equals_the_twin_at_sizes_of_words(shape: tuple[int, int, int], device: Any) -> None:
    if np.prod(shape) > 10_000:
        shape = (2, 2, shape[2])
    assert_twin(random_volume(shape, high=9), device, 7)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("below", [True, False])
def test_both_borders_and_both_sides_equal_the_twin(closed: bool, below: bool, device: Any) -> None:
    for affine in (OBLIQUE, MIRRORED):
        assert_twin(random_volume((6, 9, 40), high=9, affine=affine), device, 2, closed=closed, below=below)


@pytest.mark.parametrize("dtype", daily(1, ["uint8", "float32"]))
def test_types_ranges_and_uneven_slices_equal_the_twin(dtype: str, device: Any) -> None:
    volume = random_volume((6, 9, 40), dtype, high=9)
    assert_twin(volume, device, (2, 4))
    assert_twin(uneven(volume.voxels), device, 7)
    assert_twin(smooth_volume((9, 10, 40)), device, 100, vertex_rule="golden-search")


@pytest.mark.release
def test_cells_grown_on_a_spine_are_those_of_the_frontier(device: Any) -> None:
    """The cells are those that the paper's frontier enters, one by one: the twin asserts that beside the mesh."""
    voxels, affine, _ = make_phantom(PhantomSettings(size=(64, 64), slices=24, spacing=(2.4, 2.4, 3.3), noise=40.0))
    volume = Volume(voxels, affine)
    assert_twin(volume, device, 226)
    assert extract_isosurface(volume, 226, device=device, grow_from="auto").report["growing"]["components"] > 10


@pytest.mark.every_device
def test_a_mask_grows_what_it_touches(device: Any) -> None:
    volume = blocks()
    chosen = np.zeros(volume.voxels.shape, bool)
    chosen[5, 5, 50] = True
    labels = LabelMap(chosen.astype(np.uint8), volume.affine)
    mask = Mask.from_array(volume, chosen, device=device)
    small = extract_isosurface(volume, 0, device=device, grow_from=mask)
    assert_same(small, extract_isosurface(volume, 0, device=device, grow_from=(labels, 1)))
    seeds = ["auto", mask, tuple(volume.ijk_to_lps([(69.0, 17.0, 8.0)])[0])]
    both = extract_isosurface(volume, 0, device=device, grow_from=seeds)
    assert_same(both, extract_isosurface(volume, 0, device=device))
    other = Mask.from_array(Volume(volume.voxels[1:], volume.affine), chosen[1:], device=device)
    with refused(UsageError, 15, 18, 70):
        extract_isosurface(volume, 0, device=device, grow_from=other)


@pytest.mark.oclgrind
def test_a_small_part_is_grown(device: Any) -> None:
    assert_twin(random_volume((3, 5, 33), high=9), device, 7)


def chosen_of_whole(whole: Any, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, left = np.unique(whole.triangles[triangles], return_inverse=True)
    return whole.vertices[used], left.reshape(-1, 3)


@pytest.mark.parametrize(("seed", "inner"), [((5.5, 8.5, 8.5), False), ((15.0, 9.0, 8.0), True)])
def test_a_part_is_that_of_the_whole_mesh_bit_for_bit(seed: Any, inner: bool, device: Any) -> None:
    """The outside of the hollow block, or the wall of its hollow alone, which is wound inwards."""
    volume = blocks()
    whole = extract_isosurface(volume, 0, device=device)
    grown = extract_isosurface(volume, 0, device=device, grow_from=volume.ijk_to_lps([seed])[0])
    ijk = volume.lps_to_ijk(whole.vertices)
    in_hollow = ((ijk > (13, 5, 4)) & (ijk < (31, 12, 11))).all(axis=1)
    outside = (ijk[:, 0] < 41) & ~in_hollow
    chosen = np.asarray(in_hollow if inner else outside)
    vertices, triangles = chosen_of_whole(whole, chosen[whole.triangles].all(axis=1))
    assert np.array_equal(grown.vertices, vertices) and np.array_equal(grown.triangles, triangles)
    quality = grown.quality()
    assert quality["closed"] and quality["manifold"] and quality["unused_vertices"] == 0
    assert (quality["volume_ml"] < 0) == inner
    assert grown.report["growing"]["components"] == 4 and grown.report["growing"]["components_taken"] == 1


def test_seeds_together_and_auto_name_what_they_leave_out(device: Any) -> None:
    volume = blocks()
    seeds = volume.ijk_to_lps([(5.5, 8.5, 8.5), (15.0, 9.0, 8.0), (55.0, 6.0, 4.0), (69.0, 17.0, 8.0)])
    assert_same(
        extract_isosurface(volume, 0, device=device, grow_from=seeds), extract_isosurface(volume, 0, device=device)
    )
    auto = extract_isosurface(volume, 0, device=device, grow_from="auto")
    assert_sound(auto)
    growing = auto.report["growing"]
    assert growing["from"] == ["auto"] and growing["components_taken"] == 3
    assert growing["largest_left_out_cells"] == 8  # around the lone voxel
    cells = auto.report["cells"]
    assert growing["cells_left_out_share"] == pytest.approx(8 / cells["active"])
    assert cells["grown"] + 8 == cells["active"] < cells["visited"] < cells["all"] == 17 * 19 * 71
    whole = extract_isosurface(volume, 0, device=device)
    assert whole.report["cells"] == {"visited": cells["all"], "all": cells["all"]}


@pytest.mark.parametrize("closed", [True, False])
def test_labels_and_masks_grow_what_has_one_of_their_voxels(closed: bool, device: Any) -> None:
    volume = blocks()
    numbers = np.zeros(volume.voxels.shape, np.uint8)
    numbers[5, 5, 50] = 7
    numbers[8, 8, 20] = 9  # in the hollow: no corner of bone
    labels = LabelMap(numbers, volume.affine, names={7: "small", 9: "hollow"})
    small = extract_isosurface(volume, 0, device=device, closed=closed, grow_from=(labels, "small"))
    assert small.report["growing"]["from"] == ["label small"]
    ijk = volume.lps_to_ijk(small.vertices)
    assert ijk.min(axis=0) == pytest.approx((49.4975, 3.4975, 3.4975), abs=1e-3)
    assert ijk.max(axis=0) == pytest.approx((59.5025, 8.5025, 8.5025), abs=1e-3)
    assert_same(extract_isosurface(volume, 0, device=device, closed=closed, grow_from=[labels]), small)
    with refused(UsageError, "label", "components"):
        extract_isosurface(volume, 0, device=device, closed=closed, grow_from=(labels, 9))


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("slices", [1, 3, 7])
def test_slabs_make_the_same_part(slices: int, closed: bool, device: Any) -> None:
    volume = smooth_volume((19, 20, 40))
    expected = extract_isosurface(volume, 300, device=device, closed=closed, grow_from="auto")
    resident = DeviceVolume(volume, device=device)
    grid = SampleGrid(volume, choose_iso_rule(volume, 300, closed=closed), grows=True)
    resident.most_slices[grid.kind] = slices
    mesh = extract_isosurface(resident, 300, closed=closed, grow_from="auto")
    assert mesh.report["slabs"] > 1 and mesh.report["cells"] == expected.report["cells"]
    assert_same(mesh, expected)


def test_a_second_surface_of_a_volume_is_grown_with_its_bricks(device: Any) -> None:
    volume = smooth_volume()
    with DeviceVolume(volume, device=device) as resident:
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


def test_a_seed_in_air_is_refused_with_its_distance(device: Any) -> None:
    voxels = np.full((12, 40, 90), -1000, np.int16)
    voxels[4:8, 4:9, 4:9] = 500
    volume = Volume(voxels, np.diag((1.0, 1.0, 1.0, 1.0)))
    with refused(UsageError, 30, -1000, 21.5, 0):
        extract_isosurface(volume, 0, device=device, grow_from=(30, 6, 6))
    with refused(UsageError, 50, 0, 10):
        extract_isosurface(volume, 0, device=device, grow_from=(80, 6, 6))
    assert len(extract_isosurface(volume, 0, device=device, grow_from=(16, 6, 6)).triangles) > 0


def test_the_trilinear_topology_is_not_grown(device: Any) -> None:
    with refused(UsageError, "surface", "topology", "grow_from"):
        extract_isosurface(blocks(), 0, device=device, topology="trilinear", grow_from="auto")


def test_a_volume_without_surface_is_no_part_of_one(device: Any) -> None:
    with refused(NoSurfaceError, 5000):
        extract_isosurface(blocks(), 5000, device=device, grow_from="auto")


def test_memory_for_the_bits_of_the_volume_is_asked_for_first(device: Any) -> None:
    volume = smooth_volume((7, 4, 70))
    parts = growing_needs(SampleGrid(volume, choose_iso_rule(volume, 300)))
    assert list(parts.values()) == [4 * 54 * 3, 4 * 54 * 3, 6 * 54 * 3, 4 * 54 * 3, 20 * 54]
    with refused(DeviceError, 150000, "surface"):
        extract_isosurface(smooth_volume((40, 64, 64)), 300, device=device, grow_from="auto", memory=150_000)


def test_the_golden_constant_is_off_and_the_search_is_not(device: Any) -> None:
    k, j, i = np.indices((31, 31, 31)) - 15.2
    volume = Volume((100.0 * (10.0 - np.sqrt(i**2 + j**2 + k**2))).astype(np.float32), np.eye(4))
    error = {}
    for rule in ("linear", "golden", "golden-search"):
        mesh = extract_isosurface(volume, 0, device=device, vertex_rule=rule)
        assert mesh.report["vertex_rule"] == rule
        error[rule] = float(np.sqrt(np.mean((np.linalg.norm(mesh.vertices - 15.2, axis=1) - 10.0) ** 2)))
    assert error["linear"] < 0.02 and error["golden"] > 0.2
    assert abs(error["golden-search"] - error["linear"]) < 0.03
