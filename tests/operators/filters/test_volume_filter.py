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


def ball(shape=(20, 30, 50), noise=25.0, dtype="int16", affine=None) -> Volume:
    """A ball of 200 HU in 0 HU."""
    k, j, i = np.indices(shape)
    middle = [(n - 1) / 2 for n in shape]
    distance = np.sqrt((k - middle[0]) ** 2 + (j - middle[1]) ** 2 + (i - middle[2]) ** 2)
    clean = np.clip(100.0 + 60.0 * (8.3 - distance), 0.0, 200.0)
    voxels = clean + np.random.default_rng(3).normal(0.0, noise, shape)
    whole = voxels if dtype == "float32" else np.rint(voxels).astype(dtype)
    return Volume(whole, np.eye(4) if affine is None else affine)


def run(device, volume, sigma_hu=40.0, sigma_mm=None, dimensions=3, near=None, normals=False, taps=None):
    settings = BilateralSettings.checked(volume, sigma_mm, sigma_hu, dimensions, near, normals, taps)
    with DeviceVolume(volume, device=device) as resident:
        return run_bilateral(resident, settings), settings


def expected_of(volume, settings):
    offsets = settings.window.offsets
    weights = twin.spatial_weights(volume, offsets, settings.sigma_mm)
    return twin.filter_bilateral(volume.voxels, offsets, weights, settings.sigma_hu)


@pytest.mark.every_device
@pytest.mark.parametrize("dtype", VOXEL_TYPES)
def test_bilateral_filter_equals_its_twin(device, dtype):
    """Rows of 1 to 70 voxels: ends of rows overlap in the short ones."""
    for shape in SHAPES:
        voxels = np.random.default_rng(5).integers(0, 120, shape).astype(dtype)
        if dtype == "float32":
            voxels += np.float32(0.37)
        volume = Volume(voxels, OBLIQUE)
        for dimensions, taps in ((3, 150), (2, 13)):
            found, settings = run(device, volume, 30.0, dimensions=dimensions, taps=taps)
            allowed = FILTER_FLOAT_HU if dtype == "float32" else FILTER_ROUNDED_HU
            assert found.voxels.dtype == volume.voxels.dtype
            assert np.abs(found.voxels - expected_of(volume, settings)).max() <= allowed


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_bilateral_filter_equals_its_twin_in_uneven_stacks(device, sign):
    shape = uneven(sign=sign).voxels.shape
    volume = uneven(np.random.default_rng(6).integers(0, 120, shape).astype(np.float32), sign)
    found, settings = run(device, volume, 30.0, 0.9)
    assert len(settings.window.exponents) == shape[0]
    assert np.abs(found.voxels - expected_of(volume, settings)).max() <= FILTER_FLOAT_HU


@pytest.mark.seconds
def test_filter_gives_the_same_bits_on_every_device(device):
    others = [one for one in list_devices() if one.type == "cpu" and not one.is_simulator and not one.shortcoming]
    if len(others) < 2:
        pytest.skip("one device")
    first, *rest = (run(one, ball(dtype="float32"))[0].voxels for one in others)
    for voxels in rest:
        np.testing.assert_array_equal(voxels, first)


@pytest.mark.oclgrind
def test_filter_runs_cleanly_under_a_simulator(device):
    found, settings = run(device, ball((3, 4, 35)), taps=27)
    near, _ = run(device, ball((3, 4, 35)), taps=27, near=100)
    assert found.voxels.shape == near.voxels.shape == (3, 4, 35)


def test_bilateral_filter_equals_itk_at_equal_taps(device):
    sitk = pytest.importorskip("SimpleITK")
    volume = ball(dtype="float32", affine=np.diag((0.7, 0.7, 1.4, 1.0)))
    image = sitk.GetImageFromArray(volume.voxels)
    image.SetSpacing(volume.spacing)
    theirs = sitk.GetArrayFromImage(sitk.Bilateral(image, 0.56, 75.0, 100))
    found, settings = run(device, volume, 75.0, 0.56)
    assert settings.window.taps == 75
    assert np.abs(found.voxels - theirs).max() <= FILTER_ITK_HU


def test_bilateral_filter_equals_opencv(device):
    cv2 = pytest.importorskip("cv2")
    volume = ball((2, 30, 50), dtype="float32")
    theirs = [cv2.bilateralFilter(layer, 5, 75.0, 1.3, borderType=cv2.BORDER_REPLICATE) for layer in volume.voxels]
    found, _ = run(device, volume, 75.0, 1.3, 2, taps=13)
    assert np.abs(found.voxels - theirs).max() <= FILTER_OPENCV_HU


def test_filter_of_one_voxel_equals_the_sum_by_hand(device):
    """One voxel of 10 HU in a row of zeros: exp(-1/2) for the step and exp(-1/2) for the difference, twice."""
    volume = Volume(np.array([[[0, 0, 0, 10, 0, 0, 0]]], np.float32), np.eye(4))
    found, settings = run(device, volume, 10.0, 1.0, 2, taps=5)
    # Above and below lie repeated edges: the disc of five has two taps of the voxel's own value.
    far = np.exp(-0.5)
    middle = 10.0 - 2 * far * far * 10.0 / (1.0 + 2 * far + 2 * far * far)
    beside = far * far * 10.0 / (1.0 + 3 * far + far * far)
    assert found.voxels[0, 0] == pytest.approx([0, 0, beside, middle, beside, 0, 0], abs=1e-4)


def test_a_large_sigma_hu_is_a_gaussian(device):
    volume = ball()
    found, settings = run(device, volume, 1e7)
    weights = np.exp2(settings.window.exponents[0])
    inner = np.zeros(volume.voxels.shape)
    for (i, j, k), weight in zip(settings.window.offsets.tolist(), weights / weights.sum(), strict=True):
        inner += weight * np.roll(volume.voxels.astype(np.float64), (-k, -j, -i), (0, 1, 2))
    core = (slice(4, -4),) * 3
    assert np.abs(found.voxels - inner)[core].max() <= FILTER_ROUNDED_HU


def test_nan_and_infinite_voxels_stay_and_count_nowhere(device):
    volume = ball(dtype="float32")
    voxels = volume.voxels.copy()
    voxels[5, 6, 7], voxels[10, 15, 25], voxels[3, 3, 49], voxels[0, 0, 0] = np.nan, np.inf, -np.inf, 3e38
    broken = Volume(voxels, volume.affine)
    found, settings = run(device, broken)
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
    "slice": lambda: ball((1, 40, 90), 5.0),
    "column": lambda: random_volume((30, 1, 1), "int16"),
    "wide": lambda: ball((3, 20, 1100), 5.0),
    "uneven": lambda: uneven(np.random.default_rng(2).integers(0, 200, uneven().voxels.shape).astype(np.int16)),
}


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("make", NEAR)
def test_filter_near_a_level_is_exact_there(device, make, dimensions):
    """Sides of the level everywhere; values at both ends of every crossed edge; with normals those around, too."""
    volume, level = NEAR[make](), 100.0
    whole, _ = run(device, volume, 20.0, dimensions=dimensions)
    for normals in (False, True):
        near, settings = run(device, volume, 20.0, dimensions=dimensions, near=level, normals=normals)
        inside = whole.voxels >= level
        np.testing.assert_array_equal(near.voxels >= level, inside)
        decide = np.zeros(inside.shape, np.bool_)
        for axis in range(3):
            one, other = (np.moveaxis(decide, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
            crossed = np.diff(np.moveaxis(inside, axis, 0).astype(np.int8), axis=0) != 0
            one |= crossed
            other |= crossed
        if normals:  # central differences at both ends
            ring = decide.copy()
            for axis in range(3):
                for step in (1, -1):
                    ring |= np.roll(decide, step, axis)
            decide = ring if make != "row" else decide
        np.testing.assert_array_equal(near.voxels[decide], whole.voxels[decide])
        same = (near.voxels == whole.voxels) | (near.voxels == volume.voxels)
        assert same.all()
    if make in ("ball", "wide"):
        assert near.share < 0.7


@pytest.mark.parametrize("normals", [False, True])
def test_surfaces_of_a_near_filter_are_those_of_the_whole_one(device, normals):
    volume = ball(noise=10.0)
    meshes = []
    for near in (None, 100):
        made = clrecon.filter_bilateral(volume, sigma_hu=30.0, near=near, normals=normals, device=device)
        meshes.append(clrecon.extract_isosurface(made, 100, device=device))
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    np.testing.assert_array_equal(meshes[0].triangles, meshes[1].triangles)
    if normals:
        np.testing.assert_array_equal(meshes[0].normals, meshes[1].normals)


@pytest.mark.parametrize("closed", [True, False])
def test_report_says_that_a_closed_surface_differs_where_the_volume_ends(device, closed):
    """A bar through the volume: its open surface is the same, its closed ends are not."""
    bar = np.repeat(ball(noise=10.0).voxels[10:11], 12, axis=0) + np.arange(12, dtype=np.int16)[:, None, None]
    volume = Volume(bar, np.eye(4))
    made = [clrecon.filter_bilateral(volume, sigma_hu=30.0, near=near, device=device) for near in (None, 100)]
    assert [each.report["filtered"]["steps"][-1]["exact_at_ends"] for each in made] == [None, False]
    whole, near = (clrecon.extract_isosurface(each, 100, closed=closed, device=device) for each in made)
    np.testing.assert_array_equal(whole.triangles, near.triangles)
    moved = (whole.vertices != near.vertices).any(axis=1)
    assert moved.any() == closed
    heights = whole.vertices[moved, 2]
    assert ((heights < 0.0) | (heights > 11.0)).all()  # beyond the outermost centres alone


def test_a_surface_within_the_volume_is_exact_at_its_ends(device):
    (step,) = clrecon.filter_bilateral(ball(), sigma_hu=30.0, near=100, device=device).report["filtered"]["steps"]
    assert step["exact_at_ends"] is True


@pytest.mark.every_device
@pytest.mark.parametrize("reach", [(1, 1, 1), (2, 3, 0), (16, 2, 5)])
def test_groups_near_a_level_equal_the_twin(device, reach):
    volumes = [ball((9, 20, 600), 2.0), random_volume((3, 4, 33), "int16"), random_volume((2, 3, 16), "int16")]
    volumes.append(Volume(np.full((3, 4, 20), 150, np.int16), np.eye(4)))
    for volume in volumes:
        ni, nj, nk = volume.shape_ijk
        with DeviceVolume(volume, device=device) as resident:
            there = SlicesThere(resident.whole(Stopwatch()), ni, nj, 0, nk, 0, nk)
            listed = list_mixed_groups(device, there, volume.voxels.dtype, np.int16(100), reach)
        numbers = download(device, np.empty(listed.count, np.uint32), listed.positions_d)
        marked = np.zeros((nk * nj, -(-ni // 16)), np.bool_)
        marked[numbers // (32 * row_words(ni)), numbers % (32 * row_words(ni))] = True
        expected = twin.mark_mixed_groups(volume.voxels, 100.0, reach)
        np.testing.assert_array_equal(marked.reshape(expected.shape), expected)


@pytest.mark.parametrize("near", [None, 100.0])
@pytest.mark.parametrize("make", ["ball", "uneven"])
def test_slabs_give_the_same_bits(device, make, near):
    volume = NEAR[make]()
    whole = clrecon.filter_bilateral(volume, sigma_hu=20.0, near=near, device=device)
    assert whole.report["filtered"]["steps"][0]["slabs"] == 1
    slabs, memory = set(), 4 * volume.voxels.nbytes + 100_000
    while True:
        memory = int(0.8 * memory)
        try:
            parts = clrecon.filter_bilateral(volume, sigma_hu=20.0, near=near, device=device, memory=memory)
        except DeviceError as error:
            assert_one_line(error, "memory", "bytes")
            break
        slabs.add(parts.report["filtered"]["steps"][0]["slabs"])
        np.testing.assert_array_equal(parts.voxels, whole.voxels)
    assert max(slabs) > 2 or make == "uneven"


def test_filter_of_a_device_volume_gives_one_that_is_held_there(device):
    volume = ball()
    with DeviceVolume(volume, device=device) as resident:
        filtered = clrecon.filter_bilateral(resident, sigma_hu=30.0)
        assert isinstance(filtered, DeviceVolume) and filtered.is_held and filtered.uploaded_bytes == 0
        again = clrecon.filter_bilateral(filtered, sigma_hu=30.0, near=100)
        mesh = clrecon.extract_isosurface(again, 100)
        assert filtered.uploaded_bytes == again.uploaded_bytes == 0
        assert resident.volume is volume
    apart = clrecon.filter_bilateral(
        clrecon.filter_bilateral(volume, sigma_hu=30.0, device=device), sigma_hu=30.0, near=100, device=device
    )
    np.testing.assert_array_equal(mesh.vertices, clrecon.extract_isosurface(apart, 100, device=device).vertices)
    assert [step["near_hu"] for step in again.volume.report["filtered"]["steps"]] == [None, 100.0]
    again.release()  # what the device held is uploaded again
    np.testing.assert_array_equal(clrecon.extract_isosurface(again, 100).vertices, mesh.vertices)


def test_the_report_says_what_was_done(device):
    volume = ball(noise=12.0)
    made = clrecon.filter_bilateral(volume, device=device)
    (step,) = made.report["filtered"]["steps"]
    assert step["filter"] == "bilateral" and step["dimensions"] == 3 and step["sigma_mm"] == 1.0
    assert step["sigma_hu"] == pytest.approx(3 * step["noise_hu"], abs=0.01)
    assert (step["taps"], step["window"], step["whole_window_taps"]) == (123, [7, 7, 7], 343)
    assert step["filtered_share"] == 1.0 and step["near_hu"] is None and made.report["warnings"] == []
    assert "filtered" not in volume.report
    few = clrecon.filter_bilateral(volume, sigma_hu=30.0, taps=7, near=100, device=device)
    assert "the window of 7 taps holds" in few.report["warnings"][0]
    assert 0.0 < few.report["filtered"]["steps"][0]["filtered_share"] < 1.0


def test_filter_tells_its_progress_by_slices(device):
    told = []
    clrecon.filter_bilateral(ball(), sigma_hu=30.0, device=device, progress=lambda *step: told.append(step))
    assert told[0] == ("filter", 0, 20) and told[-1] == ("filter", 20, 20)


def test_progress_near_a_level_goes_on_over_the_slabs(device):
    told, volume = [], ball()
    clrecon.filter_bilateral(
        volume, sigma_hu=30.0, near=100, device=device, memory=2 * volume.voxels.nbytes + 100_000,
        progress=lambda *step: told.append(step),
    )  # fmt: skip
    counts = [count for stage, count, _ in told if stage == "filter"]
    assert counts == sorted(set(counts)) and counts[-1] == 20 and len(counts) > 2


def test_slab_near_a_level_needs_the_memory_of_its_groups(device):
    """Of 700 voxels in a row: 44 groups in 2 words.  Four masks of the rows that are there, one of the core, a list."""
    volume = ball((9, 6, 700))
    settings = BilateralSettings.checked(volume, None, 40.0, 3, 100.0, False, 27)
    with DeviceVolume(volume, device=device) as resident:
        run = _Run(resident, settings, Stopwatch(), lambda *step: None)
        there = 2 + 2 * run.halo
        groups = 4 * 2 * (4 * there * 6 + 2 * 6) + 4 * 44 * 2 * 6
        assert there < 9 and run.needs(2)["groups near the level"] == groups


def refuse(stage, done, total):
    raise clrecon.Cancelled("enough")


def test_filter_is_ended_by_its_progress(device):
    with refused(clrecon.Cancelled, "enough"):
        clrecon.filter_bilateral(ball(), sigma_hu=30.0, device=device, progress=refuse)


NAN = float("nan")


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"sigma_mm": 0}, "sigma_mm is a length in mm above 0, not 0"),
        ({"sigma_mm": -1.0}, "sigma_mm is a length in mm above 0, not -1.0"),
        ({"sigma_mm": NAN}, "sigma_mm is a length in mm above 0, not nan"),
        ({"sigma_mm": 51}, r"sigma_mm is 51 mm, larger than the volume \(50 x 30 x 20 mm\)"),
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
def test_bad_parameters_are_refused_in_one_line(device, parameters, words):
    with pytest.raises(UsageError, match=words) as refused:
        clrecon.filter_bilateral(ball(), device=device, **{"sigma_hu": 30.0, **parameters})
    assert "\n" not in str(refused.value)


def test_what_cannot_be_filtered_is_refused(device):
    huge = Volume(np.full((2, 2, 2), 1 << 24, np.int32), np.eye(4))
    with pytest.raises(UsageError, match="cannot be filtered exactly"):
        clrecon.filter_bilateral(huge, sigma_hu=3.0, device=device)
    with pytest.raises(NoSurfaceError, match="no voxel can lie near 40000 HU: voxels are int16"):
        clrecon.filter_bilateral(ball(), sigma_hu=3.0, near=40000, device=device)
    with pytest.raises(UsageError, match="the noise cannot be measured.*give sigma_hu=HU"):
        clrecon.filter_bilateral(Volume(np.zeros((2, 2, 2)), np.eye(4)), device=device)
    with pytest.raises(UsageError, match="has no noise: give sigma_hu=HU"):
        clrecon.filter_bilateral(Volume(np.zeros((9, 60, 60)), np.eye(4)), device=device)
    with pytest.raises(UsageError, match="a filter needs a Volume, not ndarray"):
        clrecon.filter_bilateral(np.zeros((2, 2, 2)), device=device)  # type: ignore[type-var]
