"""Built programs in the cache folder: found again, never trusted blindly, never in the way."""

from __future__ import annotations

import os

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl import cache, program, quirks
from clrecon.opencl.cache import binary_key, make_private, prepare_caches, read_binary, store_binary
from clrecon.opencl.program import load_program
from clrecon.opencl.sources import read_kernel_source

KEY = binary_key("device", "source")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    folder = tmp_path / "kernels"
    make_private(folder)
    caches = prepare_caches()._replace(binaries=folder)
    monkeypatch.setattr(cache, "prepare_caches", lambda: caches)
    return folder


@pytest.fixture
def keeper(device, monkeypatch):
    """A device whose driver keeps nothing: PoCL, whose binaries clrecon then keeps."""
    if not quirks.is_pocl(device.platform):
        pytest.skip("no driver here that gives and takes binaries")
    monkeypatch.setattr(device, "keeps_binaries", True)
    return device


def test_stored_binary_is_read_back(own_cache):
    assert read_binary(KEY) is None
    store_binary(KEY, b"program")
    assert read_binary(KEY) == b"program"
    assert [path.name for path in own_cache.iterdir()] == [KEY]


def test_keys_tell_apart_what_is_joined_differently():
    assert len({binary_key("ab", "c"), binary_key("a", "bc"), binary_key("abc"), binary_key("ab", "c", "")}) == 4


@pytest.mark.parametrize("damage", [lambda c: c[:-1], lambda c: c[:30], lambda c: b"", lambda c: c[:-1] + b"x"])
def test_a_damaged_file_is_not_trusted(own_cache, damage):
    store_binary(KEY, b"program")
    (own_cache / KEY).write_bytes(damage((own_cache / KEY).read_bytes()))
    assert read_binary(KEY) is None


@pytest.mark.fault_row(59)
def test_a_binary_in_the_place_of_another_is_not_trusted(own_cache):
    """Whole, with a hash that is right, but of another source, device or driver."""
    other = binary_key("other device", "source")
    store_binary(other, b"program")
    (own_cache / other).rename(own_cache / KEY)
    assert read_binary(KEY) is None
    store_binary(KEY, b"program")
    assert read_binary(KEY) == b"program"


def test_without_a_folder_nothing_is_kept(own_cache, monkeypatch):
    caches = prepare_caches()._replace(binaries=None)
    monkeypatch.setattr(cache, "prepare_caches", lambda: caches)
    store_binary(KEY, b"program")
    assert read_binary(KEY) is None and not list(own_cache.iterdir())


def test_a_folder_that_vanished_is_no_error(own_cache):
    own_cache.rmdir()
    store_binary(KEY, b"program")
    assert read_binary(KEY) is None


@pytest.mark.fault_row(72)
def test_files_are_private_whatever_the_umask(own_cache):
    before = os.umask(0)
    try:
        store_binary(KEY, b"program")
    finally:
        os.umask(before)
    assert (own_cache / KEY).stat().st_mode & 0o777 == 0o600


def test_oldest_binaries_are_removed_beyond_512(own_cache):
    for number in range(512):
        (own_cache / f"{number:03}").touch()
        os.utime(own_cache / f"{number:03}", (number, number))
    for number in range(2):
        store_binary(binary_key(str(number)), b"program")
    assert len(list(own_cache.iterdir())) == 512
    assert [(own_cache / f"{number:03}").exists() for number in range(4)] == [False, False, True, True]
    assert all(read_binary(binary_key(str(number))) == b"program" for number in range(2))


def test_the_next_process_takes_the_binary(keeper, monkeypatch):
    """What is built from source is stored: once; then, with no program in memory, the binary is taken."""
    stored = []
    monkeypatch.setattr(program, "store_binary", lambda *kept: stored.append(kept) or store_binary(*kept))
    for _ in range(3):
        monkeypatch.setattr(keeper, "programs", {})
        assert load_program(keeper, "primitives/compact.cl").kernel_names == ["count_set_bits", "list_set_bits"]
    assert len(stored) == 1


def test_binaries_compute_what_sources_do(keeper, monkeypatch):
    from clrecon.opencl import upload
    from clrecon.operators.primitives.scan import compact

    mask = np.random.default_rng(0).integers(0, 2**32, 1000, dtype=np.uint32)
    for _ in range(2):
        monkeypatch.setattr(keeper, "programs", {})
        assert compact(keeper, upload(keeper, mask), 1000).count == int(np.unpackbits(mask.view(np.uint8)).sum())


def test_a_binary_that_the_driver_refuses_is_built_from_source(keeper, monkeypatch):
    options = ()
    store_binary(program._key(keeper, read_kernel_source("primitives/compact.cl"), options), b"no program at all")
    monkeypatch.setattr(keeper, "programs", {})
    assert load_program(keeper, "primitives/compact.cl").kernel_names == ["count_set_bits", "list_set_bits"]


def test_a_program_without_kernels_is_an_error(keeper, monkeypatch):
    monkeypatch.setattr(program.Program, "kernel_names", [])
    monkeypatch.setattr(keeper, "programs", {})
    with refused(DeviceError, "kernel", "compact.cl"):
        load_program(keeper, "primitives/compact.cl")
