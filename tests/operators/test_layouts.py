"""Words of rows, bits of numbers, shares of work and bytes of forecasts: closed cases without a device."""

from __future__ import annotations

from inspect import Parameter, signature
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import refused
from tolerances import FLOAT64_PLACE_MM
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


def nodes_of_bricks(along_x: int, along_y: int = 2, along_z: int = 3) -> Nodes:
    corner = NOWHERE.astype(np.float32)
    return Nodes(corner=corner, base=NOWHERE, spacing=np.float32(1.0), bricks=(along_x, along_y, along_z))


@pytest.mark.parametrize(("bricks", "words"), [(1, 1), (3, 1), (4, 1), (5, 2), (8, 2), (9, 3), (132, 33), (133, 34)])
def test_words_of_a_field_hold_the_nodes_of_whole_bricks(bricks, words):
    """A brick has 8 x 4 x 4 nodes, and a word 32 of a row."""
    nodes = nodes_of_bricks(bricks)
    assert BRICK == (8, 4, 4)
    assert nodes.shape == (8 * bricks, 4 * 2, 4 * 3)
    rows = 4 * 2 * 4 * 3
    assert (nodes.words, nodes.rows, nodes.mask_bytes) == (words, rows, 4 * words * rows)


@pytest.mark.parametrize(("bricks", "words"), [(1, 1), (32, 1), (33, 2), (132, 5)])
def test_words_of_bricks_hold_32_each(bricks, words):
    assert nodes_of_bricks(bricks).brick_words == words


def test_layer_of_bricks_takes_four_bytes_a_node():
    assert nodes_of_bricks(along_x=5, along_y=2).layer_bytes == 4 * (8 * 5) * (4 * 2) * 4


def plan_grid(*, points: int, shape: tuple[int, int, int]) -> GridPlan:
    places, corner = np.zeros((points, 3), np.float32), NOWHERE.astype(np.float32)
    return GridPlan(points=places, base=NOWHERE, corner=corner, edge=np.float32(1.0), shape=shape)


@pytest.mark.parametrize(("cells", "words"), [(1, 1), (32, 1), (33, 2), (64, 2), (1056, 33), (1057, 34)])
def test_words_of_a_grid_hold_32_cells_each(cells, words):
    plan = plan_grid(points=1, shape=(cells, 3, 5))
    assert (plan.words, plan.total_words) == (words, 3 * 5 * words)


@pytest.mark.parametrize("points", [1, 1000])
def test_grid_needs_the_bytes_of_its_buffers(points):
    """The order of the points stays beside their sorted coordinates and the first point of each cell."""
    plan = plan_grid(points=points, shape=(33, 3, 5))  # two words a row
    cells, order, coordinates, starts = 4 * points, 4 * points, 3 * 4 * (points + PADDING), 4 * (points + 1)
    gathering = cells + order + coordinates + starts
    sorting = order + sort_bytes(device(1), points, points.bit_length())
    assert plan.needs(device(1)) == {
        "points": 3 * 4 * points,
        "sorted points": max(gathering, sorting),
        "cells of the grid": 2 * 4 * (2 * 3 * 5),  # marks, and points before each word
    }


def sample_grid(ni: int, nj: int = 4, nk: int = 5) -> SampleGrid:
    volume = Volume(np.zeros((nk, nj, ni), np.int16), np.eye(4))
    return SampleGrid(volume, choose_iso_rule(volume, 100, closed=False))


@pytest.mark.parametrize(
    ("ni", "words", "shift"),
    [(2, 1, 5), (32, 1, 5), (33, 2, 5), (1024, 32, 5), (1025, 33, 6), (2048, 64, 6), (2049, 65, 7)],
)
def test_words_of_samples_hold_32_each_and_are_flagged_by_a_power_of_two_of_words(ni, words, shift):
    """Of 2^shift words, at least 32, each has a bit in the flags of its row."""
    grid = sample_grid(ni)
    assert words <= 2**shift
    assert (grid.words, grid.row_shift, grid.flag_words) == (words, shift, 2**shift // 32)


@pytest.fixture(
    params=[(0, 12, 12, 12), (3, 6, 5, 4), (3, 11, 9, 9), (9, 10, 3, 2)], ids=["all", "3 to 5", "3 to 10", "9"]
)
def slab_of_twelve(request) -> tuple[Slab, int, int, int]:
    """A slab of 12 slices of 7 rows and 40 columns; its slices, those that are classified, and those counted."""
    first, end, classified, counted = request.param
    return Slab(sample_grid(40, nj=7, nk=12), first, end), end - first, classified, counted


def test_slab_has_the_rows_of_its_slices_and_of_their_neighbours(slab_of_twelve):
    slab, slices, classified, counted = slab_of_twelve
    assert (slab.slices, slab.rows, slab.is_whole) == (slices, 7 * slices, slices == 12)
    assert (slab.mask_slices, slab.mask_rows, slab.counted_rows) == (classified, 7 * classified, 7 * counted)


def test_slab_needs_the_bytes_of_its_buffers(slab_of_twelve):
    slab, slices, classified, counted = slab_of_twelve
    words = 2  # of 40 columns
    assert slab.scratch() == {
        "inside mask": 4 * 7 * classified * words,
        "word counts": 4 * 7 * counted * words,
        "row extents": 4 * 7 * classified,
        "row counts": 3 * 4 * 7 * counted,
        "word flags": 4 * 7 * counted,
        "active words": 4 * 7 * slices * words,
    }
    assert {type(size) for size in slab.scratch().values()} == {int}


@pytest.mark.parametrize(("columns", "pad", "words"), [(64, 0, 2), (65, 2, 3 + 2)])
def test_mask_needs_the_bytes_of_its_words_and_row_extents(columns, pad, words):
    rows = 3 * 5
    assert mask_bytes((columns, 3, 5), pad=pad) == {"mask of the voxels": 4 * words * rows, "row extents": 4 * rows}


@pytest.mark.parametrize(("reach", "pad"), [(0, 0), (1, 1), (32, 1), (33, 2)])
def test_mask_is_padded_by_the_words_that_a_stencil_reaches(reach, pad):
    assert pad_for(SimpleNamespace(reach=reach)) == pad  # type: ignore[arg-type]


def test_search_for_clusters_needs_the_bytes_of_its_mask_counts_and_stencil():
    stencil: Any = SimpleNamespace(rows=np.zeros(7, np.int32), tables=np.zeros(11, np.int32))
    rows, words = 3 * 5, 2
    mask = mask_bytes((64, 3, 5))
    assert search_bytes(mask, stencil, rows) == {
        **mask,
        "mask of core voxels": 4 * words * rows,
        "counts of rows": 3 * 4 * rows,
        "stencil": 2 * 4 * 7 + 2 * 4 * 11,
    }


@pytest.mark.parametrize(("slices", "ends"), [(10, []), (5, [5, 10]), (4, [4, 8, 10])])
def test_progress_of_voxel_extraction_is_told_after_each_of_several_slabs(slices, ends):
    emission: Any = SimpleNamespace(volume=SimpleNamespace(shape_ijk=(4, 4, 10)), _next=0, _parts=[], marked=0, slabs=0)
    emission._one_slab = lambda first, end: ((None, []), 1)
    told: list[tuple] = []
    VoxelEmission._go_on(emission, slices, lambda *said: told.append(said))
    assert told == [("slabs", end, 10) for end in ends]
    assert emission.marked == emission.slabs == max(len(ends), 1)


SLICE_OF_65_X_7 = 65 * 7 * 2  # bytes
WORDS_OF_65 = 3


def emission_of_20_slices(labels: Any = None, shell: bool = False) -> Any:
    """What an extraction of voxels knows of a volume of 65 x 7 x 20."""
    return SimpleNamespace(
        volume=SimpleNamespace(shape_ijk=(65, 7, 20)),
        selection=SimpleNamespace(labels=labels, shell=shell),
        resident=SimpleNamespace(slice_bytes=SLICE_OF_65_X_7),
    )


def test_slab_of_voxels_needs_the_bytes_of_its_buffers():
    inside = {"volume": 4 * SLICE_OF_65_X_7, "masks": 4 * 4 * 7 * WORDS_OF_65, "rows": (4 + 9) * 4 * 7}  # bytes a row
    assert VoxelEmission.needs(emission_of_20_slices(), slices=4) == inside
    assert VoxelEmission.needs(emission_of_20_slices(), slices=4, points=10) == {**inside, "points": 20 * 10}


def test_slab_of_the_shell_of_a_label_needs_the_bytes_of_a_slice_more_at_either_end():
    emission = emission_of_20_slices(labels=np.zeros(0, np.uint16), shell=True)
    read = 4 + 2
    assert VoxelEmission.needs(emission, slices=4) == {
        "volume": read * SLICE_OF_65_X_7,
        "masks": 2 * 4 * read * 7 * WORDS_OF_65,  # of the voxels, and of the shell
        "rows": 4 * read * 7 + 9 * 4 * 7,  # bytes of rows that are read, and of rows in the slab
        "labels": read * SLICE_OF_65_X_7,
    }


def test_slab_of_a_shell_reads_no_more_slices_than_the_volume_has():
    emission = emission_of_20_slices(labels=np.zeros(0, np.uint16), shell=True)
    assert VoxelEmission.needs(emission, slices=19)["volume"] == 20 * SLICE_OF_65_X_7


def test_bytes_of_a_slab_of_voxels_are_python_integers():
    """Those of numpy would overflow."""
    emission = emission_of_20_slices(labels=np.zeros(0, np.uint16), shell=True)
    assert {type(size) for size in VoxelEmission.needs(emission, slices=4).values()} == {int}


def device(cores: int, has_long_items: bool = True) -> Any:
    """What planning asks of a device."""
    return SimpleNamespace(compute_units=cores, has_long_items=has_long_items)


SIXTEEN_CHUNKS = 16 * FEWEST_PER_CHUNK
"""Keys of the most chunks that one core gets before they grow longer."""


@pytest.mark.parametrize(
    ("planned_for", "keys", "chunks"),
    [
        (device(1), 1, (FEWEST_PER_CHUNK, 1)),
        (device(1), SIXTEEN_CHUNKS, (FEWEST_PER_CHUNK, 16)),
        (device(1), SIXTEEN_CHUNKS + 1, (FEWEST_PER_CHUNK + 1, 16)),
        (device(3), 24 * 5000 + 1, (5001, 24)),  # eight a core
        (device(3, has_long_items=False), 24 * 5000 + 1, (FEWEST_PER_CHUNK, -(-(24 * 5000 + 1) // FEWEST_PER_CHUNK))),
        (device(10_000), MOST_CHUNKS * 5000, (5000, MOST_CHUNKS)),
    ],
    ids=["one key", "sixteen chunks", "one key more", "three cores", "short items", "most chunks"],
)
def test_chunks_of_a_sort_are_planned_by_cores_and_keys(planned_for, keys, chunks):
    assert _plan_chunks(planned_for, keys) == chunks


@pytest.mark.parametrize(
    ("bits", "digits"),
    [(RADIX_BITS, [(0, RADIX_BITS)]), (2 * RADIX_BITS - 1, [(0, RADIX_BITS - 1), (RADIX_BITS - 1, RADIX_BITS)])],
    ids=["one digit", "two digits"],
)
def test_digits_of_a_sort_share_the_bits_of_its_keys(bits, digits):
    """Each digit begins at a bit and has so many."""
    assert _plan_digits(bits) == digits


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


CELLS_OF_FOUR_CORES = 4 * CHUNKS_A_CORE * CELLS_A_CHUNK


def plan_chunk(cells: int, is_cpu: bool) -> int:
    """Cells of a chunk on a device of four cores."""
    search: Any = SimpleNamespace(_is_cpu=is_cpu, _grid=SimpleNamespace(cells=cells), _device=device(4))
    return ClusterSearch._plan_chunk(search)


@pytest.mark.parametrize(
    ("cells", "chunk"),
    [
        (1, 32),
        (CELLS_OF_FOUR_CORES, CELLS_A_CHUNK),
        (CELLS_OF_FOUR_CORES + 1, 2 * CELLS_A_CHUNK),
        (3 * CELLS_OF_FOUR_CORES, 3 * CELLS_A_CHUNK),
    ],
    ids=["one cell", "whole chunks", "one cell more", "three times as many"],
)
def test_chunks_of_clusters_grow_with_the_cells_a_core_of_a_cpu(cells, chunk):
    assert plan_chunk(cells, is_cpu=True) == chunk


def test_chunks_of_clusters_are_of_one_size_on_a_gpu():
    assert plan_chunk(10**6, is_cpu=False) == CELLS_A_CHUNK


@pytest.mark.parametrize(("queues", "lanes"), [(1, 1), (2, 8), (4, 1)])
@pytest.mark.parametrize(
    ("size", "tiles"), [((TILE, TILE), 1), ((TILE + 1, TILE), 2), ((3 * TILE, 2 * TILE + 1), 3 * 3)]
)
def test_work_items_of_a_picture_are_those_of_its_tiles_shared_among_queues_and_lanes(size, tiles, queues, lanes):
    picture: Any = SimpleNamespace(size=size)
    picture.tiles = PictureBuffers.tiles.fget(picture)  # type: ignore[attr-defined]
    assert picture.tiles == tiles
    items = PictureBuffers.items(picture, queues, lanes)
    tiles_a_queue = -(-tiles // queues)
    assert items == tiles_a_queue * queues * TILE * TILE // lanes
    assert type(items) is int


def test_picture_needs_12_bytes_a_pixel_and_32_for_the_state_of_its_ray():
    assert PictureBuffers.needs((30, 20)) == ({"picture": 12 * 30 * 20}, {"states of the rays": 32 * 30 * 20})


@pytest.mark.parametrize(
    ("node", "channels"), [(0, (1.0, 0.5, 0.0)), (-1, (0.0, 0.5, 1.0))], ids=["first node", "last node"]
)
def test_colours_of_the_transfer_table_have_ten_bits_a_channel(monkeypatch, node, channels):
    monkeypatch.setattr(ray_pictures, "upload", lambda device, table: table)
    function = TransferFunction([(0, 1.0, 0.5, 0.0, 0.0), (100, 0.0, 0.5, 1.0, 1.0)])  # HU, colour, opacity
    color = int(ray_pictures.TransferTables.of(device(1), function, ray_step=1.0).colors_d[node])
    # A step of ten bits; measured half.
    assert [color >> 20, color >> 10 & 1023, color & 1023] == pytest.approx(1023 * np.array(channels), abs=1.0)


def test_transfer_table_begins_at_the_lowest_hu_and_shows_all_nodes_but_the_transparent_first(monkeypatch):
    monkeypatch.setattr(ray_pictures, "upload", lambda device, table: table)
    function = TransferFunction([(0, 1.0, 0.5, 0.0, 0.0), (100, 0.0, 0.5, 1.0, 1.0)])
    tables = ray_pictures.TransferTables.of(device(1), function, ray_step=1.0)
    assert tables.low == 0.0
    assert len(tables.colors_d) == ray_pictures.NODES
    assert tables.shown_ends == (1, ray_pictures.NODES - 1)


def test_the_window_of_a_cloud_begins_below_its_lowest_values_by_the_darkest_share():
    hu = np.linspace(100.0, 400.0, 30_001).astype(np.float32)
    low, high = _choose_window(hu)
    lowest = (low + DARKEST_SHARE * high) / (1.0 + DARKEST_SHARE)  # that a grey of the darkest share stands for
    assert low < 100.0 <= lowest < high <= 400.0


@pytest.mark.parametrize("size", [1.0, 100.0])
@pytest.mark.parametrize("k", [8, 16])
def test_edge_of_cells_follows_the_density_of_points(k, size):
    """27 cells of even points hold 5.6 k of them, or 40."""
    points = np.random.default_rng(7).random((20_000, 3)).astype(np.float32)
    share_of_points = max(40.0, 5.6 * k) / len(points)
    side_of_27_cells = share_of_points ** (1 / 3)
    # Estimated from a sample; measured 0.077.
    assert choose_cell_edge(size * points, k) == pytest.approx(size * side_of_27_cells / 3.0, rel=0.1)


def test_edge_of_cells_of_equal_points_is_one_millimetre():
    assert choose_cell_edge(np.ones((5, 3), np.float32), k=8) == 1.0


TETRAHEDRON = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])


def test_closed_tetrahedron_has_no_open_edge():
    assert _count_open_edges(TETRAHEDRON, vertices=4) == 0


@pytest.mark.parametrize(
    "triangles",
    [TETRAHEDRON[:3], np.concatenate([TETRAHEDRON[:3], TETRAHEDRON[3:, ::-1]])],
    ids=["a face less", "a face turned"],
)
def test_three_edges_of_a_missing_or_turned_face_are_open(triangles):
    assert _count_open_edges(triangles, vertices=4) == 3


def test_edges_that_are_passed_twice_each_way_are_open():
    each_face_twice = np.concatenate([TETRAHEDRON, TETRAHEDRON])
    assert _count_open_edges(each_face_twice, vertices=4) == 6


def test_search_for_ghost_slices_takes_device_memory_and_progress_by_name_alone():
    kinds = {name: parameter.kind for name, parameter in signature(find_ghost_slices).parameters.items()}
    by_name = dict.fromkeys(("device", "memory", "progress"), Parameter.KEYWORD_ONLY)
    assert kinds == dict.fromkeys(("volume", "hu"), Parameter.POSITIONAL_OR_KEYWORD) | by_name


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
    assert label_masks.StartedMesh.keep_volume(mesh, wanted=10.0, closed=False) == ("mesh", 7)
    ((wanted, slope),) = told
    assert (wanted, slope) == (10.0, pytest.approx(-(300 / FACES_PER_AREA) * 3.0 / (STEEPNESS * FULL)))


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["along the normal", "against it"])
def test_heights_of_an_uneven_volume_count_from_its_first_slice(sign):
    volume = uneven(sign=sign)
    places = FieldFrame.of(volume).places(volume.slice_origins())
    np.testing.assert_allclose(places[0], 0.0, atol=FLOAT64_PLACE_MM)
    np.testing.assert_allclose(np.abs(places[:, 2]), HEIGHTS, atol=FLOAT64_PLACE_MM)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["along the normal", "against it"])
def test_places_of_the_first_slice_of_an_uneven_volume_are_its_columns_and_rows(sign):
    volume = uneven(sign=sign)
    column_2_row_1 = volume.ijk_to_lps(np.array([[2.0, 1.0, 0.0]]))
    places = FieldFrame.of(volume).places(column_2_row_1)
    np.testing.assert_allclose(places, [[2.0, 1.0, 0.0]], atol=FLOAT64_PLACE_MM)


FAR_VOXELS = np.array([[0, 0, 0], [2047, 2047, 0], [0, 0, 1024]], np.int32)
"""In a box of 2048 x 2048 x 1025: the number of the last is 2^32, in 32 bits that of the first."""


def test_voxels_that_lie_in_their_order_are_not_put_into_another():
    order, _ = _order_voxels(FAR_VOXELS)
    assert order is None


def test_voxels_of_a_box_of_more_than_2_to_the_31_are_ordered():
    order, ordered = _order_voxels(FAR_VOXELS[::-1])
    assert order is not None
    assert order.tolist() == [2, 1, 0]
    assert ordered.tolist() == FAR_VOXELS.tolist()


def test_a_voxel_twice_is_refused_with_how_many_there_are():
    with refused(UsageError, "points", 1, 4):
        _order_voxels(FAR_VOXELS[[0, 1, 2, 1]])


@pytest.mark.parametrize(("radius", "pixels"), [(4.0, 8.0), (1.5, 3.0), (1e-9, SMALLEST_DISC), (1e9, LARGEST_DISC)])
def test_discs_have_their_radius_in_pixels_within_limits(radius, pixels):
    """The camera shows 11.75 mm above and below the middle in 47 rows: half a millimetre a pixel."""
    camera = Camera(position=(0.0, -50.0, 0.0), focal_point=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), parallel_scale=11.75)
    nothing = np.zeros((0, 3), np.float32)
    colors = np.zeros((0, 4), np.uint8)
    discs = Discs(points=nothing, colors=colors, normals=nothing, radius_mm=radius, lighting=Lighting())
    splats = _Splats(device(1), discs, Shot(camera, (61, 47)))
    assert splats.disc_pixels == pytest.approx(pixels)


@pytest.fixture
def stack_of_uneven(monkeypatch):
    """The table of an uneven volume that the device would get."""
    monkeypatch.setattr(stack_table, "upload", lambda device, array: array)
    return stack_table.StackTable.of(uneven(), device(1))


GAPS = np.diff(HEIGHTS)
TABLE_MM = 1e-5  # float32


def test_table_of_an_uneven_stack_has_heights_shifts_and_inverse_gaps(stack_of_uneven):
    heights, along_columns, along_rows, inverse_gaps = stack_of_uneven.arguments["stack_slices"][:, 0].T
    np.testing.assert_allclose(heights, HEIGHTS, atol=TABLE_MM)
    np.testing.assert_allclose(along_columns, 0.0, atol=TABLE_MM)
    np.testing.assert_allclose(along_rows, SIDEWAYS, atol=TABLE_MM)
    np.testing.assert_allclose(inverse_gaps, [*(1.0 / GAPS), 0.0], rtol=1e-7)  # float32; measured 3e-8


def test_table_of_an_uneven_stack_has_the_normal_matrix_of_each_slice(stack_of_uneven):
    expected = slice_normal_matrices(uneven(), border=0).astype(np.float32)
    np.testing.assert_array_equal(stack_of_uneven.arguments["stack_slices"][:, 1:, :3], expected)


def test_table_of_an_uneven_stack_has_the_steepest_shift_and_the_smallest_gap(stack_of_uneven):
    steepest = np.abs(np.diff(SIDEWAYS) / GAPS).max()
    np.testing.assert_allclose(stack_of_uneven.slope, [0.0, steepest, 1 / GAPS.min(), 0.0], atol=TABLE_MM)
    direction = np.array([1.0, 2.0, 0.5])  # along columns, rows and height
    steps = [1.0, 2.0 + 0.5 * steepest, 0.5 / GAPS.min()]
    np.testing.assert_allclose(stack_of_uneven.index_steps(direction), steps, rtol=1e-6)  # float64


def test_table_of_an_uneven_stack_counts_slices_and_layers(stack_of_uneven):
    arguments = stack_of_uneven.arguments
    assert (arguments["stack_nk"], len(arguments["stack_layers"])) == (len(HEIGHTS), arguments["layer_count"])


def plan_field_slabs(monkeypatch, layers_of_room):
    """Slabs of a field of 3 x 2 x 5 bricks, all of them with nodes, on a device with room for so many layers."""
    nodes = nodes_of_bricks(along_x=3, along_y=2, along_z=5)
    monkeypatch.setattr(
        field.ocl,
        "describe_shortage",
        lambda limits, needs: "" if needs["nodes"] <= limits * nodes.layer_bytes else "much",
    )
    planned: Any = SimpleNamespace(
        nodes=nodes,
        _list=np.arange(0, 32 * 2 * 5, 4),  # eight of the 32 places of each row of bricks
        grid=SimpleNamespace(nbytes=0, n=1),
        limits=layers_of_room,
        bricks=80,
        _kept=lambda n: {},
    )
    return NodeField._plan_slabs(planned)


@pytest.mark.parametrize(("room", "ends"), [(1, [1, 2, 3, 4, 5]), (2, [2, 4, 5]), (4, [4, 5]), (5, [5]), (9, [5])])
def test_slabs_of_a_field_are_as_thick_as_there_is_room(room, ends, monkeypatch):
    slabs = plan_field_slabs(monkeypatch, layers_of_room=room)
    assert [(slab.first, slab.end) for slab in slabs] == list(zip([0, *ends[:-1]], ends, strict=True))
    bricks_a_layer = 2 * 8
    assert [slab.end_brick for slab in slabs] == [bricks_a_layer * end for end in ends]
    assert [slab.first_brick for slab in slabs] == [0, *(bricks_a_layer * end for end in ends[:-1])]


def test_a_field_without_room_for_a_layer_is_refused(monkeypatch):
    with refused(DeviceMemoryError, "surface", "cloud"):
        plan_field_slabs(monkeypatch, layers_of_room=0)
