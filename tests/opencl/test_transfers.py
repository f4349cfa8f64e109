"""Transfers to devices with memory of their own, their buffers, and what a surface and a picture ask of the driver.

The device of the tests is treated as one whose memory is its own, as a graphics card's is, also where it works in
numpy's memory."""

from __future__ import annotations

import gc
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from counted_calls import counting_calls
from refusals import refused

import clrecon
from clrecon.errors import DeviceLostError
from clrecon.opencl import allocate, buffers, copy_buffer, download, download_all, upload
from clrecon.opencl.quirks import import_pyopencl
from clrecon.opencl.transfers import LEAST_BYTES, PIECE_BYTES, PIECES, PinnedPieces
from clrecon.operators.rays.scene import ScenePictures
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.rendering.pictures.styles import Projection, SlicesInSpace, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera


@pytest.fixture
def card(device, monkeypatch):
    """The device as a graphics card: its memory is its own."""
    if device.is_simulator:
        pytest.skip("simulators take the driver's way, which checks more")
    monkeypatch.setattr(device, "shares_host_memory", False)
    monkeypatch.setattr(device, "has_own_memory", True)
    return device


def make_ball(size):
    """A ball in a cube of `size` voxels a side, whose surface is at 0 HU."""
    axis = np.arange(size) - (size - 1) / 2
    distance = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
    voxels = np.rint(30.0 * (size * 0.35 - distance)).clip(-1000, 1500).astype(np.int16)
    return clrecon.Volume(voxels, np.diag((0.7, 0.5, 2.5, 1.0)))


def random_bytes(size, *, seed=0):
    return np.random.default_rng(seed).integers(0, 256, size).astype(np.uint8)


TRANSFER_SIZES = {
    "one byte": 1,
    "100 bytes": 100,
    "largest copied by the driver": LEAST_BYTES - 1,
    "smallest sent in pieces": LEAST_BYTES,
    "one piece": PIECE_BYTES,
    "one piece and a byte": PIECE_BYTES + 1,
    "more pieces than there are": (PIECES + 3) * PIECE_BYTES + 17,
}


@pytest.mark.every_device
@pytest.mark.parametrize("size", TRANSFER_SIZES.values(), ids=TRANSFER_SIZES)
def test_array_comes_back_from_a_card_unchanged(card, size):
    array = random_bytes(size)
    array_d = upload(card, array)
    assert np.array_equal(download(card, np.empty_like(array), array_d), array)


@pytest.mark.every_device
@pytest.mark.parametrize("size", TRANSFER_SIZES.values(), ids=TRANSFER_SIZES)
def test_last_two_thirds_of_an_array_are_read_from_a_card(card, size):
    array = random_bytes(size)
    start = size // 3
    tail = np.empty(size - start, np.uint8)
    assert np.array_equal(download(card, tail, upload(card, array), offset=start), array[start:])


@pytest.mark.parametrize("size", [1000, 3 * PIECE_BYTES])
def test_array_that_changes_after_its_upload_stays_as_it_was_on_the_card(card, size):
    array = random_bytes(size)
    before = array.copy()
    array_d = upload(card, array)
    array[:] = 0
    assert np.array_equal(download(card, np.empty_like(array), array_d), before)


def test_arrays_of_several_sizes_are_read_with_one_wait(card):
    arrays = [random_bytes(size, seed=seed) for seed, size in enumerate((10, LEAST_BYTES + 5, 0, 2 * PIECE_BYTES))]
    reads = [(np.empty_like(array), upload(card, array) if len(array) else None, 0) for array in arrays]
    with counting_calls() as counts:
        download_all(card, *reads)
    assert counts["blocking reads"] == 1
    for (read, _, _), array in zip(reads, arrays, strict=True):
        assert np.array_equal(read, array)


@pytest.mark.parametrize("count", [2, 5, 20])
def test_pinned_piece_is_not_filled_again_before_it_was_copied_to_its_array(card, monkeypatch, count):
    """Each transfer into a piece ends before the next begins, and copying out of it begins late."""
    cl = import_pyopencl()
    arrays = [random_bytes(LEAST_BYTES + 7 * n, seed=n) for n in range(count)]
    reads = [(np.empty_like(array), upload(card, array), 0) for array in arrays]
    enqueue_copy = cl.enqueue_copy

    def copy_and_wait(*arguments, **options):
        event = enqueue_copy(*arguments, **options)
        event.wait()
        return event

    monkeypatch.setattr(cl, "enqueue_copy", copy_and_wait)
    card.of_context(PinnedPieces)._pieces.clear()  # begin with none
    download_all(card, *reads)

    for (read, _, _), array in zip(reads, arrays, strict=True):
        assert np.array_equal(read, array)


def test_pinned_piece_is_not_filled_again_before_it_was_sent_to_the_card(card, monkeypatch):
    """Its copy ends at once, and is seen to have ended at every other look alone."""

    class CopySeenLate:
        def __init__(self):
            self.looks = 0

        def done(self):
            self.looks += 1
            return self.looks % 2 == 0

        def result(self):
            return None

    def copy_at_once(pool, copy, *arguments):
        copy(*arguments)
        return CopySeenLate()

    monkeypatch.setattr(ThreadPoolExecutor, "submit", copy_at_once)
    card.of_context(PinnedPieces)._pieces.clear()  # begin with none
    array = random_bytes(9 * PIECE_BYTES + 5)
    array_d = upload(card, array)
    assert np.array_equal(download(card, np.empty_like(array), array_d), array)


def test_arrays_that_six_threads_copy_on_a_card_at_once_come_back_unchanged(card):
    def copy_arrays(seed):
        rng = np.random.default_rng(seed)
        for _ in range(6):
            array = random_bytes(int(rng.integers(1000, 3 * LEAST_BYTES)), seed=seed)
            copy_d = allocate(card, array.nbytes)
            copy_buffer(card, upload(card, array), copy_d, array.nbytes)
            assert np.array_equal(download(card, np.empty_like(array), copy_d), array)

    with ThreadPoolExecutor(6) as threads:
        list(threads.map(copy_arrays, range(6)))  # raises what a thread raises


def test_buffer_pool_lends_different_buffers_at_the_same_time(card):
    pool = buffers.BufferPool(card)
    asked_bytes = 5000
    first, second = pool.take(asked_bytes), pool.take(asked_bytes)
    assert first.buffer.size >= asked_bytes
    assert first.buffer.int_ptr != second.buffer.int_ptr


def test_buffer_pool_lends_a_returned_buffer_again_for_fewer_bytes(card):
    pool = buffers.BufferPool(card)
    lent = pool.take(5000)
    number = lent.buffer.int_ptr
    del lent
    gc.collect()
    assert pool.take(4990).buffer.int_ptr == number


def test_buffer_pool_keeps_256_mib_of_384_mib_that_were_returned(card):
    pool = buffers.BufferPool(card)
    lent = [pool.take(64 << 20) for _ in range(6)]
    lent.clear()
    gc.collect()
    assert pool.spare_bytes == 256 << 20


def test_spare_buffers_are_released_when_the_driver_has_no_memory_left(card, monkeypatch):
    cl = import_pyopencl()
    pool = buffers.BufferPool(card)
    lent = pool.take(1 << 20)
    del lent
    gc.collect()
    ask_driver, refused_sizes = buffers.ask_driver, []

    def refuse_while_buffers_are_spare(device, flags, size, host):
        if pool.spare_bytes:
            refused_sizes.append(size)
            raise cl.MemoryError("create_buffer", cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE, "none left")
        return ask_driver(device, flags, size, host)

    monkeypatch.setattr(buffers, "ask_driver", refuse_while_buffers_are_spare)
    assert pool.take(2 << 20).buffer.size == 2 << 20
    assert refused_sizes == [2 << 20]


@pytest.mark.seconds
@pytest.mark.every_device
def test_surface_on_a_card_makes_no_more_calls_of_the_driver_than_counted_before(card, monkeypatch):
    """A discrete card spends most of a surface in waits and allocations: their numbers may only fall."""
    monkeypatch.setattr(card, "kernel_variants", {"LANES": "1", "WORDS_PER_ITEM": "1"})
    volume = make_ball(48)
    for _ in range(2):  # builds the kernels, then fills the pools
        mesh = clrecon.extract_isosurface(volume, 0.0, device=card)
    with counting_calls() as counts:
        clrecon.extract_isosurface(volume, 0.0, device=card)

    assert counts["launches"] == 10  # 6 to classify and count, list_words, list_output, emit_vertices, emit_triangles
    assert counts["blocking reads"] <= 2  # the totals, then the arrays
    assert counts["allocations"] <= 1
    assert counts["uploads"] <= 3  # the voxels, the frames of the slices, the steps of the grid
    tables = 8192  # measured 7264
    assert counts["uploads, bytes"] <= volume.voxels.nbytes + tables
    totals = 32  # measured 20
    arrays = mesh.vertices.nbytes + mesh.normals.nbytes + mesh.triangles.nbytes
    assert counts["blocking reads, bytes"] <= totals + arrays


@pytest.mark.parametrize("memory", [None, 32 << 20], ids=["whole", "in slabs"])
def test_samples_of_a_surface_on_a_card_are_marked_while_voxels_come(device, card, monkeypatch, memory):
    axis = np.arange(512, dtype=np.int16) - 256
    voxels = 200 - abs(axis[:, None]) - abs(axis) + 2 * np.arange(72, dtype=np.int16)[:, None, None]
    volume = clrecon.Volume(voxels, np.diag((0.7, 0.5, 2.5, 1.0)))
    assert volume.voxels.nbytes == 36 << 20  # two launches of the first pass for 16 MiB each, one for the rest

    def extract():
        mesh = clrecon.extract_isosurface(volume, 100.0, device=device, memory=memory)
        return mesh.report, b"".join(array.tobytes() for array in (mesh.vertices, mesh.normals, mesh.triangles))

    with counting_calls() as counts:
        report, mesh = extract()
    monkeypatch.setattr(card, "shares_host_memory", True)
    with counting_calls() as expected_counts:
        _, expected = extract()
    assert mesh == expected
    assert "classify_samples" in report["kernel_seconds"]
    if memory is None:
        assert counts["launches"] == expected_counts["launches"] + 2


@pytest.mark.seconds
@pytest.mark.every_device
@pytest.mark.parametrize(
    ("style", "launches", "uploads", "bytes_of_pixel"),
    [
        pytest.param(VolumeLook("bone"), 3, 3, 4, id="volume: colours"),
        pytest.param(Projection("mip"), 1, 1, 4, id="mip: HU"),
    ],
)  # enter_tiles, look_ahead and composite_rays; project_rays
def test_picture_on_a_card_makes_no_more_calls_of_the_driver_than_counted_before(
    card, style, launches, uploads, bytes_of_pixel
):
    with clrecon.VolumeRenderer(make_ball(48), device=card) as renderer:
        for angle in (0, 10):  # builds the kernels, then fills the pools
            renderer.render(style, view=(angle, 0), size=(64, 64))
        with counting_calls() as counts:
            renderer.render(style, view=(20, 0), size=(64, 64))

    assert (counts["launches"], counts["uploads"]) == (launches, uploads)
    assert counts["blocking reads"] == 1
    assert counts["allocations"] == 0
    assert counts["blocking reads, bytes"] == bytes_of_pixel * 64 * 64


STYLES = {
    "volume": VolumeLook("bone"),
    "surface": SurfaceLook(0.0),
    "mip": Projection("mip"),
    "slices in space": SlicesInSpace(),
}


@pytest.mark.seconds
@pytest.mark.parametrize("style", STYLES.values(), ids=STYLES)
def test_depths_that_are_asked_for_late_are_those_of_memory_of_the_host(device, card, monkeypatch, style):
    """Another picture is taken and drops its own before."""
    with clrecon.VolumeRenderer(make_ball(48), device=card) as renderer:
        picture = renderer.render(style, view=(30, 30), size=(64, 64)).annotated(letters=True)
        renderer.render(style, view=(120, 10), size=(64, 64))
        with counting_calls() as counts:
            depths = picture.depth, picture.expected_depth
    assert counts["blocking reads"] == 1
    monkeypatch.setattr(device, "shares_host_memory", True)
    expected = clrecon.render(make_ball(48), style, view=(30, 30), size=(64, 64), device=device)

    assert np.isfinite(expected.depth).any()
    assert depths[0].tobytes() == expected.depth.tobytes()
    assert depths[1].tobytes() == expected.expected_depth.tobytes()


def test_pickled_picture_of_a_card_has_its_depths(card):
    picture = clrecon.render(make_ball(48), "mip", size=(64, 64), device=card)
    received = pickle.loads(pickle.dumps(picture))
    assert np.array_equal(received.depth, picture.depth, equal_nan=True)


def test_card_holds_the_depths_of_kept_pictures_up_to_64_mib(card):
    with clrecon.VolumeRenderer(make_ball(48), device=card) as renderer:
        kept = [renderer.render("dvr", size=(1000, 1000)) for _ in range(10)]
    read = [not counted_reads(picture) for picture in kept]
    assert read == 2 * [True] + 8 * [False]  # 8 MB each


@pytest.mark.seconds
@pytest.mark.every_device
def test_later_picture_of_a_mesh_on_a_card_sends_no_triangles(card):
    mesh = clrecon.extract_isosurface(make_ball(48), 0.0, device=card)
    with ScenePictures([(mesh, MeshLook())], device=card) as pictures:
        first, later = (Camera.fit(pictures.box, view, size=(64, 64)) for view in ("anterior", "left"))
        pictures.take(first, (64, 64))
        with counting_calls() as counts:
            picture = pictures.take(later, (64, 64))
        card.give_up()  # a new context has none of the triangles
        again = pictures.take(later, (64, 64))
    expected = clrecon.render(mesh, camera=later, size=(64, 64), background="transparent", device=card)

    tables = 8192  # measured 4,636
    assert counts["uploads, bytes"] < tables < mesh.triangles.nbytes / 10
    assert picture.image.tobytes() == again.image.tobytes() == expected.image.tobytes()


def counted_reads(picture):
    with counting_calls() as counts:
        assert picture.depth.shape == (1000, 1000)
    return counts["blocking reads"]


def test_depths_of_a_card_that_failed_are_an_error_that_names_it(card):
    picture = clrecon.render(make_ball(48), "dvr", size=(64, 64), device=card)
    card.give_up()
    with refused(DeviceLostError, "depths"):
        _ = picture.depth


@pytest.mark.seconds
@pytest.mark.every_device
def test_surface_picture_and_cloud_are_the_same_bytes_with_memory_of_the_host_and_of_a_card(device, monkeypatch):
    if device.is_simulator:
        pytest.skip("simulators take the driver's way, which checks more")
    volume = make_ball(64)

    def results():
        mesh = clrecon.extract_isosurface(volume, 0.0, device=device)
        picture = clrecon.render(volume, "mip", size=(600, 600), device=device)
        cloud = clrecon.extract_points(volume, hu=(0.0, None), device=device)
        return mesh.vertices, mesh.normals, mesh.triangles, picture.image, picture.values, cloud.points, cloud.hu

    with_memory_of_the_host = results()
    monkeypatch.setattr(device, "shares_host_memory", False)
    with_memory_of_a_card = results()

    for array, expected in zip(with_memory_of_a_card, with_memory_of_the_host, strict=True):
        assert array.tobytes() == expected.tobytes()
