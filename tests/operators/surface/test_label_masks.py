"""Labels' own surfaces on every device: equal to the twin, closed, with the volume and the borders of their masks."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from refusals import refused
from scipy.spatial import cKDTree
from variants import daily, daily_rows

from clrecon.errors import DeviceError, RefusedInputError, UsageError
from clrecon.geometry import apply_affine
from clrecon.labels import LabelMap
from clrecon.labels.label_levels import FULL, KEEP, Borders, choose_levels, count_faces, find_boxes, find_enclosed
from clrecon.mesh.triangles import enclosed_ml
from clrecon.opencl import Stopwatch
from clrecon.operators.surface.label_masks import extract_label_masks, survey_labels
from clrecon.proof.surface import labels as twin

OBLIQUE = np.array([[0.7, 0.1, 0.05, -250.0], [-0.1, 0.5, 0.2, -300.0], [0.0, 0.05, 2.5, -846.0], [0, 0, 0, 1.0]])
MIRRORED = OBLIQUE @ np.diag((-1.0, 1.0, 1.0, 1.0))
SHAPES = [(5, 7, 9), (1, 4, 31), (5, 1, 33), (6, 5, 64), (4, 5, 100), (3, 4, 1030)]


def random_labels(shape, seed=1, numbers=(0, 0, 3, 7, 300)) -> np.ndarray:
    """Blocks of labels, and single voxels of others."""
    random = np.random.default_rng(seed)
    coarse = random.choice(np.array(numbers, np.uint16), [-(-n // 3) for n in shape])
    labels = coarse.repeat(3, 0).repeat(3, 1).repeat(3, 2)[: shape[0], : shape[1], : shape[2]]
    odd = random.random(shape) < 0.1
    return np.where(odd, random.choice(np.array(numbers, np.uint16), shape), labels)


def distances_from(shape, centre) -> np.ndarray:
    index = np.indices(shape, dtype=np.float64)
    return np.sqrt(sum((index[axis] - centre[axis]) ** 2 for axis in range(3)))


def mask_of(shape, radius, shift=(0.31, -0.17, 0.08)) -> np.ndarray:
    return distances_from(shape, (np.array(shape) - 1) / 2 + shift) <= radius


def volume_share(mesh) -> float:
    return enclosed_ml(mesh.vertices, mesh.triangles) / mesh.report["label_ml"] - 1.0


def enclosed_levels(labels, meshes) -> dict[int, int]:
    numbers = find_enclosed(labels, count_faces(labels))
    return {number: round(meshes[number].report["mask_level"] * FULL) for number in numbers}


def assert_sound(mesh) -> dict:
    quality = mesh.quality()
    assert quality["closed"] and quality["manifold"] and quality["oriented"] and quality["volume_ml"] > 0
    assert quality["zero_area_faces"] == 0 and quality["duplicate_faces"] == 0 and quality["unused_vertices"] == 0
    return quality


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


def test_the_level_is_that_of_the_twin(device):
    labels = np.zeros((14, 15, 34), np.uint8)
    labels[:, :, 2:16][mask_of((14, 15, 14), 5.2)] = 1
    labels[:, :, 15:29][mask_of((14, 15, 14), 4.4)] = 2
    meshes = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    for number, mesh in meshes.items():  # sums of float32 may end on the other side of a whole number
        assert abs(mesh.report["mask_level"] * FULL - twin.choose_level(labels, OBLIQUE, number)) <= 2


def test_the_levels_of_enclosed_labels_are_those_of_the_twin(device):
    labels = np.where(mask_of((12, 13, 14), 3.0), 2, mask_of((12, 13, 14), 5.2)).astype(np.uint8)
    meshes = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    voxel_ml = abs(np.linalg.det(OBLIQUE[:3, :3])) / 1000.0

    def measure(levels: dict[int, int]) -> dict[int, float]:
        made = {
            number: twin.extract_label_mask(labels, OBLIQUE, number, levels[number], enclosed=levels)
            for number in levels
        }
        return {
            number: enclosed_ml(vertices, triangles) / voxel_ml for number, (vertices, _, triangles) in made.items()
        }

    levels = choose_levels(Borders.of(labels, find_enclosed(labels, count_faces(labels))), measure)
    assert set(levels) == {1, 2}
    for number, mesh in meshes.items():
        assert abs(mesh.report["mask_level"] * FULL - levels[number]) <= 2


def test_boxes_are_those_of_the_voxels(device):
    labels = random_labels((7, 9, 70), seed=3, numbers=(0, 0, 0, 0, 0, 2, 5, 6))
    expected = find_boxes(labels, (2, 5, 6), (0, 0, 0)), count_faces(labels).tolist()
    for memory in (None, 100):  # does not fit: without the device
        boxes, faces = survey_labels(LabelMap(labels, np.eye(4)), device, memory, Stopwatch())
        assert (boxes, faces.tolist()) == expected


@pytest.mark.parametrize("memory", [None, 100])
def test_of_a_single_label_no_faces_are_counted(device, memory):
    """They say which labels touch: there is no other."""
    labels = random_labels((5, 6, 40), numbers=(0, 0, 4))
    boxes, faces = survey_labels(LabelMap(labels, np.eye(4)), device, memory, Stopwatch())
    assert boxes == find_boxes(labels, (4,), (0, 0, 0)) and faces.tolist() == [[0, 0]] * 5


def test_every_voxel_of_the_mask_is_inside_and_no_other(device):
    """Each edge between a voxel of the label and one without carries one vertex, within half a voxel of their face."""
    labels = random_labels((9, 8, 40))
    for number, mesh in extract_label_masks(LabelMap(labels, np.eye(4)), device=device).items():
        mask = np.pad(labels == number, 1)
        faces = []
        for axis in range(3):
            crossed = np.argwhere(np.diff(mask, axis=axis))
            faces.append(crossed - 1 + 0.5 * (np.arange(3) == axis))
        centres = np.concatenate(faces)[:, ::-1]
        distance, nearest = cKDTree(centres).query(mesh.vertices)
        assert len(mesh.vertices) == len(centres)
        away = np.abs(mesh.vertices - centres[nearest])
        assert distance.max() <= 0.5 - KEEP + 1e-4 and np.sort(away, axis=1)[:, 1].max() < 1e-4  # along the edge alone
        # Voxels of 1 mm: of so rough a mask many vertices come as near to a sample as they may, a sixteenth of a mm.
        to_sample = np.abs(mesh.vertices - np.rint(mesh.vertices)).max(axis=1)
        assert to_sample.min() == pytest.approx(1 / 16, abs=1e-5)


@pytest.mark.parametrize("radius", [3.2, 6.4, 12.1])
def test_a_sphere_has_its_volume_and_no_steps(device, radius):
    labels = mask_of((29, 30, 31), radius).astype(np.uint8)
    mesh = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)[1]
    assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME
    assert assert_sound(mesh)["components"] == 1
    centre = ((np.array(labels.shape) - 1) / 2 + (0.31, -0.17, 0.08))[::-1]
    outward = mesh.vertices - centre
    angles = np.degrees(np.arccos(np.einsum("ni,ni->n", mesh.normals, outward) / np.linalg.norm(outward, axis=1)))
    assert np.sqrt(np.mean(angles**2)) <= tolerances.MASK_SPHERE_NORMAL_DEG  # 15 degrees with the steps of its voxels
    assert np.sqrt(np.mean((np.linalg.norm(outward, axis=1) - radius) ** 2)) <= tolerances.MASK_SPHERE_VOXEL


def test_surface_nets_are_smaller_bodies(device):
    """VTK's surface nets as a third opinion: the same border, but smoothed into a smaller body."""
    filters = pytest.importorskip("vtkmodules.vtkFiltersCore")
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData

    labels = mask_of((29, 30, 31), 11.2).astype(np.uint8)
    image, nets = vtkImageData(), filters.vtkSurfaceNets3D()
    image.SetDimensions(*labels.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(labels.ravel()))
    nets.SetInputData(image)
    nets.SetValue(0, 1)
    nets.SetNumberOfIterations(16)
    nets.SetOutputMeshTypeToTriangles()
    nets.Update()
    points = vtk_to_numpy(nets.GetOutput().GetPoints().GetData())
    triangles = vtk_to_numpy(nets.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.uint32)
    mesh = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)[1]
    theirs = 1000.0 * abs(enclosed_ml(points, triangles)) / np.count_nonzero(labels) - 1.0
    assert abs(volume_share(mesh)) < 0.1 * abs(theirs)
    distance, _ = cKDTree(points).query(mesh.vertices)
    assert distance.max() < 1.0


def test_a_tilted_plane_has_no_steps(device):
    k, j, i = np.indices((24, 40, 40))
    labels = (k - 12 <= 0.2 * (i - 20) + 0.37 * (j - 20)).astype(np.uint8)
    mesh = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)[1]
    inner = (np.abs(mesh.vertices[:, :2] - 20) < 12).all(axis=1) & (np.abs(mesh.vertices[:, 2] - 12) < 9)
    normal = np.array([-0.2, -0.37, 1.0]) / np.linalg.norm([0.2, 0.37, 1.0])
    angles = np.degrees(np.arccos(np.clip(mesh.normals[inner] @ normal, -1, 1)))
    assert np.sqrt(np.mean(angles**2)) <= tolerances.MASK_PLANE_NORMAL_DEG


@pytest.mark.parametrize(
    "affine", [np.diag([0.8, 0.8, 3.0, 1.0]), OBLIQUE, MIRRORED], ids=["thick", "sheared", "mirrored"]
)
def test_volumes_are_kept_on_any_grid(device, affine):
    labels = mask_of((17, 24, 26), 7.3).astype(np.uint8)
    labels[mask_of((17, 24, 26), 3.0)] = 2
    for mesh in extract_label_masks(LabelMap(labels, affine), device=device, label=[1]).values():
        assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME
        assert_sound(mesh)


def test_thin_parts_and_single_voxels_are_not_lost(device):
    labels = np.zeros((12, 14, 40), np.uint8)
    labels[3, 3:9, 3:20] = 1  # a sheet
    labels[7, 7, 3:20] = 2  # a line
    labels[9, 10, 30] = 3  # a voxel
    labels[2:9, 2:9, 25:32] = 4
    labels[5, 5, 32:38] = 4  # a body with a thread
    for number, mesh in extract_label_masks(LabelMap(labels, OBLIQUE), device=device).items():
        assert assert_sound(mesh)["components"] == 1, number
        assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME_THIN, number


def test_the_end_of_the_map_is_flat(device):
    labels = np.ones((4, 5, 6), np.uint8)
    mesh = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)[1]
    assert_sound(mesh)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert np.array_equal(low, [-0.5] * 3) and np.array_equal(high, [5.5, 4.5, 3.5])
    half = np.zeros((8, 20, 20), np.uint8)
    half[:, 5:15, 5:15] = 1  # a beam through all slices: its sides stay straight up to the ends
    mesh = extract_label_masks(LabelMap(half, np.eye(4)), device=device)[1]
    sides = [mesh.vertices[np.abs(mesh.vertices[:, 2] - k) < 1e-4] for k in (0, 4, 7)]
    for side in sides[1:]:
        assert np.abs(np.sort(side[:, :2], axis=0) - np.sort(sides[0][:, :2], axis=0)).max() < 1e-4


def cancelled_pairs(meshes) -> tuple[int, dict[tuple[bytes, bytes], int]]:
    """Triangles that two meshes share, opposite ways round; and how often each directed edge of the others is run."""
    faces: dict[frozenset, list] = {}
    for mesh in meshes:
        for triangle in mesh.vertices[mesh.triangles]:
            corners = [row.tobytes() for row in triangle]
            faces.setdefault(frozenset(corners), []).append(corners)
    pairs = 0
    edges: dict = {}
    for same in faces.values():
        if len(same) == 2:
            pairs += 1
            continue
        for corners in same:
            for n in range(3):
                edge = (corners[n], corners[(n + 1) % 3])
                edges[edge] = edges.get(edge, 0) + 1
    return pairs, edges


def test_touching_labels_share_their_border(device):
    """The union without the common border is closed: nothing lies between the two."""
    shape = (22, 24, 40)
    labels = np.zeros(shape, np.uint8)
    labels[5:16, 6:18, 4:20] = 1
    labels[5:16, 6:18, 20:33] = 2
    meshes = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    shared = {row.tobytes() for row in meshes[1].vertices} & {row.tobytes() for row in meshes[2].vertices}
    assert len(shared) == 11 * 12
    pairs, edges = cancelled_pairs(meshes.values())
    assert pairs >= 2 * 10 * 11
    assert all(edges.get((b, a), 0) == count for (a, b), count in edges.items())
    for mesh in meshes.values():
        assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME


def test_a_curved_border_is_shared_to_the_last_triangle(device):
    """Where neither label is apart on a face of a cell, both cut the border into the same triangles."""
    shape = (26, 28, 40)
    inner = mask_of(shape, 8.0)
    labels = np.where(inner, 2, mask_of(shape, 12.0)).astype(np.uint8)
    meshes = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    pairs, edges = cancelled_pairs(meshes.values())
    assert pairs == len(meshes[2].triangles)  # all of the inner label
    assert all(edges.get((b, a), 0) == count for (a, b), count in edges.items())


@pytest.mark.parametrize("radius", [3.0, 8.0])
def test_a_label_that_another_encloses_keeps_its_volume(device, radius):
    """5 % short of it at the middle between both, with a radius of 8 voxels."""
    shape = (26, 28, 40)
    labels = np.where(mask_of(shape, radius), 2, mask_of(shape, 12.0)).astype(np.uint8)
    meshes = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    for mesh in meshes.values():
        assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME
        assert_sound(mesh)
    assert meshes[2].report["mask_level"] < meshes[1].report["mask_level"] - 0.05
    alone = extract_label_masks(LabelMap(labels, OBLIQUE), device=device, label=[2])[2]
    assert np.array_equal(alone.vertices, meshes[2].vertices)


def cells_of(shape, count, kept=1.0) -> np.ndarray:
    """A map full of cells, each nearest to a point; some of them have no label."""
    random = np.random.default_rng(0)
    points = random.random((count, 3)) * shape
    _, nearest = cKDTree(points).query(np.moveaxis(np.indices(shape), 0, -1))
    return np.where((random.random(count) < kept)[nearest], nearest + 1, 0).astype(np.uint8)


def test_cells_that_enclose_each_other_keep_their_volumes(device):
    labels = cells_of((24, 30, 36), 30, kept=0.6)
    assert (count_faces(labels)[:, 1] > count_faces(labels)[:, 0]).sum() >= 5
    for mesh in extract_label_masks(LabelMap(labels, MIRRORED), device=device).values():
        assert abs(volume_share(mesh)) <= tolerances.MASK_VOLUME
        assert_sound(mesh)


def test_cells_that_fill_a_map_lack_the_same_share(device):
    """What notches between three of them take, no level brings back."""
    shares = [
        volume_share(mesh)
        for mesh in extract_label_masks(LabelMap(cells_of((20, 24, 28), 8), OBLIQUE), device=device).values()
    ]
    assert -tolerances.MASK_VOLUME_FILLED < min(shares) and max(shares) < 0
    assert np.ptp(shares) <= tolerances.MASK_VOLUME


def test_labels_that_lack_volume_are_warned_of(device):
    """A voxel and what fills the rest of the map; a body amid the map keeps its volume."""
    voxels = np.ones((4, 5, 6), np.uint8)
    voxels[0, 0, 0] = 2
    labels = LabelMap(voxels, np.eye(4))
    for number, mesh in extract_label_masks(labels, device=device).items():
        (warning,) = mesh.report["warnings"]
        assert mesh.report["label_mesh_ml"] == pytest.approx(enclosed_ml(mesh.vertices, mesh.triangles))
        change = 100.0 * (mesh.report["label_mesh_ml"] / mesh.report["label_ml"] - 1.0)
        assert change < -5.0
        assert warning.startswith(f"label {number}: the mesh has ") and f"({change:+.3g} %, at most 1 %" in warning
    for mesh in extract_label_masks(labels, device=device, closed=False).values():
        assert mesh.report["label_mesh_ml"] is None and mesh.report["warnings"] == []
    alone = LabelMap(np.pad(np.ones((6, 6, 6), np.uint8), 3), np.eye(4))
    assert extract_label_masks(alone, device=device)[1].report["warnings"] == []


def test_no_groove_runs_along_the_border_and_gaps_stay_open(device):
    shape = (16, 30, 40)
    labels = np.zeros(shape, np.uint8)
    labels[:8, :, :20], labels[:8, :, 20:] = 1, 2
    meshes = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)
    for mesh in meshes.values():
        top = mesh.vertices[mesh.vertices[:, 2] > 7.001]
        assert np.ptp(top[:, 2]) < 0.02
    labels[:] = 0
    labels[:8, 2:-2, 2:-2], labels[9:, 2:-2, 2:-2] = 1, 2  # one voxel of nothing between them
    meshes = extract_label_masks(LabelMap(labels, np.eye(4)), device=device)
    inner = [mesh.vertices[(np.abs(mesh.vertices[:, :2] - (19.5, 14.5)) < 8).all(axis=1)] for mesh in meshes.values()]
    gap = inner[1][:, 2][inner[1][:, 2] < 10].min() - inner[0][:, 2].max()
    assert 0.7 < gap < 1.3


def test_one_label_alone_is_the_same_as_among_others(device):
    labels = random_labels((20, 9, 40), numbers=(0, 0, 3, 7, 9))
    together = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    for number in (7, 9):
        alone = extract_label_masks(LabelMap(labels, OBLIQUE), device=device, label=[number])[number]
        assert np.array_equal(alone.vertices, together[number].vertices)
        assert np.array_equal(alone.normals, together[number].normals)
        assert np.array_equal(alone.triangles, together[number].triangles)


def test_labels_that_do_not_fit_together_go_through_one_by_one(device):
    labels = np.zeros((60, 40, 40), np.uint16)
    labels[:6], labels[28:31], labels[55:] = 3, 7, 9
    expected = extract_label_masks(LabelMap(labels, OBLIQUE), device=device)
    meshes = extract_label_masks(LabelMap(labels, OBLIQUE), device=device, memory=600_000)
    for number, mesh in meshes.items():
        assert mesh.report["slabs"] == 3 and sum(mesh.report["device_bytes"].values()) <= 600_000
        assert expected[number].report["slabs"] == 1
        assert np.array_equal(mesh.vertices, expected[number].vertices)
        assert np.array_equal(mesh.triangles, expected[number].triangles)
    with refused(DeviceError, 50000):
        extract_label_masks(LabelMap(labels, OBLIQUE), device=device, memory=50_000)


@pytest.mark.release
@pytest.mark.parametrize(("lanes", "words"), daily_rows(1, [("1", "1"), ("8", "3")]))
def test_every_variant_of_the_kernels_gives_the_same_meshes(device, lanes, words, monkeypatch):
    labels = random_labels((6, 7, 75), numbers=(0, 0, 3, 7)).astype(np.uint8)
    expected = extract_label_masks(LabelMap(labels, MIRRORED), device=device)
    variants = {**device.kernel_variants, "LANES": lanes, "WORDS_PER_ITEM": words}
    monkeypatch.setattr(device, "kernel_variants", variants)
    for number, mesh in extract_label_masks(LabelMap(labels, MIRRORED), device=device).items():
        assert np.array_equal(mesh.triangles, expected[number].triangles)
        assert np.abs(mesh.vertices - expected[number].vertices).max() <= tolerances.TWIN_VERTEX_VOXEL


def test_the_report_says_what_was_done(device):
    labels = mask_of((9, 9, 9), 3.0).astype(np.uint8)
    label_map = LabelMap(labels, np.diag([1.0, 1.0, 2.0, 1.0]), {1: "lung"}, warnings=["doubtful"])
    mesh = extract_label_masks(label_map, device=device, label=["lung"])[1]
    assert mesh.report["label"] == 1 and mesh.report["label_name"] == "lung" and mesh.report["surface"] == "mask"
    assert mesh.report["label_ml"] == pytest.approx(np.count_nonzero(labels) * 0.002)
    assert 0.3 < mesh.report["mask_level"] < 0.5
    assert "doubtful" in mesh.report["warnings"]
    assert set(mesh.report["seconds"]) == {"upload", "build", "kernels", "download"}


def test_arrays_empty_maps_and_unknown_labels_are_refused(device):
    labels = LabelMap(np.ones((2, 3, 4), np.uint8), np.eye(4))
    with refused(UsageError, "LabelMap", "labels"):
        extract_label_masks(labels.voxels, device=device)
    with refused(RefusedInputError, "label", "empty"):
        extract_label_masks(LabelMap(np.zeros((2, 3, 4), np.uint8), np.eye(4)), device=device)
    with refused(UsageError, 9, "label"):
        extract_label_masks(labels, device=device, label=[9])


@pytest.mark.oclgrind
def test_every_pass_over_a_small_map_equals_the_twin(device):
    labels = random_labels((3, 4, 34), numbers=(0, 0, 3, 300))
    for number, mesh in extract_label_masks(LabelMap(labels, OBLIQUE), device=device).items():
        level = round(mesh.report["mask_level"] * FULL)
        assert np.array_equal(mesh.triangles, twin.extract_label_mask(labels, OBLIQUE, number, level)[2])
