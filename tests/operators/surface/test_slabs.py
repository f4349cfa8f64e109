"""Volumes that do not fit: in slabs, with the same mesh bit for bit, or refused with the numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import refused
from slab_surfaces import assert_same, extract_in_slabs
from surface_volumes import MIRRORED, OBLIQUE, random_volume, smooth_volume

from clrecon.errors import DeviceError, DeviceMemoryError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.opencl import download, upload
from clrecon.operators.resident import device_volume
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface import extraction, marching_cubes
from clrecon.operators.surface import marching_cubes as cells
from clrecon.operators.surface.extract import SurfaceExtractor, extract_isosurface
from clrecon.operators.surface.slabs import SampleGrid, Slab, plan_slabs


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("dtype", ["int16", "uint8", "float32"])
@pytest.mark.parametrize("shape", [(9, 7, 40), (2, 3, 70), (20, 9, 33)])
@pytest.mark.parametrize("slices", [1, 2, 3, 5])
def test_slabs_of_one_to_five_slices_give_the_same_mesh(device, shape, dtype, closed, slices):
    volume = random_volume(shape, dtype=dtype, affine=MIRRORED if dtype == "uint8" else OBLIQUE)
    mesh = extract_in_slabs(volume, 3, device, slices=slices, closed=closed)
    with_border = shape[0] + 2 * closed
    assert mesh.report["slabs"] == -(-with_border // slices)
    assert_same(mesh, extract_isosurface(volume, 3, device=device, closed=closed))


def test_a_single_slice_in_slabs_of_one_gives_the_same_mesh(device):
    volume = random_volume((1, 6, 40))
    mesh = extract_in_slabs(volume, 3, device, slices=1)
    assert mesh.report["slabs"] == 1 + 2  # with a border at both ends
    assert_same(mesh, extract_isosurface(volume, 3, device=device))


def test_a_resident_volume_gives_the_same_surfaces_in_slabs_and_as_a_whole_in_turn(device, monkeypatch):
    volume = smooth_volume((23, 27, 45))
    with SurfaceExtractor(volume, device=device) as extractor:
        whole = extractor.extract(100, closed=False)
        with monkeypatch.context() as less_memory:
            less_memory.setattr(extraction, "plan_slabs", lambda *_: 4)  # slices a slab
            in_slabs = extractor.extract(100)
        whole_again = extractor.extract(100, closed=False)

    slabs_of_25_slices = 7  # 23, and the border of a closed surface, four a slab
    assert [mesh.report["slabs"] for mesh in (whole, in_slabs, whole_again)] == [1, slabs_of_25_slices, 1]
    assert_same(in_slabs, extract_isosurface(volume, 100, device=device))
    expected = extract_isosurface(volume, 100, device=device, closed=False)
    assert_same(whole, expected)
    assert_same(whole_again, expected)


@pytest.mark.parametrize(("slices", "read"), [(1, 4), (3, 6), (20, 20), (22, 20)])
def test_a_slab_in_the_middle_needs_its_voxels_with_one_slice_before_and_two_behind_and_room_for_a_mesh(slices, read):
    """Of 20 slices with a border, as far as there are; the whole volume needs no room beside its own mesh."""
    volume, most_bytes = smooth_volume((20, 6, 33)), 900
    asked: dict[str, Any] = {}
    limits = SimpleNamespace(total_bytes=8000, buffer_bytes=most_bytes)
    resident = SimpleNamespace(
        limits=limits, plan=lambda kind, gk, needs, **more: asked.update(more, gk=gk, needs=needs) or 7
    )
    assert plan_slabs(SampleGrid(volume, choose_iso_rule(volume, 100)), resident) == 7
    assert (asked["gk"], asked["most"]) == (20 + 2, None)
    needs = asked["needs"](slices)
    assert needs["volume"] == read * 6 * 33 * 2
    assert needs.get("mesh") == (None if slices == 22 else most_bytes)


def test_report_of_a_surface_has_the_bytes_of_volume_mesh_and_scratch(device):
    volume = smooth_volume((9, 10, 33))
    mesh = extract_isosurface(volume, 100, device=device)
    taken = mesh.report["device_bytes"]
    assert taken["volume"] == 9 * 10 * 33 * 2
    assert taken["output"] == 2 * 3 * 4 * len(mesh.vertices) + 3 * 4 * len(mesh.triangles)
    scratch = Slab(SampleGrid(volume, choose_iso_rule(volume, 100)), 0, 9 + 2).scratch()
    active = scratch.pop("active words")  # as many as there may be: only those that are crossed are taken
    assert 0 < taken["scratch"] - sum(scratch.values()) <= active


@pytest.mark.parametrize("more", [{}, {"closed": False}, {"below": True}, {"closed": False, "below": True}])
def test_vertices_alone_are_those_of_the_mesh(device, more):
    """At -400 HU much of the border is inside, where it is closed, and other vertices enclose what is below."""
    with SurfaceExtractor(smooth_volume((9, 10, 11)), device=device) as extractor:
        mesh, cloud = extractor.extract(-400, **more), extractor.extract_vertices(-400, **more)
    assert np.array_equal(cloud.points, mesh.vertices)
    assert np.array_equal(cloud.normals, mesh.normals)


BUILDING = [("build", 0, 1), ("build", 1, 1)]


def progress_of_surface(device):
    """Of a volume of 23 slices, with one beyond it at each end."""
    told: list[tuple[str, int, int]] = []
    volume = smooth_volume((23, 9, 10))
    extract_isosurface(volume, 100, device=device, progress=lambda *step: told.append(step))
    return told


def test_progress_of_a_surface_of_one_slab_tells_building_alone(device):
    assert progress_of_surface(device) == BUILDING


def test_progress_of_a_surface_in_slabs_tells_building_and_the_slices_that_are_done(device, monkeypatch):
    monkeypatch.setattr(extraction, "plan_slabs", lambda *_: 10)
    assert progress_of_surface(device) == [*BUILDING, ("slabs", 10, 25), ("slabs", 20, 25), ("slabs", 25, 25)]


def test_slabs_without_a_surface_between_others_give_the_same_mesh(device):
    voxels = np.zeros((30, 8, 40), np.int16)
    voxels[3:6, 2:5, 5:9] = voxels[20:24, 3:6, 20:36] = 100
    volume = Volume(voxels, OBLIQUE)
    mesh = extract_in_slabs(volume, 50, device, slices=4)
    assert mesh.report["slabs"] == (30 + 2) // 4
    assert_same(mesh, extract_isosurface(volume, 50, device=device))


@pytest.mark.every_device
def test_a_volume_beyond_the_memory_allowed_goes_through_in_slabs_within_it(device):
    volume = smooth_volume((40, 60, 70))
    expected = extract_isosurface(volume, 100, device=device)
    memory = volume.voxels.nbytes * 3 // 5
    mesh = extract_isosurface(volume, 100, device=device, memory=memory)
    assert mesh.report["slabs"] > 2  # that has to hold the voxels and all else; measured 21, and 42 with lists of GPUs
    assert sum(mesh.report["device_bytes"].values()) <= memory
    assert_same(mesh, expected)


def test_a_volume_beyond_the_largest_buffer_of_the_device_goes_through_in_slabs(device, monkeypatch):
    volume = smooth_volume((40, 60, 70))
    expected = extract_isosurface(volume, 100, device=device)
    monkeypatch.setattr(device, "max_allocation_bytes", volume.voxels.nbytes // 3)
    mesh = extract_isosurface(volume, 100, device=device)
    assert mesh.report["slabs"] >= 3  # a buffer holds a third of the voxels; slabs share slices: measured 14
    assert_same(mesh, expected)


def test_forecast_of_a_surface_has_the_slabs_and_bytes_that_it_then_takes(device):
    k, j, i = np.indices((40, 60, 70))
    volume = Volume((1000 - 100 * np.hypot(np.hypot(k - 20, j - 30), i - 35)).astype(np.int16), OBLIQUE)
    with SurfaceExtractor(volume, device=device, memory=volume.voxels.nbytes // 2) as extractor:
        forecast = extractor.forecast()
        mesh = extractor.extract(700)
    assert forecast["slabs"] > 1
    assert forecast["slabs"] == mesh.report["slabs"]
    taken = mesh.report["device_bytes"]
    assert forecast["volume_bytes"] <= taken["volume"]  # the first slab has no neighbour before it
    assert taken["scratch"] <= 1.3 * forecast["scratch_bytes"]  # one slice more of the mask; measured 0.8 of it


def test_memory_for_less_than_a_slice_is_refused_before_anything_is_allocated(device, monkeypatch):
    monkeypatch.setattr(device_volume.ocl, "upload", lambda *_: pytest.fail("allocated"))
    with refused(DeviceError, 10000, "room"):
        extract_isosurface(smooth_volume((40, 60, 70)), 100, device=device, memory=10_000)


@pytest.mark.parametrize("slices", [2, 3, 5])
def test_memory_for_less_than_a_slice_is_refused_with_the_bytes_of_one_with_its_neighbours(device, slices):
    """Of an open surface of 33 x 6 samples in a slice: a slice in the middle, or the last of two."""
    volume = smooth_volume((slices, 6, 33))
    read = {2: 2, 3: 2, 5: 4}[slices]  # one before, two behind, where there are so many
    classified, counted = {2: (1, 1), 3: (1, 1), 5: (3, 2)}[slices]
    rows, words = 6, 2 * 6  # two words hold the 33 samples of a row
    masks, extents = 4 * words * classified, 4 * rows * classified
    counts, flags = (4 * words + 3 * 4 * rows) * counted, 4 * rows * counted
    active = 4 * words
    needed = volume.voxels.itemsize * rows * 33 * read + masks + extents + counts + flags + active
    with refused(DeviceError, needed):
        extract_isosurface(volume, 100, device=device, memory=100, closed=False)


@pytest.mark.parametrize("memory", [0, -1, 1.5, "2", True])
def test_memory_that_is_no_positive_number_of_bytes_is_refused(device, memory):
    with refused(UsageError, "number"):
        extract_isosurface(smooth_volume(), 100, device=device, memory=memory)


def test_a_mesh_beyond_the_memory_allowed_is_made_in_smaller_slabs_with_a_warning(device):
    """A noisy volume: what is planned for does not hold the mesh of so many slices."""
    volume = random_volume((24, 40, 64), high=2)
    grid = SampleGrid(volume, choose_iso_rule(volume, 1))
    memory = 4 * sum(Slab(grid, first=0, end=24).needs().values())
    mesh = extract_isosurface(volume, 1, device=device, memory=memory)
    assert mesh.report["slabs"] > 1
    assert any("continued with slabs of" in warning for warning in mesh.report["warnings"])
    assert_same(mesh, extract_isosurface(volume, 1, device=device))


@pytest.mark.parametrize("fails", [1, 2, 5])
def test_memory_that_runs_out_late_halves_the_slab_with_a_warning_and_gives_the_same_mesh(device, monkeypatch, fails):
    """The driver says at the n-th allocation that there is no more: smaller slabs, a warning, the same mesh."""
    volume = smooth_volume((24, 30, 40))
    expected = extract_isosurface(volume, 100, device=device)
    true_allocate, calls = marching_cubes.ocl.allocate, []

    def allocate(*arguments):
        calls.append(1)
        if len(calls) == fails:
            raise DeviceMemoryError("no room for 1 byte")
        return true_allocate(*arguments)

    monkeypatch.setattr(marching_cubes.ocl, "allocate", allocate)
    mesh = extract_isosurface(volume, 100, device=device)
    assert mesh.report["slabs"] == 2
    half = (24 + 2) // 2  # with the border at both ends
    assert mesh.report["warnings"][-1] == f"no room for 1 byte: continued with slabs of {half} slices"
    assert_same(mesh, expected)


def test_memory_that_runs_out_for_every_slab_is_refused(device, monkeypatch):
    def allocate(*_):
        raise DeviceMemoryError("no room for 1 byte")

    monkeypatch.setattr(marching_cubes.ocl, "allocate", allocate)
    with refused(DeviceError, 1, "room"):
        extract_isosurface(smooth_volume((9, 10, 11)), 100, device=device)


def test_a_slab_with_counts_over_32_bits_is_refused(device, monkeypatch):
    true_scan = cells.enqueue_scan

    def scan(*arguments, **options):
        total_d = true_scan(*arguments, **options)
        return upload(device, download(device, np.empty(1, np.uint64), total_d) + np.uint64(2**32))

    monkeypatch.setattr(cells, "enqueue_scan", scan)
    with refused(DeviceError, 32, "bits"):
        extract_isosurface(random_volume((5, 6, 7)), 3, device=device)


def test_slabs_whose_vertices_together_exceed_32_bits_are_refused(device, monkeypatch):
    """Each slab has few; the sum is refused, as soon as it is reached."""
    true_run = marching_cubes.Emission.run

    class Long:
        def __init__(self, array):
            self.array = array

        def __len__(self):
            return 2**31

    def run(*arguments):
        return tuple(Long(array) for array in true_run(*arguments))

    monkeypatch.setattr(marching_cubes.Emission, "run", run)
    with refused(DeviceError, 2**32, "vertices"):
        extract_in_slabs(random_volume((9, 6, 7)), 3, device, slices=3)


def test_slabs_have_as_many_slices_as_have_fewer_than_2_to_the_32_words(device):
    all_slices, too_many_words = 2**16, 2**32

    class Tall:
        shape_ijk = (40, 2**12, all_slices)
        voxels = np.zeros((1, 1, 1), np.int16)

    class Huge:
        label, usable_bytes, max_allocation_bytes = "a large device", 2**45, 2**44
        context = None

    volume = random_volume((2, 2, 2))
    grid = SampleGrid(Tall(), choose_iso_rule(volume, 3))
    resident: Any = DeviceVolume(volume, device=device)
    resident.device = Huge()
    slices = plan_slabs(grid, resident)
    assert 1 < slices < all_slices
    assert Slab(grid, first=2, end=2 + slices).mask_rows << grid.row_shift < too_many_words
    assert Slab(grid, first=2, end=3 + slices).mask_rows << grid.row_shift >= too_many_words


@pytest.mark.every_device
def test_a_memory_mapped_file_in_slabs_gives_the_same_mesh(device, tmp_path):
    volume = smooth_volume((23, 64, 128))
    np.save(tmp_path / "voxels.npy", volume.voxels)
    mapped = Volume(np.load(tmp_path / "voxels.npy", mmap_mode="r"), volume.affine)
    mesh = extract_in_slabs(mapped, 100, device, slices=5)
    assert mesh.report["slabs"] == (23 + 2) // 5
    assert_same(mesh, extract_isosurface(volume, 100, device=device))


@pytest.mark.oclgrind
@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("slices", [1, 2])
def test_slabs_of_a_small_volume_give_the_same_mesh(device, closed, slices):
    volume = random_volume((5, 4, 40))
    expected = extract_isosurface(volume, 3, device=device, closed=closed)
    mesh = extract_in_slabs(volume, 3, device, slices=slices, closed=closed)
    assert mesh.report["slabs"] > 1
    assert_same(mesh, expected)
