"""Labels' own surfaces on every device: equal to the twin, closed, with the volume and the borders of their masks."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from scipy.spatial import cKDTree
from slab_surfaces import assert_same
from surface_volumes import MIRRORED, OBLIQUE, assert_sound, random_labels
from variants import daily, daily_rows

from clrecon.errors import DeviceError, RefusedInputError, UsageError
from clrecon.geometry import apply_affine
from clrecon.labels import LabelMap
from clrecon.labels.label_levels import (
    FULL,
    KEEP,
    Borders,
    choose_levels,
    count_faces,
    find_boxes,
    find_enclosed,
    next_level,
)
from clrecon.mesh.triangles import enclosed_ml
from clrecon.opencl import Stopwatch
from clrecon.operators.surface.label_masks import extract_label_masks, survey_labels
from clrecon.proof.surface import labels as twin

SHAPES = [(5, 7, 9), (1, 4, 31), (5, 1, 33), (6, 5, 64), (4, 5, 100), (3, 4, 1030)]


def distances_from(shape, centre) -> np.ndarray:
    index = np.indices(shape, dtype=np.float64)
    return np.sqrt(sum((index[axis] - centre[axis]) ** 2 for axis in range(3)))


OFF_CENTRE = (0.31, -0.17, 0.08)


def ball_mask(shape, radius, shift=OFF_CENTRE) -> np.ndarray:
    """Voxels within a radius of the middle of the map, shifted by parts of a voxel."""
    return distances_from(shape, (np.array(shape) - 1) / 2 + shift) <= radius


def volume_share(mesh) -> float:
    """By how much the mesh is larger than its mask, as a share of it."""
    return enclosed_ml(mesh.vertices, mesh.triangles) / mesh.report["label_ml"] - 1.0


def enclosed_levels(labels, meshes) -> dict[int, int]:
    """The levels of labels that others enclose, by their numbers."""
    numbers = find_enclosed(labels, count_faces(labels))
    return {number: round(meshes[number].report["mask_level"] * FULL) for number in numbers}


@pytest.mark.every_device
@pytest.mark.parametrize("closed", daily(1, [True, False]))
@pytest.mark.parametrize("shape", daily(4, SHAPES))
def test_surfaces_of_label_masks_equal_their_twin(device, shape, closed):
    if not closed and min(shape) < 2:
        pytest.skip("an open map of one layer has no cells")
    affine = MIRRORED if shape[0] % 2 else OBLIQUE
    labels = random_labels(shape)
    meshes = extract_label_masks(LabelMap(labels, affine), device=device, closed=closed)
    enclosed = enclosed_levels(labels, meshes) if closed else {}
    assert tuple(meshes) == tuple(np.unique(labels[labels > 0]))
    for number, mesh in meshes.items():
        level = round(mesh.report["mask_level"] * FULL)
        vertices, normals, triangles = twin.extract_label_mask(
            labels, affine, number, level, closed=closed, enclosed=enclosed
        )
        assert np.array_equal(mesh.triangles, triangles)
        away = apply_affine(np.linalg.inv(affine), mesh.vertices) - apply_affine(np.linalg.inv(affine), vertices)
        assert np.abs(away).max() <= tolerances.TWIN_VERTEX_VOXEL
        assert np.abs(mesh.normals - normals).max() <= tolerances.TWIN_NORMAL
        if closed:
            assert_sound(mesh)


LEVELS_OFF = 2  # of FULL: sums of float32 may end on the other side of a whole number


def choose_level(labels, number):
    """The level at which the twin's mesh of a label encloses the volume of its voxels."""
    wanted = np.count_nonzero(labels == number) * abs(np.linalg.det(OBLIQUE[:3, :3]))
    tried: list[tuple[int, float]] = []
    level = next_level(tried, wanted, -1.0)
    while all(level != earlier for earlier, _ in tried):
        vertices, _, triangles = twin.extract_label_mask(labels, OBLIQUE, number, level)
        tried.append((level, 1000.0 * enclosed_ml(vertices, triangles)))
        level = next_level(tried, wanted, -wanted / FULL)
    return level


def test_levels_of_two_bodies_side_by_side_are_those_of_the_twin(device):
    labels = np.zeros((14, 15, 34), np.uint8)
    labels[:, :, 2:16][ball_mask((14, 15, 14), 5.2)] = 1
    labels[:, :, 15:29][ball_mask((14, 15, 14), 4.4)] = 2
    meshes = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    found = [meshes[number].report["mask_level"] * FULL for number in (1, 2)]
    expected = [choose_level(labels, number) for number in (1, 2)]
    assert found == pytest.approx(expected, abs=LEVELS_OFF)


def test_levels_of_a_body_within_another_are_those_of_the_twin(device):
    labels = np.where(ball_mask((12, 13, 14), 3.0), 2, ball_mask((12, 13, 14), 5.2)).astype(np.uint8)
    voxel_ml = abs(np.linalg.det(OBLIQUE[:3, :3])) / 1000.0

    def voxels_enclosed(levels: dict[int, int]) -> dict[int, float]:
        """By the twin's meshes at these levels."""
        meshes = {
            number: twin.extract_label_mask(labels, OBLIQUE, number, levels[number], enclosed=levels)
            for number in levels
        }
        return {n: enclosed_ml(vertices, triangles) / voxel_ml for n, (vertices, _, triangles) in meshes.items()}

    borders = Borders.of(labels, find_enclosed(labels, count_faces(labels)))
    expected = choose_levels(borders, voxels_enclosed)
    meshes = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    found = {number: mesh.report["mask_level"] * FULL for number, mesh in meshes.items()}
    assert found == pytest.approx(expected, abs=LEVELS_OFF)


@pytest.mark.parametrize("memory", [None, 100], ids=["device", "host, without room on the device"])
def test_survey_of_labels_finds_the_boxes_and_faces_of_their_voxels(device, memory):
    labels = random_labels((7, 9, 70), seed=3, numbers=(0, 0, 0, 0, 0, 2, 5, 6))
    boxes, faces = survey_labels(LabelMap(labels, np.eye(4)), device, memory, Stopwatch())
    assert boxes == find_boxes(labels, (2, 5, 6), reach=(0, 0, 0))
    assert faces.tolist() == count_faces(labels).tolist()


@pytest.mark.parametrize("memory", [None, 100], ids=["device", "host, without room on the device"])
def test_survey_of_a_single_label_finds_its_box_and_counts_no_faces(device, memory):
    """They say which labels touch: there is no other."""
    labels = random_labels((5, 6, 40), numbers=(0, 0, 4))
    boxes, faces = survey_labels(LabelMap(labels, np.eye(4)), device, memory, Stopwatch())
    assert boxes == find_boxes(labels, (4,), reach=(0, 0, 0))
    assert faces.tolist() == [[0, 0]] * 5  # of each number up to 4


def crossed_edges(mask: np.ndarray) -> np.ndarray:
    """Middles (i, j, k) of the edges between a voxel of the mask and one without."""
    padded = np.pad(mask, 1)
    middles = [np.argwhere(np.diff(padded, axis=axis)) - 1 + 0.5 * (np.arange(3) == axis) for axis in range(3)]
    return np.concatenate(middles)[:, ::-1]


@pytest.fixture(scope="module")
def meshes_of_random_labels(device):
    """Random labels in voxels of 1 mm, and their meshes."""
    labels = random_labels((9, 8, 40))
    return labels, extract_label_masks(LabelMap(labels, np.eye(4)), device=device)


@pytest.mark.parametrize("number", [3, 7, 300])
def test_each_edge_that_leaves_a_mask_carries_one_vertex_and_no_other_does(meshes_of_random_labels, number):
    labels, meshes = meshes_of_random_labels
    vertices, middles = meshes[number].vertices, crossed_edges(labels == number)
    distance, nearest = cKDTree(middles).query(vertices)
    assert len(vertices) == len(middles)
    assert distance.max() <= 0.5 - KEEP + 1e-4  # half an edge, less the margin
    off_along_each_axis = np.sort(np.abs(vertices - middles[nearest]), axis=1)
    assert off_along_each_axis[:, 1].max() < 1e-4  # but along the edge; measured 0


@pytest.mark.parametrize("number", [3, 7, 300])
def test_vertices_of_a_rough_mask_come_as_near_to_a_voxel_as_a_sixteenth(meshes_of_random_labels, number):
    _, meshes = meshes_of_random_labels
    to_voxel = np.abs(meshes[number].vertices - np.rint(meshes[number].vertices)).max(axis=1)
    assert to_voxel.min() == pytest.approx(1 / 16, abs=1e-5)  # float32; measured 0


RADII = [3.2, 6.4, 12.1]


def sphere_mesh(radius, device):
    labels = ball_mask((29, 30, 31), radius).astype(np.uint8)
    return extract_label_masks(LabelMap(labels, np.eye(4)), device=device)[1]


def from_centre(mesh) -> np.ndarray:
    """Vertices from the middle of the map, shifted as the ball is."""
    return mesh.vertices - ((np.array((29, 30, 31)) - 1) / 2 + OFF_CENTRE)[::-1]


@pytest.mark.parametrize("radius", RADII)
def test_surface_of_the_mask_of_a_sphere_is_one_sound_body_of_its_volume(device, radius):
    mesh = sphere_mesh(radius, device)
    assert_sound(mesh)
    assert mesh.quality()["components"] == 1
    assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME


@pytest.mark.parametrize("radius", RADII)
def test_surface_of_the_mask_of_a_sphere_has_no_steps(device, radius):
    """With the steps of its voxels normals were 15 degrees off."""
    mesh = sphere_mesh(radius, device)
    outward = from_centre(mesh)
    cosines = np.einsum("ni,ni->n", mesh.normals, outward) / np.linalg.norm(outward, axis=1)
    assert np.sqrt(np.mean(np.degrees(np.arccos(cosines)) ** 2)) <= tolerances.MASK_SPHERE_NORMAL_DEG
    distance = np.linalg.norm(outward, axis=1) - radius
    assert np.sqrt(np.mean(distance**2)) <= tolerances.MASK_SPHERE_VOXEL


def surface_nets(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of label 1 by VTK's surface nets."""
    filters = pytest.importorskip("vtkmodules.vtkFiltersCore")
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData

    image, nets = vtkImageData(), filters.vtkSurfaceNets3D()
    image.SetDimensions(*labels.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(labels.ravel()))
    nets.SetInputData(image)
    nets.SetValue(0, 1)
    nets.SetNumberOfIterations(16)
    nets.SetOutputMeshTypeToTriangles()
    nets.Update()
    points = vtk_to_numpy(nets.GetOutput().GetPoints().GetData())
    return points, vtk_to_numpy(nets.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.uint32)


def test_volume_of_a_mask_is_kept_ten_times_better_than_by_surface_nets_near_the_same_border(device):
    """As a third opinion: surface nets have the same border, but smoothed into a smaller body."""
    labels = ball_mask((29, 30, 31), 11.2).astype(np.uint8)
    points, triangles = surface_nets(labels)
    share_of_nets = 1000.0 * abs(enclosed_ml(points, triangles)) / np.count_nonzero(labels) - 1.0

    (mesh,) = extract_label_masks(LabelMap(labels, np.eye(4)), device=device).values()

    assert abs(volume_share(mesh)) < 0.1 * abs(share_of_nets)  # measured 3e-4 of it
    to_nets, _ = cKDTree(points).query(mesh.vertices)
    assert to_nets.max() < 1.0  # a voxel


def test_surface_of_the_mask_of_a_tilted_plane_has_its_normal_without_steps(device):
    k, j, i = np.indices((24, 40, 40))
    slope_i, slope_j = 0.2, 0.37
    labels = (k - 12 <= slope_i * (i - 20) + slope_j * (j - 20)).astype(np.uint8)
    (mesh,) = extract_label_masks(LabelMap(labels, np.eye(4)), device=device).values()
    far_from_ends = (np.abs(mesh.vertices[:, :2] - 20) < 12).all(axis=1) & (np.abs(mesh.vertices[:, 2] - 12) < 9)
    normal = np.array([-slope_i, -slope_j, 1.0]) / np.linalg.norm([slope_i, slope_j, 1.0])
    angles = np.degrees(np.arccos(np.clip(mesh.normals[far_from_ends] @ normal, -1, 1)))
    assert np.sqrt(np.mean(angles**2)) <= tolerances.MASK_PLANE_NORMAL_DEG


@pytest.mark.parametrize(
    "affine", [np.diag([0.8, 0.8, 3.0, 1.0]), OBLIQUE, MIRRORED], ids=["thick", "sheared", "mirrored"]
)
def test_a_hollow_mask_keeps_its_volume_on_any_grid(device, affine):
    labels = ball_mask((17, 24, 26), 7.3).astype(np.uint8)
    labels[ball_mask((17, 24, 26), 3.0)] = 2
    (mesh,) = extract_label_masks(LabelMap(labels, affine), device=device, label=[1]).values()
    assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME
    assert_sound(mesh)


def thin_labels() -> np.ndarray:
    """A sheet, a line, a single voxel, and a body with a thread: labels 1 to 4."""
    labels = np.zeros((12, 14, 40), np.uint8)
    labels[3, 3:9, 3:20] = 1
    labels[7, 7, 3:20] = 2
    labels[9, 10, 30] = 3
    labels[2:9, 2:9, 25:32] = 4
    labels[5, 5, 32:38] = 4
    return labels


@pytest.mark.parametrize("number", [1, 2, 3, 4], ids=["a sheet", "a line", "a voxel", "a body with a thread"])
def test_thin_parts_and_single_voxels_are_one_sound_body_of_their_volume(device, number):
    mesh = extract_label_masks(LabelMap(thin_labels(), OBLIQUE), device=device)[number]
    assert_sound(mesh)
    assert mesh.quality()["components"] == 1
    assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME_THIN


def test_surface_of_a_label_that_fills_the_map_ends_half_a_voxel_beyond_it(device):
    (mesh,) = extract_label_masks(LabelMap(np.ones((4, 5, 6), np.uint8), np.eye(4)), device=device).values()
    assert_sound(mesh)
    assert mesh.vertices.min(axis=0).tolist() == [-0.5] * 3
    assert mesh.vertices.max(axis=0).tolist() == [5.5, 4.5, 3.5]


def test_sides_of_a_beam_through_all_slices_are_straight_up_to_the_ends(device):
    labels = np.zeros((8, 20, 20), np.uint8)
    labels[:, 5:15, 5:15] = 1
    vertices = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)[1].vertices
    first, middle, last = (
        np.sort(vertices[np.abs(vertices[:, 2] - height) < 1e-4, :2], axis=0) for height in (0, 4, 7)
    )
    np.testing.assert_allclose(middle, first, atol=1e-4)  # voxels in float32; measured 0
    np.testing.assert_allclose(last, first, atol=1e-4)  # measured 0


def find_shared_triangles(meshes) -> tuple[int, dict[tuple[bytes, bytes], int]]:
    """Triangles that two meshes share, opposite ways round; and how often each directed edge of the others is run."""
    faces: dict[frozenset, list] = {}
    for mesh in meshes:
        for triangle in mesh.vertices[mesh.triangles]:
            corners = [row.tobytes() for row in triangle]
            faces.setdefault(frozenset(corners), []).append(corners)
    shared = 0
    edges: dict = {}
    for same in faces.values():
        if len(same) == 2:
            shared += 1
            continue
        for corners in same:
            for n in range(3):
                edge = (corners[n], corners[(n + 1) % 3])
                edges[edge] = edges.get(edge, 0) + 1
    return shared, edges


def assert_union_is_closed(edges: dict[tuple[bytes, bytes], int]) -> None:
    """Each edge is run as often there as back."""
    assert edges
    assert all(edges.get((b, a), 0) == count for (a, b), count in edges.items())


@pytest.fixture(scope="module")
def touching_boxes(device):
    """Meshes of two boxes that touch with a side of 11 x 12 voxels."""
    labels = np.zeros((22, 24, 40), np.uint8)
    labels[5:16, 6:18, 4:20] = 1
    labels[5:16, 6:18, 20:33] = 2
    return extract_label_masks(LabelMap(labels, OBLIQUE), device=device)


def test_touching_labels_share_the_vertices_and_triangles_of_their_border(touching_boxes):
    shared = {row.tobytes() for row in touching_boxes[1].vertices} & {
        row.tobytes() for row in touching_boxes[2].vertices
    }
    assert len(shared) == 11 * 12
    shared_triangles, _ = find_shared_triangles(touching_boxes.values())
    assert shared_triangles == 2 * 10 * 11  # two in each square between four of the vertices


def test_union_of_touching_labels_without_their_border_is_closed(touching_boxes):
    """Nothing lies between the two."""
    _, edges = find_shared_triangles(touching_boxes.values())
    assert_union_is_closed(edges)


def test_touching_labels_keep_their_volumes(touching_boxes):
    assert [volume_share(touching_boxes[number]) for number in (1, 2)] == pytest.approx(
        [0.0, 0.0], abs=tolerances.MASK_VOLUME
    )


def ball_within_a_ball(radius: float) -> np.ndarray:
    """Label 2 within a radius, and 1 from there to 12 voxels."""
    shape = (26, 28, 40)
    return np.where(ball_mask(shape, radius), 2, ball_mask(shape, 12.0)).astype(np.uint8)


def test_a_curved_border_is_shared_to_the_last_triangle(device):
    """Where neither label is apart on a face of a cell, both cut the border into the same triangles."""
    meshes = extract_label_masks(LabelMap(ball_within_a_ball(8.0), OBLIQUE), device=device)
    shared, edges = find_shared_triangles(meshes.values())
    assert shared == len(meshes[2].triangles)  # all of the inner label
    assert_union_is_closed(edges)


@pytest.mark.parametrize("radius", [3.0, 8.0])
@pytest.mark.parametrize("number", [1, 2], ids=["outer", "inner"])
def test_labels_of_which_one_encloses_the_other_keep_their_volumes(device, radius, number):
    """At the level half way between both, the inner one lacked 5 % with a radius of 8 voxels."""
    mesh = extract_label_masks(LabelMap(ball_within_a_ball(radius), OBLIQUE), device=device)[number]
    assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME
    assert_sound(mesh)


@pytest.mark.parametrize("radius", [3.0, 8.0])
def test_a_label_within_another_has_a_lower_level_and_the_same_surface_alone(device, radius):
    labels = LabelMap(ball_within_a_ball(radius), OBLIQUE)
    meshes = extract_label_masks(labels, device=device)
    outer, inner = (meshes[number].report["mask_level"] for number in (1, 2))
    assert inner < outer - 0.05  # measured 0.35 and 0.20, for the smaller ball, below 0.46
    alone = extract_label_masks(labels, device=device, label=[2])[2]
    assert np.array_equal(alone.vertices, meshes[2].vertices)


def map_of_cells(shape, count, kept=1.0) -> np.ndarray:
    """A map full of cells, each nearest to a point; some of them have no label."""
    random = np.random.default_rng(0)
    points = random.random((count, 3)) * shape
    _, nearest = cKDTree(points).query(np.moveaxis(np.indices(shape), 0, -1))
    return np.where((random.random(count) < kept)[nearest], nearest + 1, 0).astype(np.uint8)


def test_cells_among_others_and_gaps_keep_their_volumes(device):
    labels = map_of_cells((24, 30, 36), 30, kept=0.6)
    faces = count_faces(labels)
    assert (faces[:, 1] > faces[:, 0]).sum() >= 5  # so many touch labels with more faces than nothing; measured 8
    meshes = extract_label_masks(LabelMap(labels, MIRRORED), device=device)
    assert len(meshes) == 13  # of 30 cells those to which chance gave a label
    for mesh in meshes.values():
        assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME
        assert_sound(mesh)


def test_cells_that_fill_a_map_all_lack_the_same_share_of_their_volume(device):
    """What notches between three of them take, no level brings back."""
    meshes = extract_label_masks(LabelMap(map_of_cells((20, 24, 28), 8), OBLIQUE), device=device)
    shares = [volume_share(mesh) for mesh in meshes.values()]
    assert -tolerances.MASK_VOLUME_FILLED < min(shares) <= max(shares) < 0
    assert np.ptp(shares) <= tolerances.MASK_VOLUME


def corner_voxel_and_rest() -> LabelMap:
    """Label 2 in a corner of a small map, and 1 in all the rest."""
    voxels = np.ones((4, 5, 6), np.uint8)
    voxels[0, 0, 0] = 2
    return LabelMap(voxels, np.eye(4))


@pytest.mark.parametrize("number", [1, 2], ids=["rest", "corner"])
def test_a_label_that_lacks_more_than_one_percent_of_its_volume_is_warned_of(device, number):
    mesh = extract_label_masks(corner_voxel_and_rest(), device=device)[number]
    percent = 100.0 * volume_share(mesh)
    assert percent < -5.0  # measured -50 and -6
    (warning,) = mesh.report["warnings"]
    assert warning.startswith(f"label {number}: the mesh has ")
    assert f"({percent:+.3g} %, at most 1 %" in warning


@pytest.mark.parametrize("number", [1, 2], ids=["rest", "corner"])
def test_volume_of_the_mesh_of_a_label_is_reported(device, number):
    mesh = extract_label_masks(corner_voxel_and_rest(), device=device)[number]
    assert mesh.report["label_mesh_ml"] == pytest.approx(enclosed_ml(mesh.vertices, mesh.triangles))


@pytest.mark.parametrize("number", [1, 2], ids=["rest", "corner"])
def test_an_open_mesh_of_a_label_has_no_volume_and_no_warning(device, number):
    report = extract_label_masks(corner_voxel_and_rest(), device=device, closed=False)[number].report
    assert report["label_mesh_ml"] is None
    assert report["warnings"] == []


def test_a_body_in_the_middle_of_the_map_keeps_its_volume_without_a_warning(device):
    body = LabelMap(np.pad(np.ones((6, 6, 6), np.uint8), 3), np.eye(4))
    assert extract_label_masks(body, device=device)[1].report["warnings"] == []


def test_no_groove_runs_along_the_border_of_two_labels(device):
    """Slices 0 to 7 are of label 1 on the left and 2 on the right: their tops are flat up to the border."""
    labels = np.zeros((16, 30, 40), np.uint8)
    labels[:8, :, :20], labels[:8, :, 20:] = 1, 2
    meshes = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)
    heights = np.concatenate([meshes[number].vertices[:, 2] for number in (1, 2)])
    tops = heights[heights > 7.001]  # above the last slice
    assert np.ptp(tops) < 0.02  # mm; measured 0


def test_a_gap_of_one_voxel_between_two_labels_stays_open(device):
    labels = np.zeros((16, 30, 40), np.uint8)
    labels[:8, 2:-2, 2:-2], labels[9:, 2:-2, 2:-2] = 1, 2
    meshes = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)
    lower, upper = (
        mesh.vertices[(np.abs(mesh.vertices[:, :2] - (19.5, 14.5)) < 8).all(axis=1), 2] for mesh in meshes.values()
    )
    gap = upper[upper < 10].min() - lower.max()
    assert gap == pytest.approx(1.0, abs=0.3)  # measured 0.83


@pytest.mark.parametrize("number", [7, 9])
def test_surface_of_a_label_alone_is_the_same_as_among_others(device, number):
    labels = LabelMap(random_labels((20, 9, 40), numbers=(0, 0, 3, 7, 9)), OBLIQUE)
    together = extract_label_masks(labels, device=device)[number]
    assert_same(extract_label_masks(labels, device=device, label=[number])[number], together)


def three_layers() -> LabelMap:
    """Labels 3, 7 and 9 at the bottom, in the middle and at the top of 60 slices."""
    labels = np.zeros((60, 40, 40), np.uint16)
    labels[:6], labels[28:31], labels[55:] = 3, 7, 9
    return LabelMap(labels, OBLIQUE)


@pytest.mark.parametrize("number", [3, 7, 9])
def test_labels_that_do_not_fit_together_have_the_same_surfaces_one_by_one(device, number):
    memory = 600_000
    together = extract_label_masks(three_layers(), device=device)[number]
    alone = extract_label_masks(three_layers(), device=device, memory=memory)[number]
    assert (together.report["slabs"], alone.report["slabs"]) == (1, 3)
    assert sum(alone.report["device_bytes"].values()) <= memory
    assert_same(alone, together)


def test_labels_that_do_not_fit_alone_are_refused(device):
    with refused(DeviceError, 50_000):
        extract_label_masks(three_layers(), device=device, memory=50_000)


@pytest.mark.release
@pytest.mark.parametrize(("lanes", "words"), daily_rows(1, [("1", "1"), ("8", "3")]))
def test_kernels_of_gpus_and_those_of_three_words_an_item_give_the_same_meshes(device, lanes, words, monkeypatch):
    labels = random_labels((6, 7, 75), numbers=(0, 0, 3, 7)).astype(np.uint8)
    expected = extract_label_masks(LabelMap(labels, MIRRORED), device=device)
    variants = {**device.kernel_variants, "LANES": lanes, "WORDS_PER_ITEM": words}
    monkeypatch.setattr(device, "kernel_variants", variants)
    meshes = extract_label_masks(LabelMap(labels, MIRRORED), device=device)
    assert sorted(meshes) == sorted(expected) == [3, 7]
    for number, mesh in meshes.items():
        assert np.array_equal(mesh.triangles, expected[number].triangles)
        assert np.abs(mesh.vertices - expected[number].vertices).max() <= tolerances.TWIN_VERTEX_VOXEL


@pytest.fixture(scope="module")
def lung_mesh(device):
    """The mesh of a label named lung, a ball of 3 voxels in voxels of 1 x 1 x 2 mm, of a doubtful map."""
    labels = ball_mask((9, 9, 9), 3.0).astype(np.uint8)
    label_map = LabelMap(labels, np.diag([1.0, 1.0, 2.0, 1.0]), names={1: "lung"}, warnings=["doubtful"])
    return np.count_nonzero(labels), extract_label_masks(label_map, device=device, label=["lung"])[1]


def test_report_of_a_label_names_it_and_has_the_warnings_of_its_map(lung_mesh):
    _, mesh = lung_mesh
    assert (mesh.report["label"], mesh.report["label_name"], mesh.report["surface"]) == (1, "lung", "mask")
    assert "doubtful" in mesh.report["warnings"]


def test_report_of_a_label_has_its_volume_and_a_level_below_a_half(lung_mesh):
    """At a half, chords of a convex body would lie within its mask."""
    voxels, mesh = lung_mesh
    assert mesh.report["label_ml"] == pytest.approx(voxels * 1 * 1 * 2 / 1000)
    assert 0.3 < mesh.report["mask_level"] < 0.5  # measured 0.348


def test_report_of_a_label_has_the_seconds_of_its_steps(lung_mesh):
    _, mesh = lung_mesh
    assert set(mesh.report["seconds"]) == {"upload", "build", "kernels", "download"}


ONES = LabelMap(np.ones((2, 3, 4), np.uint8), np.eye(4))


def test_surfaces_of_an_array_in_place_of_a_label_map_are_refused(device):
    with refused(UsageError, "LabelMap", "labels"):
        extract_label_masks(ONES.voxels, device=device)


def test_surfaces_of_an_empty_label_map_are_refused(device):
    with refused(RefusedInputError, "label", "empty"):
        extract_label_masks(LabelMap(np.zeros((2, 3, 4), np.uint8), np.eye(4)), device=device)


def test_surface_of_an_unknown_label_is_refused(device):
    with refused(UsageError, 9, "label"):
        extract_label_masks(ONES, device=device, label=[9])


@pytest.mark.oclgrind
@pytest.mark.parametrize("number", [3, 300])
def test_triangles_of_a_label_of_a_small_map_equal_the_twin(device, number):
    labels = random_labels((3, 4, 34), numbers=(0, 0, 3, 300))
    mesh = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)[number]
    level = round(mesh.report["mask_level"] * FULL)
    _, _, triangles = twin.extract_label_mask(labels, OBLIQUE, number, level)
    assert np.array_equal(mesh.triangles, triangles)
