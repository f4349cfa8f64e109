"""A volume that is kept on a device is a volume for everything that takes one."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from device_work import label_boxes
from failing_devices import Failing
from surface_volumes import smooth_volume

import clrecon
from clrecon.opencl.program import Kernel
from clrecon.operators.resident.device_volume import DeviceVolume


@pytest.fixture(scope="module")
def volume():
    """Smooth random HU in 22 slices of 26 x 45 voxels."""
    return smooth_volume((22, 26, 45))


@pytest.fixture(scope="module")
def labels(volume):
    """Labels 1 and 2 in two boxes of it, one above the other."""
    return label_boxes(volume, np.s_[3:12, 4:20, 5:30], np.s_[12:20, 4:20, 5:30])


AS_A_VOLUME = {
    "places": lambda v: (v.shape, v.spacing, v.bounds.tolist(), v.ijk_to_lps((1, 2, 3)).tolist()),
    "voxels": lambda v: (np.asarray(v).tobytes(), v[3:9, ::2].affine.tolist(), v[3:9].report),
    "crop": lambda v: (v.crop(between=v.bounds[:, 2] + (1, -2)).report, v.resample(3.0).voxels.tobytes()),
    "sampled": lambda v: v.sample(v.bounds.mean(axis=0)),
    "field of view": lambda v: clrecon.mask_field_of_view(v, 5.0).voxels.tobytes(),
    "table": lambda v: clrecon.remove_table(v).voxels.tobytes(),
    "filtered": lambda v: clrecon.filter_bilateral(v, sigma_hu=20.0).voxels.tobytes(),
    "image": lambda v: v.to_nibabel().to_bytes(),
}


@pytest.mark.first_device
@pytest.mark.parametrize("name", AS_A_VOLUME)
def test_a_kept_volume_is_a_volume_for_what_takes_one(name: str, volume, device) -> None:
    ask = AS_A_VOLUME[name]
    assert isinstance(DeviceVolume(volume, device=device), clrecon.Volume)
    assert ask(DeviceVolume(volume, device=device)) == ask(volume)  # type: ignore[no-untyped-call]


@pytest.mark.first_device
@pytest.mark.parametrize("library", ["sitk", "nibabel", "pyvista"])
def test_a_kept_volume_is_made_of_an_image_of_another_library(library: str, volume) -> None:
    pytest.importorskip({"sitk": "SimpleITK"}.get(library, library))
    image = getattr(clrecon.Volume(volume.voxels, np.diag([0.5, 1, 2, 1])), f"to_{library}")()
    made, plain = (getattr(kind, f"from_{library}")(image) for kind in (DeviceVolume, clrecon.Volume))
    assert isinstance(made, DeviceVolume)
    assert np.array_equal(made.affine, plain.affine)
    assert np.array_equal(made.voxels, volume.voxels)


@pytest.mark.first_device
def test_parts_of_a_kept_volume_are_kept_on_its_device(volume, device) -> None:
    part = DeviceVolume(volume, device=device, memory=2**28)[4:16]
    assert isinstance(part, DeviceVolume)
    assert (part.device, part.memory) == (device, 2**28)
    assert np.array_equal(
        clrecon.extract_isosurface(part, 100).vertices, clrecon.extract_isosurface(volume[4:16], 100).vertices
    )


@pytest.mark.first_device
def test_the_report_of_a_kept_volume_is_that_of_its_volume(volume, device) -> None:
    kept = DeviceVolume(volume, device=device)
    assert kept.report is volume.report
    part = kept[4:16]
    part.report = {"warnings": ["told"]}
    assert part.volume.report["warnings"] == ["told"]


@pytest.mark.first_device
def test_a_kept_volume_is_measured_and_saved_as_its_volume(volume, labels, device, tmp_path) -> None:
    kept = DeviceVolume(volume, device=device)
    ml_of_kept, ml = ([label.ml for label in clrecon.measure_labels(each, labels)] for each in (kept, volume))
    assert ml_of_kept == ml
    assert kept.save(tmp_path / "a.nii") == volume.save(tmp_path / "b.nii")


@pytest.mark.first_device
def test_a_kept_volume_of_a_kept_volume_holds_the_same_volume(volume, device) -> None:
    assert DeviceVolume(DeviceVolume(volume, device=device), device=device).volume is volume


@pytest.mark.first_device
def test_a_kept_volume_lists_the_names_of_a_volume_and_of_what_it_is_kept_with_alone(volume, device) -> None:
    kept = DeviceVolume(volume, device=device)
    assert repr(kept).startswith("DeviceVolume(Volume(45 x 26 x 22 ")
    own = {"close", "device", "memory", "uploaded_bytes", "values", "volume"}
    assert set(dir(kept)) == set(dir(clrecon.Volume)) | own
    assert not {"keep", "plan", "attempts", "upload"} & set(dir(kept))  # what clrecon's operators call


LEVELS = range(-200, 300, 50)


class CountedSurfaces:
    """Ten surfaces of new volumes, and of one that is kept; how often each kernel and each size of buffer was taken."""

    def __init__(self, volume, device, patch) -> None:
        kernels: list[str] = []
        order = Kernel.order

        def count_order(kernel, given):
            kernels.append(kernel.name)
            return order(kernel, given)

        clrecon.extract_isosurface(volume, 0, device=device)  # whose device may be checked at first use
        patch.setattr(Kernel, "order", count_order)
        sizes = Failing(patch, "buffer", first=0).sizes
        self.of_new = [clrecon.extract_isosurface(volume, level, device=device) for level in LEVELS]
        self.kernels_of_new, self.buffers_of_new = Counter(kernels), Counter(sizes)
        kernels.clear()
        sizes.clear()
        with DeviceVolume(volume, device=device) as kept:
            self.of_kept = [clrecon.extract_isosurface(kept, level) for level in LEVELS]
            self.uploaded_bytes = kept.uploaded_bytes
        self.kernels_of_kept, self.buffers_of_kept = Counter(kernels), Counter(sizes)


@pytest.fixture(scope="module")
def ten_surfaces(volume, device) -> CountedSurfaces:
    """Of levels from -200 to 250 HU."""
    with pytest.MonkeyPatch.context() as patch:
        return CountedSurfaces(volume, device, patch)


@pytest.mark.first_device
def test_ten_surfaces_of_a_kept_volume_are_those_of_new_ones(ten_surfaces):
    for kept, new in zip(ten_surfaces.of_kept, ten_surfaces.of_new, strict=True):
        assert np.array_equal(kept.vertices, new.vertices)


@pytest.mark.first_device
def test_ten_surfaces_of_a_kept_volume_upload_it_once(ten_surfaces, volume):
    assert ten_surfaces.uploaded_bytes == volume.voxels.nbytes


@pytest.mark.first_device
def test_bricks_of_a_kept_volume_are_measured_once_for_ten_surfaces_on_a_gpu(ten_surfaces, device):
    uses_bricks = device.kernel_variants["LANES"] == "1"  # from the second surface on
    assert ten_surfaces.kernels_of_kept["measure_bricks"] == int(uses_bricks)


@pytest.mark.first_device
def test_ten_surfaces_of_a_kept_volume_take_the_kernels_and_buffers_of_new_ones_except_nine_of_the_voxels(
    ten_surfaces, volume, device
):
    if device.kernel_variants["LANES"] == "1":
        pytest.skip("a GPU has kernels and buffers of bricks beside these")
    assert ten_surfaces.kernels_of_kept == ten_surfaces.kernels_of_new
    assert ten_surfaces.buffers_of_new - ten_surfaces.buffers_of_kept == {volume.voxels.nbytes: 9}
    assert not ten_surfaces.buffers_of_kept - ten_surfaces.buffers_of_new
