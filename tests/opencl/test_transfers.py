"""Transfers to devices with memory of their own, their buffers, and what a surface and a picture ask of the driver.

Devices that work in numpy's memory are told that they do not: the way of a graphics card is then taken on any."""

from __future__ import annotations

import gc
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from counted_calls import counting_calls

import clrecon
from clrecon.opencl import allocate, buffers, copy_buffer, download, download_all, upload
from clrecon.opencl.quirks import import_pyopencl
from clrecon.opencl.transfers import LEAST_BYTES, PIECE_BYTES, PIECES, PinnedPieces
from clrecon.rendering.pictures.styles import Projection, VolumeLook


@pytest.fixture
def apart(device, monkeypatch):
    """A device whose memory is its own."""
    if device.is_simulator:
        pytest.skip("simulators take the driver's way, which checks more")
    monkeypatch.setattr(device, "shares_host_memory", False)
    monkeypatch.setattr(device, "has_own_memory", True)
    return device


def make_ball(size):
    axis = np.arange(size) - (size - 1) / 2
    distance = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
    voxels = np.rint(30.0 * (size * 0.35 - distance)).clip(-1000, 1500).astype(np.int16)
    return clrecon.Volume(voxels, np.diag((0.7, 0.5, 2.5, 1.0)))


def numbers(size, seed=0):
    return np.random.default_rng(seed).integers(0, 256, size).astype(np.uint8)


@pytest.mark.every_device
@pytest.mark.parametrize(
    "size", [1, 100, LEAST_BYTES - 1, LEAST_BYTES, PIECE_BYTES, PIECE_BYTES + 1, (PIECES + 3) * PIECE_BYTES + 17]
)
def test_arrays_come_back_from_the_device_unchanged(apart, size):
    array = numbers(size)
    array_d = upload(apart, array)
    assert np.array_equal(download(apart, np.empty_like(array), array_d), array)
    tail = np.empty(size - size // 3, np.uint8)
    assert np.array_equal(download(apart, tail, array_d, size // 3), array[size // 3 :])


@pytest.mark.parametrize("size", [1000, 3 * PIECE_BYTES])
def test_an_array_may_change_after_its_upload(apart, size):
    array = numbers(size)
    kept = array.copy()
    array_d = upload(apart, array)
    array[:] = 0
    assert np.array_equal(download(apart, np.empty_like(array), array_d), kept)


def test_several_arrays_are_read_at_once(apart):
    arrays = [numbers(size, seed) for seed, size in enumerate((10, LEAST_BYTES + 5, 0, 2 * PIECE_BYTES))]
    wanted = [(np.empty_like(array), upload(apart, array) if len(array) else None, 0) for array in arrays]
    with counting_calls() as counts:
        download_all(apart, *wanted)
    assert counts["blocking reads"] == 1
    for (read, _, _), array in zip(wanted, arrays, strict=True):
        assert np.array_equal(read, array)


@pytest.mark.parametrize("count", [2, 5, 20])
def test_a_piece_is_used_again_only_when_it_was_emptied(apart, monkeypatch, count):
    """Each transfer ends before the next one begins, and copying out begins late: what is in a piece has to stay."""
    cl = import_pyopencl()
    arrays = [numbers(LEAST_BYTES + 7 * n, n) for n in range(count)]
    there = [upload(apart, array) for array in arrays]
    copy = cl.enqueue_copy

    def copy_and_wait(*arguments, **options):
        event = copy(*arguments, **options)
        event.wait()
        return event

    monkeypatch.setattr(cl, "enqueue_copy", copy_and_wait)
    apart.of_context(PinnedPieces)._pieces.clear()
    wanted = [(np.empty_like(array), array_d, 0) for array, array_d in zip(arrays, there, strict=True)]
    download_all(apart, *wanted)
    for (read, _, _), array in zip(wanted, arrays, strict=True):
        assert np.array_equal(read, array)


def test_a_piece_that_is_filled_stays_until_it_is_sent(apart, monkeypatch):
    """Threads end as soon as nobody looks: a piece that is full is not filled again before it is sent."""

    class Hidden:
        """A copy that has ended, which is seen at every other look alone."""

        def __init__(self):
            self.looks = 0

        def done(self):
            self.looks += 1
            return self.looks % 2 == 0

        def result(self):
            return None

    def copy_at_once(pool, copy, *arguments):
        copy(*arguments)
        return Hidden()

    monkeypatch.setattr(ThreadPoolExecutor, "submit", copy_at_once)
    apart.of_context(PinnedPieces)._pieces.clear()
    array = numbers(9 * PIECE_BYTES + 5)
    array_d = upload(apart, array)
    assert np.array_equal(download(apart, np.empty_like(array), array_d), array)


def test_threads_share_the_pieces_and_the_pool(apart):
    wrong: list[object] = []

    def work(seed):
        rng = np.random.default_rng(seed)
        for turn in range(6):
            array = numbers(int(rng.integers(1000, 3 * LEAST_BYTES)), seed)
            copy_d = allocate(apart, array.nbytes)
            copy_buffer(apart, upload(apart, array), copy_d, array.nbytes)
            if not np.array_equal(download(apart, np.empty_like(array), copy_d), array):
                wrong.append((seed, turn))

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_the_pool_lends_a_buffer_again(apart):
    pool = buffers.BufferPool(apart)
    one = pool.take(5000)
    number = one.buffer.int_ptr
    other = pool.take(5000)
    assert other.buffer.int_ptr != number
    assert one.buffer.size >= 5000
    del one
    gc.collect()
    assert pool.take(4990).buffer.int_ptr == number


def test_the_pool_keeps_no_more_than_its_limit(apart):
    pool = buffers.BufferPool(apart)
    lent = [pool.take(1 << 26) for _ in range(6)]
    lent.clear()
    gc.collect()
    assert pool.spare_bytes == 1 << 28


def test_spare_buffers_make_way_where_the_driver_has_no_room(apart, monkeypatch):
    cl = import_pyopencl()
    pool = buffers.BufferPool(apart)
    lent = pool.take(1 << 20)
    del lent
    gc.collect()
    ask, refused = buffers.ask_driver, []

    def ask_once_more(device, flags, size, host):
        if pool.spare_bytes:
            refused.append(size)
            raise cl.MemoryError("create_buffer", cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE, "none left")
        return ask(device, flags, size, host)

    monkeypatch.setattr(buffers, "ask_driver", ask_once_more)
    assert pool.take(2 << 20).buffer.size == 2 << 20
    assert refused == [2 << 20]


@pytest.mark.seconds
@pytest.mark.every_device
def test_surface_and_picture_ask_no_more_calls_of_the_driver(apart):
    """A discrete card spends most of a surface in waits and allocations: their numbers may only fall."""
    volume = make_ball(48)
    for _ in range(2):
        mesh = clrecon.extract_isosurface(volume, 0.0, device=apart)
    with counting_calls() as counts:
        again = clrecon.extract_isosurface(volume, 0.0, device=apart)
    assert np.array_equal(again.vertices, mesh.vertices)
    assert counts["launches"] == 9
    assert counts["blocking reads"] <= 2 and counts["allocations"] <= 1 and counts["uploads"] <= 3
    assert counts["uploads, bytes"] <= volume.voxels.nbytes + 8192
    totals, arrays = 32, mesh.vertices.nbytes + mesh.normals.nbytes + mesh.triangles.nbytes
    assert counts["blocking reads, bytes"] <= arrays + totals
    with clrecon.VolumeRenderer(volume, device=apart) as renderer:
        for angle in (0, 10):
            renderer.render(VolumeLook("bone"), view=(angle, 0), size=(64, 64))
        with counting_calls() as counts:
            renderer.render(VolumeLook("bone"), view=(20, 0), size=(64, 64))
        with counting_calls() as of_projection:
            renderer.render(Projection("mip"), view=(20, 0), size=(64, 64))
    assert counts["launches"] == 3 and counts["blocking reads"] == 1 and counts["allocations"] == 0
    assert counts["blocking reads, bytes"] == 12 * 64 * 64 and of_projection["blocking reads, bytes"] == 8 * 64 * 64


@pytest.mark.seconds
@pytest.mark.every_device
def test_memory_of_its_own_changes_no_bit(device, monkeypatch):
    if device.is_simulator:
        pytest.skip("simulators take the driver's way, which checks more")
    volume = make_ball(64)

    def results():
        mesh = clrecon.extract_isosurface(volume, 0.0, device=device)
        picture = clrecon.render(volume, "mip", size=(600, 600), device=device)
        cloud = clrecon.extract_points(volume, hu=(0.0, None), device=device)
        return mesh.vertices, mesh.normals, mesh.triangles, picture.image, picture.values, cloud.points, cloud.hu

    shared = results()
    monkeypatch.setattr(device, "shares_host_memory", False)
    for one, other in zip(shared, results(), strict=True):
        assert one.tobytes() == other.tobytes()
