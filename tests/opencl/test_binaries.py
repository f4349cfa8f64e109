"""Built programs (binaries) in the cache folder: stored once, loaded by later processes, and checked before use."""

from __future__ import annotations

import os

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl import cache, program, quirks
from clrecon.opencl.cache import binary_key, make_private, prepare_caches, read_binary, store_binary
from clrecon.opencl.program import load_program

KEY = binary_key("device", "source")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """The folder of binaries of one test, empty."""
    folder = tmp_path / "kernels"
    make_private(folder)
    caches = prepare_caches()._replace(binaries=folder)
    monkeypatch.setattr(cache, "prepare_caches", lambda: caches)
    return folder


@pytest.fixture
def keeping_pocl(device, monkeypatch):
    """A device whose driver keeps nothing: PoCL, whose binaries clrecon then keeps."""
    if not quirks.is_pocl(device.platform):
        pytest.skip("no driver here that gives and takes binaries")
    monkeypatch.setattr(device, "keeps_binaries", True)
    return device


def test_stored_binary_is_read_back_from_a_file_named_by_its_key(own_cache):
    assert read_binary(KEY) is None
    store_binary(KEY, b"program")
    assert read_binary(KEY) == b"program"
    assert [path.name for path in own_cache.iterdir()] == [KEY]


def test_binary_keys_differ_where_the_same_text_is_divided_differently():
    keys = [binary_key("ab", "c"), binary_key("a", "bc"), binary_key("abc"), binary_key("ab", "c", "")]
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda content: content[:-1], id="without its last byte"),
        pytest.param(lambda content: content[:30], id="cut within its header"),
        pytest.param(lambda content: b"", id="empty"),
        pytest.param(lambda content: content[:-1] + b"x", id="with another last byte"),
    ],
)
def test_damaged_binary_is_not_read(own_cache, damage):
    store_binary(KEY, b"program")
    (own_cache / KEY).write_bytes(damage((own_cache / KEY).read_bytes()))
    assert read_binary(KEY) is None


@pytest.fixture
def misplaced_binary(own_cache):
    """A whole binary of another source, device or driver, under the name of `KEY`."""
    other_key = binary_key("other device", "source")
    store_binary(other_key, b"program of another device")
    (own_cache / other_key).rename(own_cache / KEY)


@pytest.mark.fault_row(59)
def test_binary_of_another_key_is_not_read(misplaced_binary):
    assert read_binary(KEY) is None


def test_binary_of_another_key_is_replaced_by_the_next_that_is_stored(misplaced_binary):
    store_binary(KEY, b"program")
    assert read_binary(KEY) == b"program"


def test_without_a_cache_folder_no_binary_is_stored(own_cache, monkeypatch):
    caches = prepare_caches()._replace(binaries=None)
    monkeypatch.setattr(cache, "prepare_caches", lambda: caches)
    store_binary(KEY, b"program")
    assert read_binary(KEY) is None
    assert list(own_cache.iterdir()) == []


def test_storing_in_a_cache_folder_that_was_removed_raises_no_error(own_cache):
    own_cache.rmdir()
    store_binary(KEY, b"program")
    assert read_binary(KEY) is None


@pytest.mark.fault_row(72)
def test_stored_binary_is_for_its_owner_alone_even_with_umask_0(own_cache):
    before = os.umask(0)
    try:
        store_binary(KEY, b"program")
    finally:
        os.umask(before)
    assert (own_cache / KEY).stat().st_mode & 0o777 == 0o600


def test_beyond_512_binaries_the_oldest_are_removed(own_cache):
    older = [own_cache / f"{number:03}" for number in range(512)]
    for seconds, path in enumerate(older):
        path.touch()
        os.utime(path, (seconds, seconds))  # the first is the oldest
    newer = [binary_key("first"), binary_key("second")]

    for key in newer:
        store_binary(key, b"program")

    left = {path.name for path in own_cache.iterdir()}
    assert left == {path.name for path in older[2:]} | set(newer)


def forget_programs(device, monkeypatch):
    """What a new process knows: no program has been built or loaded."""
    monkeypatch.setattr(device, "programs", {})


def test_program_is_stored_once_and_loaded_by_later_processes(keeping_pocl, monkeypatch):
    stored = []
    monkeypatch.setattr(program, "store_binary", lambda *kept: stored.append(kept) or store_binary(*kept))
    for _ in range(3):
        forget_programs(keeping_pocl, monkeypatch)
        assert load_program(keeping_pocl, "primitives/compact.cl").kernel_names == ["count_set_bits", "list_set_bits"]
    assert len(stored) == 1


def test_loaded_binary_computes_what_its_source_does(keeping_pocl, monkeypatch):
    from clrecon.opencl import upload
    from clrecon.operators.primitives.scan import compact

    mask = np.random.default_rng(0).integers(0, 2**32, 1000, dtype=np.uint32)
    set_bits = int(np.unpackbits(mask.view(np.uint8)).sum())
    forget_programs(keeping_pocl, monkeypatch)
    assert compact(keeping_pocl, upload(keeping_pocl, mask), len(mask)).count == set_bits

    forget_programs(keeping_pocl, monkeypatch)
    built = []
    monkeypatch.setattr(program, "store_binary", lambda key, binary: built.append(key))
    assert compact(keeping_pocl, upload(keeping_pocl, mask), len(mask)).count == set_bits
    assert built == []  # all of its programs were loaded


def test_program_whose_binary_the_driver_refuses_is_built_from_source_and_its_binary_replaced(
    keeping_pocl, own_cache, monkeypatch
):
    forget_programs(keeping_pocl, monkeypatch)  # an earlier test may have built it
    load_program(keeping_pocl, "primitives/compact.cl")
    [key] = (path.name for path in own_cache.iterdir())
    store_binary(key, b"no program at all")
    forget_programs(keeping_pocl, monkeypatch)
    assert load_program(keeping_pocl, "primitives/compact.cl").kernel_names == ["count_set_bits", "list_set_bits"]
    assert read_binary(key) not in (None, b"no program at all")


def test_program_without_kernels_is_refused_with_its_file(keeping_pocl, monkeypatch):
    monkeypatch.setattr(program.Program, "kernel_names", [])
    forget_programs(keeping_pocl, monkeypatch)
    with refused(DeviceError, "kernel", "compact.cl"):
        load_program(keeping_pocl, "primitives/compact.cl")
