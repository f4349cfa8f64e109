"""Built programs in the cache folder: found again, never trusted blindly, never in the way."""

from __future__ import annotations

import os

import numpy as np
import pytest

from clrecon.errors import DeviceError
from clrecon.opencl import binaries, program, quirks
from clrecon.opencl.binaries import binary_key, read_binary, store_binary
from clrecon.opencl.program import load_program
from clrecon.opencl.sources import read_kernel_source

KEY = binary_key("device", "source")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "clrecon" / "kernels"


@pytest.fixture(autouse=True)
def as_for_users(request, monkeypatch):
    """Binaries are kept: `find_devices` of the conftest turns that off for all other tests."""
    if "device" in request.fixturenames:
        device = request.getfixturevalue("device")
        monkeypatch.setattr(device, "keeps_binaries", quirks.is_slow_from_its_cache(device.platform))


def test_what_was_stored_is_read(own_cache):
    assert read_binary(KEY) is None
    store_binary(KEY, b"program")
    assert read_binary(KEY) == b"program"
    assert own_cache.stat().st_mode & 0o777 == 0o700
    assert [path.name for path in own_cache.iterdir()] == [KEY]


def test_keys_tell_apart_what_is_joined_differently():
    assert len({binary_key("ab", "c"), binary_key("a", "bc"), binary_key("abc"), binary_key("ab", "c", "")}) == 4


@pytest.mark.parametrize("damage", [lambda c: c[:-1], lambda c: c[:30], lambda c: b"", lambda c: c[:-1] + b"x"])
def test_a_damaged_file_is_not_trusted(own_cache, damage):
    store_binary(KEY, b"program")
    (own_cache / KEY).write_bytes(damage((own_cache / KEY).read_bytes()))
    assert read_binary(KEY) is None


def test_a_folder_that_others_can_write_to_is_not_trusted(own_cache):
    store_binary(KEY, b"program")
    own_cache.chmod(0o770)
    assert read_binary(KEY) is None
    store_binary(binary_key("other"), b"program")
    assert len(list(own_cache.iterdir())) == 1


def test_a_folder_that_cannot_be_made_is_no_error(own_cache):
    own_cache.parent.write_text("a file where the folder should be")
    store_binary(KEY, b"program")
    assert read_binary(KEY) is None


def test_the_oldest_go(own_cache, monkeypatch):
    monkeypatch.setattr(binaries, "_MOST_FILES", 3)
    for number in range(5):
        store_binary(binary_key(str(number)), b"program")
        os.utime(own_cache / binary_key(str(number)), (number, number))
    store_binary(binary_key("5"), b"program")
    assert [read_binary(binary_key(str(number))) is None for number in range(6)] == [
        True,
        True,
        True,
        False,
        False,
        False,
    ]


def test_the_next_process_takes_the_binary(device, monkeypatch):
    """Building from source once; then, with no program in memory, from the binary where the driver is slow."""
    sources = []
    true_way = program._build_from_source
    monkeypatch.setattr(program, "_build_from_source", lambda *a: sources.append(1) or true_way(*a))
    for _ in range(3):
        monkeypatch.setattr(device, "programs", {})
        assert load_program(device, "primitives/compact.cl").kernel_names == ["count_set_bits", "list_set_bits"]
    assert len(sources) == (1 if device.keeps_binaries else 3)


def test_binaries_compute_what_sources_do(device, monkeypatch):
    from clrecon.opencl import upload
    from clrecon.operators.primitives.compact import compact

    mask = np.random.default_rng(0).integers(0, 2**32, 1000, dtype=np.uint32)
    for _ in range(2):
        monkeypatch.setattr(device, "programs", {})
        assert compact(device, upload(device, mask), 1000).count == int(np.unpackbits(mask.view(np.uint8)).sum())


def test_a_binary_that_the_driver_refuses_is_built_from_source(device, monkeypatch):
    if not device.keeps_binaries:
        pytest.skip("this driver's own cache is fast")
    options = ()
    store_binary(program._key(device, read_kernel_source("primitives/compact.cl"), options), b"no program at all")
    monkeypatch.setattr(device, "programs", {})
    assert load_program(device, "primitives/compact.cl").kernel_names == ["count_set_bits", "list_set_bits"]


def test_a_program_without_kernels_is_an_error(device, monkeypatch):
    monkeypatch.setattr(program.Program, "kernel_names", [])
    monkeypatch.setattr(device, "programs", {})
    with pytest.raises(DeviceError, match="has no kernel"):
        load_program(device, "primitives/compact.cl")
