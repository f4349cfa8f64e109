"""The bilateral filter: equal to the twin, to ITK and to OpenCV; near a level alone exact there; slabs bit-equal."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import assert_one_line, refused
from surface_volumes import OBLIQUE
from tolerances import FILTER_FLOAT_HU, FILTER_ITK_HU, FILTER_OPENCV_HU, FILTER_ROUNDED_HU
from uneven_volume import uneven
from variants import VOXEL_TYPES

import clrecon
from clrecon.errors import DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.opencl import Stopwatch, download, list_devices
from clrecon.operators.filters.bilateral import SlicesThere, _Run, list_mixed_groups, row_words, run_bilateral
from clrecon.operators.filters.settings import BilateralSettings
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.volumes import volume_twins as twin

SHAPES = [(1, 1, 40), (3, 2, 1), (5, 4, 15), (4, 5, 16), (3, 6, 17), (2, 3, 31), (2, 3, 33), (7, 8, 70)]


SLICES, ROWS, COLUMNS = 20, 30, 50


def ball(*, shape=(SLICES, ROWS, COLUMNS), noise=25.0, dtype="int16", affine=None) -> Volume:
    """A ball of 200 HU, of a radius of 8.3 voxels, in 0 HU."""
    k, j, i = np.indices(shape)
    middle = [(n - 1) / 2 for n in shape]
    distance = np.sqrt((k - middle[0]) ** 2 + (j - middle[1]) ** 2 + (i - middle[2]) ** 2)
    clean = np.clip(100.0 + 60.0 * (8.3 - distance), 0.0, 200.0)
    voxels = clean + np.random.default_rng(3).normal(0.0, noise, shape)
    whole = voxels if dtype == "float32" else np.rint(voxels).astype(dtype)
    return Volume(whole, np.eye(4) if affine is None else affine)


def filter_with_settings(
    device, volume, *, sigma_hu=40.0, sigma_mm=None, dimensions=3, near=None, normals=False, taps=None
):
    """Return the filtered volume, as `run_bilateral` has it, and the settings with their window."""
    settings = BilateralSettings.checked(volume, sigma_mm, sigma_hu, dimensions, near, normals, taps)
    with DeviceVolume(volume, device=device) as resident:
        return run_bilateral(resident, settings), settings


def expected_of(volume, settings):
    offsets = settings.window.offsets
    weights = twin.spatial_weights(volume, offsets, settings.sigma_mm)
    return twin.filter_bilateral(volume.voxels, offsets, weights, settings.sigma_hu)


@pytest.mark.every_device
@pytest.mark.parametrize("dtype", VOXEL_TYPES)
@pytest.mark.parametrize(("dimensions", "taps"), [(3, 150), (2, 13)], ids=["3D", "2D"])
def test_bilateral_filter_equals_its_twin(device, dtype, dimensions, taps):
    """Rows of 1 to 70 voxels: ends of rows overlap in the short ones."""
    allowed = FILTER_FLOAT_HU if dtype == "float32" else FILTER_ROUNDED_HU
    for shape in SHAPES:
        voxels = np.random.default_rng(5).integers(0, 120, shape).astype(dtype)
        if dtype == "float32":
            voxels += np.float32(0.37)
        volume = Volume(voxels, OBLIQUE)
        found, settings = filter_with_settings(device, volume, sigma_hu=30.0, dimensions=dimensions, taps=taps)
        assert found.voxels.dtype == volume.voxels.dtype
        assert np.abs(found.voxels - expected_of(volume, settings)).max() <= allowed, shape


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_bilateral_filter_equals_its_twin_in_uneven_stacks(device, sign):
    shape = uneven(sign=sign).voxels.shape
    volume = uneven(np.random.default_rng(6).integers(0, 120, shape).astype(np.float32), sign=sign)
    found, settings = filter_with_settings(device, volume, sigma_hu=30.0, sigma_mm=0.9)
    assert len(settings.window.exponents) == shape[0]
    assert np.abs(found.voxels - expected_of(volume, settings)).max() <= FILTER_FLOAT_HU


@pytest.mark.seconds
def test_filter_gives_the_same_bits_on_all_cpu_devices():
    devices = [device for device in list_devices() if device.type == "cpu"]
    usable = [device for device in devices if not device.is_simulator and not device.shortcoming]
    if len(usable) < 2:
        pytest.skip("fewer than two CPU devices")
    filtered = [filter_with_settings(device, ball(dtype="float32")) for device in usable]
    first, *rest = (volume.voxels for volume, _ in filtered)
    for voxels in rest:
        np.testing.assert_array_equal(voxels, first)


@pytest.mark.oclgrind
@pytest.mark.parametrize("near", [None, 100])
def test_small_volume_filtered_as_a_whole_or_near_a_level_keeps_its_shape(device, near):
    found, _ = filter_with_settings(device, ball(shape=(3, 4, 35)), taps=27, near=near)
    assert found.voxels.shape == (3, 4, 35)


def test_bilateral_filter_equals_itk_at_equal_taps(device):
    sitk = pytest.importorskip("SimpleITK")
    volume = ball(dtype="float32", affine=np.diag((0.7, 0.7, 1.4, 1.0)))
    image = sitk.GetImageFromArray(volume.voxels)
    image.SetSpacing(volume.spacing)
    sigmas = {"domainSigma": 0.56, "rangeSigma": 75.0}
    theirs = sitk.GetArrayFromImage(sitk.Bilateral(image, **sigmas, numberOfRangeGaussianSamples=100))
    found, settings = filter_with_settings(device, volume, sigma_hu=75.0, sigma_mm=0.56)
    assert settings.window.taps == 5 * 5 * 3  # steps of ITK's radius of 2.5 sigma: two in the slice, one across
    assert np.abs(found.voxels - theirs).max() <= FILTER_ITK_HU


def test_bilateral_filter_equals_opencv(device):
    cv2 = pytest.importorskip("cv2")
    volume = ball(shape=(2, 30, 50), dtype="float32")
    window = {"d": 5, "sigmaColor": 75.0, "sigmaSpace": 1.3, "borderType": cv2.BORDER_REPLICATE}
    theirs = [cv2.bilateralFilter(layer, **window) for layer in volume.voxels]
    found, _ = filter_with_settings(device, volume, sigma_hu=75.0, sigma_mm=1.3, dimensions=2, taps=13)
    assert np.abs(found.voxels - theirs).max() <= FILTER_OPENCV_HU


def test_filter_of_one_voxel_equals_the_sum_by_hand(device):
    """One voxel of 10 HU in a row of zeros: exp(-1/2) for the step and exp(-1/2) for the difference, twice."""
    volume = Volume(np.array([[[0, 0, 0, 10, 0, 0, 0]]], np.float32), np.eye(4))
    found, _ = filter_with_settings(device, volume, sigma_hu=10.0, sigma_mm=1.0, dimensions=2, taps=5)
    # Above and below lie repeated edges: the disc of five has two taps of the voxel's own value.
    far = np.exp(-0.5)
    middle = 10.0 - 2 * far * far * 10.0 / (1.0 + 2 * far + 2 * far * far)
    beside = far * far * 10.0 / (1.0 + 3 * far + far * far)
    assert found.voxels[0, 0] == pytest.approx([0, 0, beside, middle, beside, 0, 0], abs=3e-6)  # measured 1.5e-6


def test_bilateral_filter_with_a_large_sigma_hu_is_a_gaussian(device):
    volume = ball()
    found, settings = filter_with_settings(device, volume, sigma_hu=1e7)
    weights = np.exp2(settings.window.exponents[0])
    inner = np.zeros(volume.voxels.shape)
    for (i, j, k), weight in zip(settings.window.offsets.tolist(), weights / weights.sum(), strict=True):
        inner += weight * np.roll(volume.voxels.astype(np.float64), (-k, -j, -i), (0, 1, 2))
    core = (slice(4, -4),) * 3  # the roll is wrong at the borders
    assert np.abs(found.voxels - inner)[core].max() <= FILTER_ROUNDED_HU


def test_voxels_that_are_no_values_stay_and_others_are_filtered_as_by_the_twin(device):
    volume = ball(dtype="float32")
    voxels = volume.voxels.copy()
    voxels[5, 6, 7], voxels[10, 15, 25], voxels[3, 3, 49], voxels[0, 0, 0] = np.nan, np.inf, -np.inf, 3e38
    broken = Volume(voxels, volume.affine)
    found, settings = filter_with_settings(device, broken)
    expected = expected_of(broken, settings)
    np.testing.assert_array_equal(np.isfinite(found.voxels), np.isfinite(voxels))
    there = np.isfinite(voxels) & (voxels < 1e38)
    assert np.isnan(found.voxels[5, 6, 7]) and found.voxels[0, 0, 0] == np.float32(3e38)
    assert np.abs(found.voxels[there] - expected[there]).max() <= FILTER_FLOAT_HU


def random_volume(shape, dtype):
    return Volume(np.random.default_rng(7).integers(0, 200, shape).astype(dtype), np.diag((0.7, 0.9, 1.3, 1.0)))


NEAR = {
    "ball": lambda: ball(noise=5.0),
    "noise": lambda: random_volume((6, 9, 70), "int16"),
    "floats": lambda: ball(noise=5.0, dtype="float32"),
    "row": lambda: random_volume((1, 1, 100), "int16"),
    "slice": lambda: ball(shape=(1, 40, 90), noise=5.0),
    "column": lambda: random_volume((30, 1, 1), "int16"),
    "wide": lambda: ball(shape=(3, 20, 1100), noise=5.0),
    "uneven": lambda: uneven(np.random.default_rng(2).integers(0, 200, uneven().voxels.shape).astype(np.int16)),
}


def beside_crossed_edges(inside):
    """Voxels at both ends of an edge from inside to outside."""
    beside = np.zeros(inside.shape, np.bool_)
    for axis in range(3):
        one, other = (np.moveaxis(beside, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        crossed = np.diff(np.moveaxis(inside, axis, 0).astype(np.int8), axis=0) != 0
        one |= crossed
        other |= crossed
    return beside


@pytest.fixture(params=[(name, dimensions) for name in NEAR for dimensions in (2, 3)], ids=str)
def near_and_whole(request, device):
    """A volume filtered as a whole, and a function that filters it near 100 HU, with or without normals."""
    name, dimensions = request.param
    volume = NEAR[name]()

    how = {"sigma_hu": 20.0, "dimensions": dimensions}

    def filter_near(normals):
        near, _ = filter_with_settings(device, volume, **how, near=100.0, normals=normals)
        return near

    whole, _ = filter_with_settings(device, volume, **how)
    return name, volume, whole, filter_near


@pytest.mark.parametrize("normals", [False, True])
def test_filter_near_a_level_has_its_sides_and_the_values_beside_it_of_the_whole_filter(near_and_whole, normals):
    """At both ends of every crossed edge; all other voxels are filtered or as they were."""
    _, volume, whole, filter_near = near_and_whole
    near = filter_near(normals)
    inside = whole.voxels >= 100.0
    np.testing.assert_array_equal(near.voxels >= 100.0, inside)
    beside = beside_crossed_edges(inside)
    np.testing.assert_array_equal(near.voxels[beside], whole.voxels[beside])
    assert ((near.voxels == whole.voxels) | (near.voxels == volume.voxels)).all()


def test_filter_near_a_level_for_normals_has_the_values_a_voxel_farther_of_the_whole_filter(near_and_whole):
    """Normals are central differences at both ends of a crossed edge."""
    name, _, whole, filter_near = near_and_whole
    if name == "row":
        pytest.skip("a roll along a single row meets its other end")
    near = filter_near(normals=True)
    beside = beside_crossed_edges(whole.voxels >= 100.0)
    around = beside.copy()
    for axis in range(3):
        for step in (1, -1):
            around |= np.roll(beside, step, axis)
    np.testing.assert_array_equal(near.voxels[around], whole.voxels[around])


@pytest.mark.parametrize("name", ["ball", "wide"])
def test_filter_near_a_level_filters_less_than_seven_tenths_of_a_ball(device, name):
    near, _ = filter_with_settings(device, NEAR[name](), sigma_hu=20.0, near=100.0, normals=True)
    assert near.share < 0.7  # measured 0.04 to 0.62


@pytest.mark.parametrize("normals", [False, True])
def test_surface_of_a_volume_filtered_near_its_level_is_that_of_the_whole_filter(device, normals):
    volume = ball(noise=10.0)
    meshes = []
    for near in (None, 100):
        filtered = clrecon.filter_bilateral(volume, sigma_hu=30.0, near=near, normals=normals, device=device)
        meshes.append(clrecon.extract_isosurface(filtered, 100, device=device))
    of_whole, of_near = meshes
    np.testing.assert_array_equal(of_near.vertices, of_whole.vertices)
    np.testing.assert_array_equal(of_near.triangles, of_whole.triangles)
    if normals:
        np.testing.assert_array_equal(of_near.normals, of_whole.normals)


@pytest.fixture(scope="module")
def filtered_bars(device):
    """A bar through all 12 slices of a volume, filtered as a whole and near 100 HU."""
    bar = np.repeat(ball(noise=10.0).voxels[10:11], 12, axis=0) + np.arange(12, dtype=np.int16)[:, None, None]
    volume = Volume(bar, np.eye(4))
    return [clrecon.filter_bilateral(volume, sigma_hu=30.0, near=near, device=device) for near in (None, 100)]


def test_report_of_a_filter_near_a_surface_that_leaves_the_volume_says_that_its_ends_are_not_exact(filtered_bars):
    whole, near = (volume.report["filtered"]["steps"][-1]["exact_at_ends"] for volume in filtered_bars)
    assert whole is None
    assert near is False


@pytest.mark.parametrize("closed", [True, False])
def test_only_the_closed_ends_of_a_surface_filtered_near_its_level_are_moved(device, filtered_bars, closed):
    whole, near = (clrecon.extract_isosurface(each, 100, closed=closed, device=device) for each in filtered_bars)
    np.testing.assert_array_equal(whole.triangles, near.triangles)
    moved = (whole.vertices != near.vertices).any(axis=1)
    assert moved.any() == closed
    heights = whole.vertices[moved, 2]
    assert ((heights < 0.0) | (heights > 11.0)).all()  # beyond the outermost centres alone


def test_a_surface_within_the_volume_is_exact_at_its_ends(device):
    (step,) = clrecon.filter_bilateral(ball(), sigma_hu=30.0, near=100, device=device).report["filtered"]["steps"]
    assert step["exact_at_ends"] is True


def groups_near(device, volume: Volume, level: int, reach: tuple[int, int, int]) -> np.ndarray:
    """Which groups of 16 voxels of a row have the level within reach, as the device lists them: (nk, nj, groups).

    reach: Voxels along i, j and k.
    """
    ni, nj, nk = volume.shape_ijk
    with DeviceVolume(volume, device=device) as resident:
        voxels_d = resident.whole(Stopwatch())
        there = SlicesThere(voxels_d, ni, nj, first=0, count=nk, core_first=0, core_count=nk)
        listed = list_mixed_groups(device, there, volume.voxels.dtype, level=np.int16(level), reach=reach)
    numbers = download(device, np.empty(listed.count, np.uint32), listed.positions_d)
    row, group = np.divmod(numbers, 32 * row_words(ni))  # a row has a bit for each group, in words of 32
    marked = np.zeros((nk * nj, -(-ni // 16)), np.bool_)
    marked[row, group] = True
    return marked.reshape(nk, nj, -1)


@pytest.mark.every_device
@pytest.mark.parametrize("reach", [(1, 1, 1), (2, 3, 0), (16, 2, 5)])
def test_groups_near_a_level_equal_the_twin(device, reach):
    level = 100  # HU
    volumes = [
        ball(shape=(9, 20, 600), noise=2.0),
        random_volume((3, 4, 33), "int16"),
        random_volume((2, 3, 16), "int16"),
        Volume(np.full((3, 4, 20), 150, np.int16), np.eye(4)),  # above the level alone: no group
    ]
    for volume in volumes:
        expected = twin.mark_mixed_groups(volume.voxels, float(level), reach)
        np.testing.assert_array_equal(groups_near(device, volume, level, reach), expected)


def slabs_of(volume):
    (step,) = volume.report["filtered"]["steps"]
    return step["slabs"]


@pytest.mark.parametrize("near", [None, 100.0])
@pytest.mark.parametrize("kind", ["even", "uneven"])
def test_filter_in_slabs_gives_the_same_bits_until_memory_is_refused(device, kind, near):
    volume = ball() if kind == "even" else uneven(ball(shape=(6, 60, 200)).voxels)
    whole = clrecon.filter_bilateral(volume, sigma_hu=20.0, near=near, device=device)
    assert slabs_of(whole) == 1
    slabs, memory = set(), 4 * volume.voxels.nbytes + 100_000
    while True:
        memory = int(0.8 * memory)
        try:
            parts = clrecon.filter_bilateral(volume, sigma_hu=20.0, near=near, device=device, memory=memory)
        except DeviceError as error:
            assert_one_line(error, "memory", "bytes")
            break
        slabs.add(slabs_of(parts))
        np.testing.assert_array_equal(parts.voxels, whole.voxels)
    assert max(slabs) > 2


@pytest.fixture
def filtered_twice(device):
    """A volume on the device, filtered, and filtered again near 100 HU, all on the device."""
    with DeviceVolume(ball(), device=device) as resident:
        once = clrecon.filter_bilateral(resident, sigma_hu=30.0)
        yield once, clrecon.filter_bilateral(once, sigma_hu=30.0, near=100)


@pytest.fixture(scope="module")
def mesh_of_filtered_twice(device):
    """The surface at 100 HU of a volume that is filtered twice by way of the host."""
    once = clrecon.filter_bilateral(ball(), sigma_hu=30.0, device=device)
    twice = clrecon.filter_bilateral(once, sigma_hu=30.0, near=100, device=device)
    return clrecon.extract_isosurface(twice, 100, device=device)


def test_filter_of_a_device_volume_gives_one_that_is_held_there_without_an_upload(filtered_twice):
    once, twice = filtered_twice
    assert isinstance(once, DeviceVolume)
    assert once.is_held
    clrecon.extract_isosurface(twice, 100)
    assert once.uploaded_bytes == twice.uploaded_bytes == 0


def test_surface_of_a_volume_filtered_on_the_device_is_that_of_one_filtered_by_the_host(
    filtered_twice, mesh_of_filtered_twice
):
    _, twice = filtered_twice
    np.testing.assert_array_equal(clrecon.extract_isosurface(twice, 100).vertices, mesh_of_filtered_twice.vertices)


def test_a_filtered_volume_that_the_device_has_lost_is_uploaded_again(filtered_twice, mesh_of_filtered_twice):
    _, twice = filtered_twice
    twice.release()
    np.testing.assert_array_equal(clrecon.extract_isosurface(twice, 100).vertices, mesh_of_filtered_twice.vertices)


def test_report_of_a_volume_filtered_twice_has_both_steps(filtered_twice):
    _, twice = filtered_twice
    assert [step["near_hu"] for step in twice.volume.report["filtered"]["steps"]] == [None, 100.0]


@pytest.fixture(scope="module")
def default_step(device):
    """The report of a filter with all defaults on voxels of 1 mm, and its warnings."""
    report = clrecon.filter_bilateral(ball(noise=12.0), device=device).report
    (step,) = report["filtered"]["steps"]
    return step, report["warnings"]


def test_filter_has_by_default_a_sigma_of_a_voxel_and_of_three_times_the_noise(default_step):
    step, warnings = default_step
    assert (step["filter"], step["dimensions"], step["sigma_mm"]) == ("bilateral", 3, 1.0)
    assert step["sigma_hu"] == pytest.approx(3 * step["noise_hu"], abs=0.01)  # digits of the report
    assert warnings == []


def test_report_of_a_filter_tells_its_window_and_the_share_that_it_filtered(default_step):
    step, _ = default_step
    assert (step["taps"], step["window"], step["whole_window_taps"]) == (123, [7, 7, 7], 7**3)  # within three steps
    assert step["filtered_share"] == 1.0
    assert step["near_hu"] is None


def test_filter_adds_nothing_to_the_report_of_its_volume(device):
    volume = ball(noise=12.0)
    clrecon.filter_bilateral(volume, sigma_hu=30.0, device=device)
    assert "filtered" not in volume.report


def test_a_window_of_few_taps_is_warned_of(device):
    report = clrecon.filter_bilateral(ball(), sigma_hu=30.0, taps=7, device=device).report
    assert "the window of 7 taps holds" in report["warnings"][0]


def test_progress_of_the_bilateral_filter_is_told_from_no_slice_to_all(device):
    told = []
    clrecon.filter_bilateral(ball(), sigma_hu=30.0, device=device, progress=lambda *step: told.append(step))
    assert told[0] == ("filter", 0, SLICES)
    assert told[-1] == ("filter", SLICES, SLICES)


def test_progress_near_a_level_goes_on_over_the_slabs(device):
    told, volume = [], ball()
    clrecon.filter_bilateral(
        volume, sigma_hu=30.0, near=100, device=device, memory=2 * volume.voxels.nbytes + 100_000,
        progress=lambda *step: told.append(step),
    )  # fmt: skip
    counts = [count for stage, count, _ in told if stage == "filter"]
    assert counts == sorted(set(counts))
    assert len(counts) > 2
    assert counts[-1] == SLICES


def test_slab_near_a_level_needs_the_memory_of_its_groups(device):
    """Four masks of the rows that are there, one of the core, and a list of the groups of 16 voxels."""
    slices, rows, columns = 9, 6, 700
    volume = ball(shape=(slices, rows, columns))
    groups, words = -(-columns // 16), 2  # a row has so many groups, in words of 32
    settings = BilateralSettings.checked(
        volume, sigma_mm=None, sigma_hu=40.0, dimensions=3, near=100.0, normals=False, taps=27
    )
    with DeviceVolume(volume, device=device) as resident:
        run = _Run(resident, settings, Stopwatch(), lambda *step: None)
        core = 2  # slices
        there = core + 2 * run.halo
        assert there < slices
        needed = 4 * words * (4 * there * rows + core * rows) + 4 * groups * core * rows
        assert run.needs(core)["groups near the level"] == needed


def cancel(stage, done, total):
    raise clrecon.Cancelled("enough")


def test_filter_is_ended_by_its_progress(device):
    with refused(clrecon.Cancelled, "enough"):
        clrecon.filter_bilateral(ball(), sigma_hu=30.0, device=device, progress=cancel)


NAN = float("nan")


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"sigma_mm": 0}, "sigma_mm is a length in mm above 0, not 0"),
        ({"sigma_mm": -1.0}, "sigma_mm is a length in mm above 0, not -1.0"),
        ({"sigma_mm": NAN}, "sigma_mm is a length in mm above 0, not nan"),
        ({"sigma_mm": 51}, rf"sigma_mm is 51 mm, larger than the volume \({COLUMNS} x {ROWS} x {SLICES} mm\)"),
        ({"sigma_mm": "wide"}, "sigma_mm is a length"),
        ({"sigma_hu": 0.0}, "sigma_hu is a number of HU above 0, not 0.0"),
        ({"sigma_hu": -3}, "sigma_hu is a number of HU above 0, not -3"),
        ({"sigma_hu": NAN}, "sigma_hu is a number of HU above 0, not nan"),
        ({"sigma_hu": float("inf")}, "sigma_hu is a number of HU above 0, not inf"),
        ({"sigma_hu": True}, "sigma_hu is a number of HU above 0, not True"),
        ({"dimensions": 4}, "2 dimensions, slice by slice, or 3, not 4"),
        ({"taps": 1}, "taps are a whole number from 2 to 4,096, not 1"),
        ({"taps": 2.5}, "taps are a whole number"),
        ({"taps": 5}, "taps=5 leaves no neighbour"),
        ({"near": NAN}, "nan"),
    ],
)
def test_wrong_parameters_of_the_bilateral_filter_are_refused_in_one_line(device, parameters, words):
    with pytest.raises(UsageError, match=words) as refused:
        clrecon.filter_bilateral(ball(), device=device, **{"sigma_hu": 30.0, **parameters})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("volume", "options", "error", "words"),
    [
        (Volume(np.full((2, 2, 2), 1 << 24, np.int32), np.eye(4)), {"sigma_hu": 3.0}, UsageError, "exactly"),
        (ball(), {"sigma_hu": 3.0, "near": 40000}, NoSurfaceError, "no voxel can lie near 40000 HU: voxels are int16"),
        (Volume(np.zeros((2, 2, 2)), np.eye(4)), {}, UsageError, "the noise cannot be measured.*give sigma_hu=HU"),
        (Volume(np.zeros((9, 60, 60)), np.eye(4)), {}, UsageError, "has no noise: give sigma_hu=HU"),
        (np.zeros((2, 2, 2)), {}, UsageError, "a filter needs a Volume, not ndarray"),
    ],
    ids=["beyond float32", "level beyond int16", "too small to measure noise", "no noise", "array"],
)
def test_volumes_that_cannot_be_filtered_are_refused(device, volume, options, error, words):
    with pytest.raises(error, match=words):
        clrecon.filter_bilateral(volume, **options, device=device)
