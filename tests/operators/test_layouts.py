"""Words of rows, bits of numbers, shares of work and bytes of forecasts: closed cases without a device."""

from __future__ import annotations

from inspect import Parameter, signature
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import refused
from uneven_volume import HEIGHTS, SIDEWAYS, uneven

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule, slice_normal_matrices
from clrecon.operators.first_use import _count_open_edges
from clrecon.operators.masks.voxel_mask import mask_bytes
from clrecon.operators.points import field
from clrecon.operators.points.clusters import _order_voxels
from clrecon.operators.points.field import BRICK, NodeField, Nodes
from clrecon.operators.points.free_clusters import CELLS_A_CHUNK, CHUNKS_A_CORE, ClusterSearch
from clrecon.operators.points.grid import PADDING, GridPlan
from clrecon.operators.points.neighbours import choose_cell_edge
from clrecon.operators.points.point_extraction import VoxelEmission
from clrecon.operators.points.slice_overlap import find_ghost_slices
from clrecon.operators.points.voxel_clusters import pad_for, search_bytes
from clrecon.operators.primitives.scan import (
    FEWEST_PER_CHUNK,
    MOST_CHUNKS,
    RADIX_BITS,
    _plan_chunks,
    _plan_digits,
    sort_bytes,
)
from clrecon.operators.rays import ray_pictures
from clrecon.operators.rays.picture_buffers import TILE, PictureBuffers, Shot
from clrecon.operators.rays.point_pictures import (
    DARKEST_SHARE,
    LARGEST_DISC,
    SMALLEST_DISC,
    Discs,
    _choose_window,
    _Splats,
)
from clrecon.operators.resident import tables as stack_table
from clrecon.operators.resident.tables import FieldFrame
from clrecon.operators.surface import label_masks
from clrecon.operators.surface.label_masks import FACES_PER_AREA, FULL, STEEPNESS
from clrecon.operators.surface.slabs import SampleGrid, Slab
from clrecon.rendering import Lighting, TransferFunction
from clrecon.rendering.views.camera import Camera

pytestmark = pytest.mark.unit

NOWHERE = np.zeros(3)


@pytest.mark.parametrize(("bricks", "words"), [(1, 1), (3, 1), (4, 1), (5, 2), (8, 2), (9, 3), (132, 33), (133, 34)])
def test_words_of_a_field_hold_the_nodes_of_whole_bricks(bricks, words):
    nodes = Nodes(NOWHERE.astype(np.float32), NOWHERE, np.float32(1.0), (bricks, 2, 3))
    assert BRICK == (8, 4, 4)
    assert nodes.shape == (8 * bricks, 8, 12)
    assert (nodes.words, nodes.rows, nodes.mask_bytes) == (words, 96, 384 * words)
    assert nodes.brick_words == -(-bricks // 32)
    assert nodes.layer_bytes == 4 * 8 * bricks * 8 * 4


@pytest.mark.parametrize(("cells", "words"), [(1, 1), (32, 1), (33, 2), (64, 2), (1056, 33), (1057, 34)])
def test_words_of_a_grid_hold_32_cells_each(cells, words):
    plan = GridPlan(np.zeros((1, 3), np.float32), NOWHERE, NOWHERE.astype(np.float32), np.float32(1.0), (cells, 3, 5))
    assert (plan.words, plan.total_words) == (words, 15 * words)


def test_grid_with_a_cell_for_each_point_needs_the_bytes_of_its_buffers():
    """The order of the points stays beside their sorted coordinates and the first point of each cell."""
    for n in (1, 1000):
        points = np.zeros((n, 3), np.float32)
        plan = GridPlan(points, NOWHERE, NOWHERE.astype(np.float32), np.float32(1.0), (33, 3, 5))
        gathering = 4 * n + 4 * n + 3 * 4 * (n + PADDING) + 4 * (n + 1)
        sorting = 4 * n + sort_bytes(device(1), n, n.bit_length())
        assert plan.needs(device(1)) == {
            "points": 12 * n,
            "sorted points": max(gathering, sorting),
            "cells of the grid": 8 * 30,
        }
    assert gathering > sorting


def sample_grid(ni: int, nj: int = 4, nk: int = 5) -> SampleGrid:
    volume = Volume(np.zeros((nk, nj, ni), np.int16), np.eye(4))
    return SampleGrid(volume, choose_iso_rule(volume, 100, closed=False))


@pytest.mark.parametrize(
    ("ni", "words", "shift"),
    [(2, 1, 5), (32, 1, 5), (33, 2, 5), (1024, 32, 5), (1025, 33, 6), (2048, 64, 6), (2049, 65, 7)],
)
def test_words_of_samples_hold_32_each(ni, words, shift):
    grid = sample_grid(ni)
    assert (grid.words, grid.row_shift, grid.flag_words) == (words, shift, 2 ** (shift - 5))


def test_slab_counts_its_slices_rows_and_bytes():
    grid = sample_grid(40, 7, 12)
    for first, end, classified, counted in ((0, 12, 12, 12), (3, 6, 5, 4), (3, 11, 9, 9), (9, 10, 3, 2)):
        slab = Slab(grid, first, end)
        assert (slab.slices, slab.rows, slab.is_whole) == (end - first, 7 * (end - first), end - first == 12)
        assert (slab.mask_slices, slab.mask_rows, slab.counted_rows) == (classified, 7 * classified, 7 * counted)
        assert slab.scratch() == {
            "inside mask": 4 * 7 * classified * 2,
            "word counts": 4 * 7 * counted * 2,
            "row extents": 4 * 7 * classified,
            "row counts": 12 * 7 * counted,
            "word flags": 4 * 7 * counted,
            "active words": 4 * 7 * (end - first) * 2,
        }
        assert all(type(size) is int for size in slab.scratch().values())


def test_masks_and_searches_need_the_bytes_of_their_buffers():
    assert mask_bytes((64, 3, 5)) == {"mask of the voxels": 4 * 2 * 15, "row extents": 60}
    assert mask_bytes((65, 3, 5), pad=2) == {"mask of the voxels": 4 * 5 * 15, "row extents": 60}
    for reach, pad in ((0, 0), (1, 1), (32, 1), (33, 2)):
        assert pad_for(SimpleNamespace(reach=reach)) == pad  # type: ignore[arg-type]
    stencil: Any = SimpleNamespace(rows=np.zeros(7, np.int32), tables=np.zeros(11, np.int32))
    assert search_bytes(mask_bytes((64, 3, 5)), stencil, 15) == {
        **mask_bytes((64, 3, 5)),
        "mask of core voxels": 120,
        "counts of rows": 180,
        "stencil": 56 + 88,
    }


@pytest.mark.parametrize(("slices", "ends"), [(10, []), (5, [5, 10]), (4, [4, 8, 10])])
def test_several_slabs_of_voxels_are_told(slices, ends):
    emission: Any = SimpleNamespace(volume=SimpleNamespace(shape_ijk=(4, 4, 10)), _next=0, _parts=[], marked=0, slabs=0)
    emission._one_slab = lambda first, end: ((None, []), 1)
    told: list[tuple] = []
    VoxelEmission._go_on(emission, slices, lambda *said: told.append(said))
    assert told == [("slabs", end, 10) for end in ends]
    assert emission.marked == emission.slabs == max(len(ends), 1)


def test_slab_of_voxels_needs_the_bytes_of_its_buffers():
    emission: Any = SimpleNamespace(
        volume=SimpleNamespace(shape_ijk=(65, 7, 20)),
        selection=SimpleNamespace(labels=None, shell=False),
        resident=SimpleNamespace(slice_bytes=65 * 7 * 2),
    )
    inside = {"volume": 4 * 910, "masks": 4 * 4 * 7 * 3, "rows": 13 * 4 * 7}
    assert VoxelEmission.needs(emission, 4) == inside
    assert VoxelEmission.needs(emission, 4, 10) == {**inside, "points": 200}
    emission.selection = SimpleNamespace(labels=np.zeros(0, np.uint16), shell=True)
    assert VoxelEmission.needs(emission, 4) == {
        "volume": 6 * 910,
        "masks": 4 * 6 * 7 * 3 * 2,
        "rows": 4 * 6 * 7 + 9 * 4 * 7,
        "labels": 6 * 910,
    }
    assert VoxelEmission.needs(emission, 19)["volume"] == 20 * 910
    assert all(type(size) is int for size in VoxelEmission.needs(emission, 4).values())


def device(cores: int, has_long_items: bool = True) -> Any:
    return SimpleNamespace(compute_units=cores, has_long_items=has_long_items)


SIXTEEN_CHUNKS = 16 * FEWEST_PER_CHUNK
"""Keys of the most chunks that one core gets before they grow longer."""


@pytest.mark.parametrize(
    ("planned_for", "keys", "chunks"),
    [
        (device(1), 1, (FEWEST_PER_CHUNK, 1)),
        (device(1), SIXTEEN_CHUNKS, (FEWEST_PER_CHUNK, 16)),
        (device(1), SIXTEEN_CHUNKS + 1, (FEWEST_PER_CHUNK + 1, 16)),
        (device(3), 24 * 5000 + 1, (5001, 24)),
        (device(3, False), 24 * 5000 + 1, (FEWEST_PER_CHUNK, 30)),
        (device(10_000), MOST_CHUNKS * 5000, (5000, MOST_CHUNKS)),
    ],
    ids=["one key", "sixteen chunks", "one key more", "three cores", "short items", "most chunks"],
)
def test_chunks_of_a_sort_are_planned_by_cores_and_keys(planned_for, keys, chunks):
    assert _plan_chunks(planned_for, keys) == chunks


def test_digits_of_a_sort_share_the_bits_of_its_keys():
    assert _plan_digits(RADIX_BITS) == [(0, RADIX_BITS)]
    assert _plan_digits(2 * RADIX_BITS - 1) == [(0, RADIX_BITS - 1), (RADIX_BITS - 1, RADIX_BITS)]


@pytest.mark.parametrize(
    ("keys", "bits", "size"),
    [
        (1000, RADIX_BITS, 8 * 1000 + (4 << RADIX_BITS)),
        (1000, RADIX_BITS + 1, 16 * 1000 + (4 << RADIX_BITS)),
        (1000, 3, 8 * 1000 + 4 * 2**3),
        (SIXTEEN_CHUNKS + 1, 3, 8 * (SIXTEEN_CHUNKS + 1) + 4 * 2**3 * 16),
    ],
    ids=["one digit", "two digits", "three bits", "sixteen chunks"],
)
def test_bytes_of_a_sort_are_its_keys_a_pass_and_a_count_of_each_digit_a_chunk(keys, bits, size):
    assert sort_bytes(device(1), keys, bits) == size


def test_chunks_of_clusters_grow_with_the_cells_a_core():
    def chunk(cells: int, cores: int, is_cpu: bool = True) -> int:
        search: Any = SimpleNamespace(_is_cpu=is_cpu, _grid=SimpleNamespace(cells=cells), _device=device(cores))
        return ClusterSearch._plan_chunk(search)

    a_core = CHUNKS_A_CORE * CELLS_A_CHUNK
    assert chunk(10**6, 2, is_cpu=False) == CELLS_A_CHUNK
    assert (chunk(1, 4), chunk(4 * a_core, 4), chunk(4 * a_core + 1, 4)) == (32, CELLS_A_CHUNK, 2 * CELLS_A_CHUNK)
    assert chunk(12 * a_core, 4) == 3 * CELLS_A_CHUNK


def test_items_of_a_picture_are_those_of_its_tiles():
    for size, tiles in (((TILE, TILE), 1), ((TILE + 1, TILE), 2), ((3 * TILE, 2 * TILE + 1), 9)):
        picture: Any = SimpleNamespace(size=size)
        picture.tiles = PictureBuffers.tiles.fget(picture)  # type: ignore[attr-defined]
        assert picture.tiles == tiles
        for queues, lanes in ((1, 1), (2, 8), (4, 1)):
            items = PictureBuffers.items(picture, queues, lanes)
            assert items == -(-tiles // queues) * queues * TILE * TILE // lanes
            assert type(items) is int
    assert PictureBuffers.needs((30, 20)) == ({"picture": 7200}, {"states of the rays": 19200})


def test_the_table_of_colours_has_ten_bits_a_channel(monkeypatch):
    monkeypatch.setattr(ray_pictures, "upload", lambda device, table: table)
    function = TransferFunction([(0, 1.0, 0.5, 0.0, 0.0), (100, 0.0, 0.5, 1.0, 1.0)])
    tables = ray_pictures.TransferTables.of(device(1), function, 1.0)
    assert (tables.low, len(tables.colors_d), tables.shown_ends) == (
        0.0,
        ray_pictures.NODES,
        (1, ray_pictures.NODES - 1),
    )
    for node, expected in ((0, (1023, 511.5, 0)), (-1, (0, 511.5, 1023))):
        color = int(tables.colors_d[node])
        assert [color >> 20, color >> 10 & 1023, color & 1023] == pytest.approx(expected, abs=1.0)


def test_the_window_of_a_cloud_begins_below_its_lowest_values():
    hu = np.linspace(100.0, 400.0, 30_001).astype(np.float32)
    low, high = _choose_window(hu)
    lowest = (low + DARKEST_SHARE * high) / (1.0 + DARKEST_SHARE)
    assert 100.0 <= lowest < high <= 400.0
    assert low == pytest.approx(lowest - DARKEST_SHARE * (high - lowest))
    assert low < 100.0


@pytest.mark.parametrize("k", [8, 16])
def test_edge_of_cells_follows_the_density_of_points(k):
    """27 cells of even points hold 5.6 k of them, or 40."""
    points = np.random.default_rng(7).random((20_000, 3)).astype(np.float32)
    wanted = max(40.0, 5.6 * k)
    expected = (wanted / len(points)) ** (1 / 3) / 3.0
    assert choose_cell_edge(points, k) == pytest.approx(expected, rel=0.1)
    assert choose_cell_edge(100.0 * points, k) == pytest.approx(100.0 * expected, rel=0.1)
    assert choose_cell_edge(np.ones((5, 3), np.float32), k) == 1.0


def test_edges_that_are_not_passed_once_each_way_are_counted():
    closed = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
    assert _count_open_edges(closed, 4) == 0
    assert _count_open_edges(closed[:3], 4) > 0
    assert _count_open_edges(np.concatenate([closed[:3], closed[3:, ::-1]]), 4) > 0
    assert _count_open_edges(np.concatenate([closed, closed]), 4) == 12  # each twice


def test_what_a_search_for_ghosts_takes_beside_its_band_is_named():
    kinds = {name: parameter.kind for name, parameter in signature(find_ghost_slices).parameters.items()}
    named = {"device", "memory", "progress"}
    assert {name for name, kind in kinds.items() if kind == Parameter.KEYWORD_ONLY} == named
    assert {name for name, kind in kinds.items() if kind == Parameter.POSITIONAL_OR_KEYWORD} == {"volume", "hu"}


def test_first_step_to_the_volume_of_a_label_is_by_its_slope(monkeypatch):
    """The slope by which levels move the volume, of 300 vertices over voxels of 3 mm3."""
    told = []
    monkeypatch.setattr(label_masks, "next_level", lambda tried, wanted, slope: told.append((wanted, slope)) or 7)
    mesh: Any = SimpleNamespace(
        counted=SimpleNamespace(vertices=300),
        run=SimpleNamespace(labels=SimpleNamespace(affine=np.diag([2.0, -3.0, 0.5, 1.0]))),
        place=lambda level: None,
        emission=SimpleNamespace(download=lambda: "mesh"),
    )
    assert label_masks.StartedMesh.keep_volume(mesh, 10.0, closed=False) == ("mesh", 7)
    ((wanted, slope),) = told
    assert (wanted, slope) == (10.0, pytest.approx(-(300 / FACES_PER_AREA) * 3.0 / (STEEPNESS * FULL)))


def test_heights_of_an_uneven_volume_count_from_its_first_slice():
    for sign in (1.0, -1.0):
        volume = uneven(sign=sign)
        places = FieldFrame.of(volume).places(volume.slice_origins())
        np.testing.assert_allclose(places[0], 0.0, atol=1e-9)
        np.testing.assert_allclose(np.abs(places[:, 2]), HEIGHTS, atol=1e-9)
        inner = FieldFrame.of(volume).places(volume.ijk_to_lps(np.array([[2.0, 1.0, 0.0]])))
        np.testing.assert_allclose(inner, [[2.0, 1.0, 0.0]], atol=1e-9)


def test_voxels_of_a_box_of_more_than_2_to_the_31_are_told_apart():
    """The number of the last is 2^32: in 32 bits it is that of the first."""
    ijk = np.array([[0, 0, 0], [2047, 2047, 0], [0, 0, 1024]], np.int32)
    assert _order_voxels(ijk)[0] is None
    order, ordered = _order_voxels(ijk[::-1])
    assert order is not None
    assert (order.tolist(), ordered.tolist()) == ([2, 1, 0], ijk.tolist())
    with refused(UsageError, "points", 1, 4):
        _order_voxels(ijk[[0, 1, 2, 1]])


@pytest.mark.parametrize(("radius", "pixels"), [(4.0, 8.0), (1.5, 3.0), (1e-9, SMALLEST_DISC), (1e9, LARGEST_DISC)])
def test_discs_have_their_radius_in_pixels_within_limits(radius, pixels):
    """Half a mm a pixel."""
    camera = Camera((0.0, -50.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=11.75)
    nothing = np.zeros((0, 3), np.float32)
    discs = Discs(nothing, np.zeros((0, 4), np.uint8), nothing, radius, Lighting())
    splats = _Splats(device(1), discs, Shot(camera, (61, 47)))
    assert splats.disc_pixels == pytest.approx(pixels)


def test_table_of_an_uneven_stack_has_heights_steps_and_shifts(monkeypatch):
    """Heights, steps and shifts as the volume was made with; three rows of each slice are its normal matrix."""
    monkeypatch.setattr(stack_table, "upload", lambda device, array: array)
    volume = uneven()
    made = stack_table.StackTable.of(volume, device(1))
    table, gaps = made.arguments["stack_slices"], np.diff(HEIGHTS)
    np.testing.assert_allclose(table[:, 0, 0], HEIGHTS, atol=1e-5)
    np.testing.assert_allclose(table[:, 0, 1:3], np.column_stack([0.0 * SIDEWAYS, SIDEWAYS]), atol=1e-5)
    np.testing.assert_allclose(table[:, 0, 3], [*(1.0 / gaps), 0.0], rtol=1e-5)
    np.testing.assert_array_equal(table[:, 1:, :3], slice_normal_matrices(volume, border=0).astype(np.float32))
    np.testing.assert_allclose(made.slope, [0.0, np.abs(np.diff(SIDEWAYS) / gaps).max(), 1 / 0.25, 0.0], atol=1e-5)
    np.testing.assert_allclose(
        made.index_steps(np.array([1.0, 2.0, 0.5])), [1.0, 2.0 + 0.5 * made.slope[1], 2.0], rtol=1e-6
    )
    assert (made.arguments["stack_nk"], len(made.arguments["stack_layers"])) == (6, made.arguments["layer_count"])


@pytest.mark.parametrize(("room", "ends"), [(1, [1, 2, 3, 4, 5]), (2, [2, 4, 5]), (4, [4, 5]), (5, [5]), (9, [5])])
def test_slabs_of_a_field_are_as_thick_as_there_is_room(room, ends, monkeypatch):
    nodes = Nodes(NOWHERE.astype(np.float32), NOWHERE, np.float32(1.0), (3, 2, 5))
    monkeypatch.setattr(
        field.ocl,
        "describe_shortage",
        lambda limits, needs: "" if needs["nodes"] <= limits * nodes.layer_bytes else "much",
    )
    planned: Any = SimpleNamespace(
        nodes=nodes,
        _list=np.arange(0, 32 * 2 * 5, 4),  # eight of the 32 places of each row of bricks
        grid=SimpleNamespace(nbytes=0, n=1),
        limits=room,
        bricks=80,
        _kept=lambda n: {},
    )
    slabs = NodeField._plan_slabs(planned)
    assert [(slab.first, slab.end) for slab in slabs] == list(zip([0, *ends[:-1]], ends, strict=True))
    assert [(slab.first_brick, slab.end_brick) for slab in slabs] == [(16 * s.first, 16 * s.end) for s in slabs]
    planned.limits = 0
    with refused(DeviceMemoryError, "surface", "cloud"):
        NodeField._plan_slabs(planned)
