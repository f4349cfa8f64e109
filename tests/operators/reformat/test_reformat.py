"""Slices: voxels unchanged, analytic fields, numpy's slabs, the twin, slabs of large volumes."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from dicom_series import rotation
from refusals import refused
from uneven_volume import uneven
from variants import VOXEL_TYPES, daily

from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.opencl import Stopwatch, kernel_files
from clrecon.operators.rays.render import render
from clrecon.operators.reformat.cut import cut_slice, reformat_curve
from clrecon.operators.reformat.sheets import prepare_reformat, sample_sheet
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.volumes.volume_twins import reformat_sheet
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.reformation import find_plane, plane_sheet, slab_samples

SHEARED = np.eye(4)
SHEARED[:3, :3] = rotation((15.0, -25.0, 40.0)) @ [[0.7, 0.0, 0.1], [0.0, 0.5, -0.9], [0.0, 0.0, 2.5]]
SHEARED[:3, 3] = (-120.0, 80.0, -700.0)


def random_voxels(shape, dtype="int16"):
    """Values of 0 to 99 HU."""
    return np.random.default_rng(1).integers(0, 100, shape).astype(dtype)


def camera_of_slice(volume, k) -> Camera:
    """Pixel = voxel: looking along the slices' normal at slice k, rows to the right and columns downwards."""
    ni, nj, _ = volume.shape_ijk
    i_step, j_step = volume.affine[:3, 0], volume.affine[:3, 1]
    (middle,) = volume.ijk_to_lps([((ni - 1) / 2, (nj - 1) / 2, k)])
    normal = np.cross(i_step, j_step)
    assert abs(i_step @ j_step) < 1e-9 and np.isclose(np.linalg.norm(i_step), np.linalg.norm(j_step))
    scale = 0.5 * nj * float(np.linalg.norm(j_step))
    return Camera(tuple(middle - normal), tuple(middle), tuple(-j_step), parallel_scale=scale)


def even_volume(*, dtype="int16", angles=(0.0, 0.0, 0.0), spacing=(0.7, 0.7, 2.5), shape=(6, 8, 11), shear=0.0):
    """Random HU in slices, rows and columns of a turned grid; slices lie aside along columns by `shear` of a step."""
    affine = np.eye(4)
    affine[:3, :3] = rotation(angles) * spacing
    affine[:3, 2] += shear * affine[:3, 1]
    affine[:3, 3] = (-31.0, 17.5, 102.0)
    return Volume(random_voxels(shape, dtype), affine)


@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (20.0, -35.0, 10.0)])
@pytest.mark.parametrize("shear", [0.0, 0.8])
def test_pixel_on_a_voxel_has_its_value(device, dtype, angles, shear):
    volume = even_volume(dtype=dtype, angles=angles, shape=(6, 8, 11), shear=shear)
    cuts = [cut_slice(volume, camera_of_slice(volume, k), size=(11, 8), device=device) for k in range(6)]
    assert np.array_equal([cut.values for cut in cuts], volume.voxels.astype(np.float32))


@pytest.mark.parametrize(
    "draw", [cut_slice, lambda volume, view, device: render(volume, "slice", view=view, device=device)]
)
def test_a_slice_has_1024_x_1024_pixels_unless_asked_otherwise(device, draw):
    assert draw(even_volume(shape=(2, 2, 2)), "axial", device=device).image.shape[:2] == (1024, 1024)


@pytest.mark.parametrize(
    ("plane", "size", "seen"),
    [
        ("axial", (12, 8), lambda voxels: voxels[3]),
        ("coronal", (12, 6), lambda voxels: voxels[::-1, 4]),
        ("sagittal", (8, 6), lambda voxels: voxels[::-1, :, 6]),
    ],
)
def test_planes_of_anatomy_show_left_at_the_right_front_at_the_top_or_left_and_head_at_the_top(
    device, plane, size, seen
):
    """The axes of the volume are those of the patient: i to the left, j to the back, k to the head."""
    volume = Volume(random_voxels((6, 8, 12)), np.eye(4))
    (voxel,) = volume.ijk_to_lps([(6.0, 4.0, 3.0)])  # beside the middle: pixels lie on voxels
    camera = find_plane(volume, plane, size, pixel_mm=1.0)
    shift = float((voxel - camera.focal_point) @ camera.basis().forward)
    cut = cut_slice(volume, plane, size, device=device, pixel_mm=1.0, offset_mm=shift)
    assert np.array_equal(cut.values, seen(volume.voxels))


def test_report_of_a_slice_has_the_size_of_its_pixels(device):
    cut = cut_slice(even_volume(), "axial", (12, 8), device=device, pixel_mm=0.8)
    assert (cut.mode, cut.report["pixel_mm"]) == ("slice", 0.8)


@pytest.mark.parametrize("make", [lambda v: Volume(v, SHEARED), uneven], ids=["sheared", "uneven"])
@pytest.mark.parametrize("view", [(30.0, 20.0), "left", (-110.0, -45.0)])
def test_oblique_planes_through_a_linear_field_are_exact(device, make, view):
    empty = make(np.zeros((6, 5, 4), np.float32))
    slope = np.array([3.0, -2.0, 5.0])  # HU a mm
    k, j, i = np.indices((6, 5, 4)).reshape(3, -1)
    field = (empty.ijk_to_lps(np.stack([i, j, k], axis=1)) - empty.affine[:3, 3]) @ slope
    volume = empty.with_voxels(field.reshape(6, 5, 4).astype(np.float32))
    cut = cut_slice(volume, view, (80, 60), device=device, offset_mm=0.2)
    origins, directions = cut.camera.rays((80, 60))
    inner = np.isfinite(cut.depth)
    points = (origins + cut.depth[..., None] * directions)[inner]
    ijk = volume.lps_to_ijk(points)
    within = ((ijk >= 0.0) & (ijk <= (3, 4, 5))).all(axis=1)
    assert within.sum() > 50  # of 4800 pixels: enough to judge
    truth = (points - empty.affine[:3, 3]) @ slope
    assert np.abs(cut.values[inner] - truth)[within].max() <= tolerances.SLICE_LINEAR_FIELD_HU


@pytest.mark.parametrize(
    ("combine", "truth", "limit"),
    [
        # the mean is the integral of what is linear between slices, over the four layers of five slices
        ("mean", lambda slices: (slices[1:] + slices[:-1]).sum(axis=0) / (2 * 4), tolerances.SLAB_MEAN_HU),
        ("max", lambda slices: slices.max(axis=0), 0.0),
        ("min", lambda slices: slices.min(axis=0), 0.0),
    ],
)
def test_slabs_along_an_axis_are_those_of_numpy(device, combine, truth, limit):
    volume = even_volume(spacing=(0.7, 0.7, 0.7), shape=(9, 8, 11))
    camera = camera_of_slice(volume, 4)
    cut = cut_slice(volume, camera, (11, 8), device=device, thickness=4 * 0.7, combine=combine)
    five_slices = volume.voxels[4 - 2 : 4 + 3]  # two on each side of slice 4
    assert np.abs(cut.values - truth(five_slices.astype(np.float64))).max() <= limit


def test_samples_through_a_slab_are_at_most_half_a_voxel_apart(device):
    volume = even_volume(spacing=(0.7, 0.7, 0.7), shape=(9, 8, 11))
    report = cut_slice(volume, "axial", (11, 8), device=device, thickness=4 * 0.7).report
    assert report["sample_step_mm"] <= 0.7 / 2 + 1e-12  # the rounding of a division in float64
    assert report["samples_a_pixel"] >= 9  # eight steps of 0.35 mm through 2.8 mm, with both ends


SLAB_HU = 70


@pytest.fixture
def cut_thick(device):
    """Draw a slab of 20 mm through three slices of `SLAB_HU`; the volume spans columns 2 to 9 of 12."""
    volume = Volume(np.full((3, 8, 8), SLAB_HU, np.int16), np.eye(4))

    def cut(background):
        return cut_slice(volume, "axial", (12, 8), device=device, pixel_mm=1.0, thickness=20.0, background=background)

    return cut


def test_samples_beyond_the_volume_do_not_count(cut_thick):
    values = cut_thick("transparent").values
    assert np.abs(values[:, 2:10] - SLAB_HU).max() <= tolerances.SLAB_MEAN_HU
    assert np.isnan(values[:, :2]).all() and np.isnan(values[:, 10:]).all()


def test_pixels_beside_the_volume_have_the_background(cut_thick):
    clear, white = cut_thick("transparent").image, cut_thick("white").image
    assert (clear[:, 2:10, 3] == 255).all() and (clear[:, :2, 3] == 0).all()
    assert (white[:, :2] == 255).all()


def test_voxels_without_weight_are_not_looked_at(device):
    voxels = random_voxels((5, 4, 4), "float32")
    voxels[3], voxels[2, 1], voxels[2, :, 2] = np.nan, np.nan, np.nan
    volume = Volume(voxels, np.eye(4))
    cut = cut_slice(volume, camera_of_slice(volume, 2), (4, 4), device=device)
    assert np.array_equal(cut.values, voxels[2], equal_nan=True) and np.isfinite(cut.values).sum() == 9


def uneven_aside(voxels) -> Volume:
    """Slices that lie aside along rows and columns, no two layers alike."""
    even = uneven(voxels)
    aside = np.array([0.0, 0.9, -0.4, 1.7, 1.5, -1.1])[:, None] * even.affine[:3, 0]
    return Volume(voxels, even.affine, slice_positions=even.slice_origins() + aside)


def test_an_oblique_slice_equals_that_of_simpleitk(device):
    """A third opinion: the same plane through the same grid, between the outer voxel centres."""
    sitk = pytest.importorskip("SimpleITK")
    volume = even_volume(dtype="float32", angles=(20.0, -35.0, 10.0), spacing=(0.7, 0.5, 2.5), shape=(12, 14, 16))
    grid = sitk.GetImageFromArray(volume.voxels)
    grid.SetSpacing(volume.spacing)
    grid.SetOrigin(volume.affine[:3, 3].tolist())
    grid.SetDirection((volume.affine[:3, :3] / volume.spacing).ravel().tolist())
    size = columns, rows = 60, 50
    cut = cut_slice(volume, (25.0, 40.0), size, device=device, zoom=1.5, offset_mm=0.7)
    right, up, forward = cut.camera.basis()
    pixel = cut.report["pixel_mm"]
    first = cut.camera.focal_point + pixel * (-(columns - 1) / 2 * right + (rows - 1) / 2 * up)
    resampler = sitk.ResampleImageFilter()
    resampler.SetSize((columns, rows, 1))
    resampler.SetOutputSpacing((pixel, pixel, 1.0))
    resampler.SetOutputOrigin(first.tolist())
    resampler.SetOutputDirection(np.stack([right, -up, forward], axis=1).ravel().tolist())
    resampler.SetInterpolator(sitk.sitkLinear)
    resampler.SetDefaultPixelValue(np.nan)
    (other,) = sitk.GetArrayFromImage(resampler.Execute(grid))
    origins, directions = cut.camera.rays(size)
    ijk = volume.lps_to_ijk((origins + cut.camera.distance * directions).reshape(-1, 3)).reshape(rows, columns, 3)
    within = ((ijk >= 0.0) & (ijk <= (15, 13, 11))).all(axis=2)
    assert within.sum() > 300  # pixels; measured 1112
    assert np.abs(cut.values - other)[within].max() <= tolerances.TWIN_SLICE_HU


VOLUMES = {
    "sheared": lambda dtype: Volume(random_voxels((9, 7, 11), dtype), SHEARED),
    "uneven": lambda dtype: uneven(random_voxels((6, 5, 4), dtype)),
    "uneven aside": lambda dtype: uneven_aside(random_voxels((6, 5, 4), dtype)),
    "uneven downwards": lambda dtype: uneven(random_voxels((6, 5, 4), dtype), sign=-1.0),
    "one slice": lambda dtype: Volume(random_voxels((1, 5, 4), dtype), SHEARED),
    "one voxel": lambda dtype: Volume(random_voxels((1, 1, 1), dtype), SHEARED),
}


def assert_values_are_near(values, truth):
    """Both have values at the same pixels, at one or more, and they agree."""
    assert np.array_equal(np.isnan(values), np.isnan(truth))
    assert np.nanmax(np.abs(values - truth)) <= tolerances.TWIN_SLICE_HU


@pytest.mark.every_device
@pytest.mark.parametrize("name", VOLUMES)
@pytest.mark.parametrize("dtype", daily(1, ["int16", "uint8", "float32"]))
def test_reformation_equals_its_twin(device, name, dtype):
    volume = VOLUMES[name](dtype)
    for view, thickness, combine in [("axial", 0.0, "mean"), ((20.0, 30.0), 2.3, "max"), ("sagittal", 7.0, "mean"),
                                     ((-75.0, 10.0), 3.0, "min")]:  # fmt: skip
        size = (31, 33)
        sheet, _ = plane_sheet(find_plane(volume, view, size), size, offset_mm=0.1)
        samples = slab_samples(volume, thickness)
        sampled = sample_sheet(DeviceVolume(volume, device=device), sheet, samples, combine)
        assert_values_are_near(sampled.values, reformat_sheet(volume, sheet, samples, combine))


class SlabCase:
    """An oblique sheet through one of `VOLUMES`, sampled whole and with memory for a few slices only."""

    def __init__(self, device, name, *, combine, thickness):
        self.device, self.combine, self.thickness = device, combine, thickness
        self.volume = VOLUMES[name]("float32")
        self.sheet, _ = plane_sheet(find_plane(self.volume, (20.0, 30.0), (23, 17)), (23, 17))
        self.whole = sample_sheet(DeviceVolume(self.volume, device=device), self.sheet, *self._combined())
        self.slice_bytes = 4 * self.volume.voxels[0].size
        assert self.whole.slices >= 4  # or there is nothing to split

    def _combined(self):
        return slab_samples(self.volume, self.thickness), self.combine

    def sample_with(self, slices, less=0):
        """Sample with memory for these slices and what the whole needed beside its slices, less some bytes."""
        others = self.whole.device_bytes - self.whole.slices * self.slice_bytes
        resident = DeviceVolume(self.volume, device=self.device, memory=others + slices * self.slice_bytes - less)
        return sample_sheet(resident, self.sheet, *self._combined())

    def twin(self):
        return reformat_sheet(self.volume, self.sheet, *self._combined())


odd_volumes = pytest.mark.parametrize("name", ["sheared", "uneven aside", "uneven downwards"])


@odd_volumes
@pytest.mark.parametrize(("combine", "thickness"), [("mean", 0.0), ("max", 3.0), ("min", 3.0)])
@pytest.mark.parametrize("slices", [2, 3, 4])
def test_volumes_that_do_not_fit_give_the_same_values_in_slabs(device, name, combine, thickness, slices):
    case = SlabCase(device, name, combine=combine, thickness=thickness)
    parts = case.sample_with(slices)
    assert parts.slabs == 1 + -(-(case.whole.slices - slices) // (slices - 1))  # neighbours share a slice
    assert np.array_equal(parts.values, case.whole.values, equal_nan=True)


@odd_volumes
def test_means_of_thick_slabs_in_parts_are_those_of_the_twin(device, name):
    case = SlabCase(device, name, combine="mean", thickness=5.0)
    assert_values_are_near(case.sample_with(slices=2).values, case.twin())


@odd_volumes
def test_memory_for_less_than_two_slices_is_refused(device, name):
    case = SlabCase(device, name, combine="mean", thickness=0.0)
    with refused(DeviceError, "slices"):
        case.sample_with(slices=2, less=1)


def test_only_slices_that_are_met_are_taken(device):
    volume = Volume(random_voxels((50, 8, 8)), np.eye(4))
    cut = cut_slice(volume, "axial", (8, 8), device=device, pixel_mm=1.0)
    two_slices, picture_bytes = 2 * volume.voxels[0].nbytes, 2000  # measured 1,136
    assert cut.report["device_bytes"] <= two_slices + picture_bytes < volume.voxels.nbytes
    assert cut.report["slabs"] == 1


def test_a_volume_on_the_device_is_not_copied_again_and_gives_the_same_values(device):
    volume = VOLUMES["sheared"]("int16")
    expected = cut_slice(volume, (20.0, 30.0), (31, 20), device=device, thickness=2.0)
    with DeviceVolume(volume, device=device) as resident:
        resident.whole(Stopwatch())
        cut = cut_slice(resident, (20.0, 30.0), (31, 20), thickness=2.0)
        assert resident.uploaded_bytes == volume.voxels.nbytes
    assert np.array_equal(cut.values, expected.values, equal_nan=True)


def test_grey_runs_from_black_to_white_over_the_window(device):
    volume = Volume(np.array([[[0, 100, 200, 300]]], np.int16), np.eye(4))
    cut = cut_slice(volume, "axial", (4, 1), device=device, pixel_mm=1.0, window=(100, 300))
    assert cut.image[0, :, 0].tolist() == [0, 0, 128, 255]
    assert cut.report["window_hu"] == [100.0, 300.0]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"plane": "diagonal"}, "axial, coronal, sagittal"),
        ({"size": (0, 5)}, "size"),
        ({"size": (5, 10**6)}, "size"),
        ({"thickness": -1.0}, "thickness"),
        ({"thickness": np.nan}, "thickness"),
        ({"thickness": 1e9}, "beyond every scan"),
        ({"combine": "median"}, "mean, max, min"),
        ({"window": (300, 200)}, "window"),
        ({"offset_mm": 400.0}, "misses the volume, which lies -40[0-9.]+ to -39[0-9.]+ mm"),
        ({"offset_mm": np.inf}, "offset"),
        ({"pixel_mm": 0.0}, "size of a pixel"),
        ({"memory": 0}, "memory"),
    ],
)
def test_a_slice_that_cannot_be_cut_is_refused_and_says_why(device, arguments, says):
    volume = even_volume()
    with pytest.raises(UsageError, match=says):
        cut_slice(volume, **{"plane": "axial", "size": (8, 8), "device": device, **arguments})


@pytest.mark.parametrize("unevenly", [False, True])
def test_the_kernel_file_builds_alone(device, unevenly):
    assert "reformat/sample.cl" in kernel_files()
    assert prepare_reformat(device, np.int16, uneven=unevenly).kernel_names == ["reformat_rows"]


@pytest.mark.oclgrind
@pytest.mark.parametrize("name", ["sheared", "uneven", "one slice"])
def test_slices_stay_within_their_buffers(device, name):
    """The device of this mark looks at every access."""
    volume = VOLUMES[name]("int16")
    sheet, _ = plane_sheet(find_plane(volume, (20.0, 30.0), (9, 8)), (9, 8))
    samples = slab_samples(volume, 2.0)
    sampled = sample_sheet(DeviceVolume(volume, device=device), sheet, samples, "mean")
    assert_values_are_near(sampled.values, reformat_sheet(volume, sheet, samples, "mean"))


@pytest.mark.oclgrind
def test_curved_reformations_stay_within_their_buffers(device):
    """The device of this mark looks at every access."""
    line = [(0.0, 0.0, 0.5), (2.0, 1.0, 4.0)]
    volume = Volume(random_voxels((6, 5, 4)), np.eye(4))
    bent = reformat_curve(volume, line, "stretched", (7, 9), device=device, view="left")
    assert np.isfinite(bent.values).any()
