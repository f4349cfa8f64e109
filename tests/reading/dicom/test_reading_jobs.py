"""Reading as work for threads and processes: how many, how it ends early, and how much memory it may take."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from compressed_frames import encode_rle
from dicom_series import Plan, write_series
from pydicom.encaps import encapsulate
from pydicom.uid import RLELossless

from clrecon.reading import read_volume
from clrecon.reading.dicom.pixels import voxels as pixels
from clrecon.reading.dicom.pixels.stored import StoredPixels
from clrecon.system import memory


def test_interrupt_ends_reading_while_slices_are_still_being_handed_out(tmp_path, monkeypatch):
    write_series(tmp_path, Plan(shape=(60, 5, 6)))
    slices_read, submitted, submit = [], [], ThreadPoolExecutor.submit

    def load_slowly(source, header, out):
        slices_read.append(header)
        time.sleep(0.05)
        return out

    def interrupt_the_50th(*arguments):
        submitted.append(arguments)
        if len(submitted) == 50:
            raise KeyboardInterrupt
        return submit(*arguments)

    monkeypatch.setattr(StoredPixels, "load", load_slowly)
    monkeypatch.setattr(ThreadPoolExecutor, "submit", interrupt_the_50th)
    with pytest.raises(KeyboardInterrupt):
        read_volume(tmp_path)
    assert len(slices_read) <= 2 * pixels.MAX_READERS  # those at work, and as many that had been handed out


@pytest.mark.parametrize(("slices", "expected"), [(2, 1), (7, 1), (40, 1 + 20 // 4)])
def test_number_of_decoder_processes_grows_with_the_slices(tmp_path, monkeypatch, slices, expected):
    """One, and another for each 4 MiB: a process takes longer to start than a frame of half a MiB to decode."""
    counts = []
    monkeypatch.setattr(pixels, "count_readers", lambda slices, most: counts.append(most) or 1)
    plan = Plan(shape=(slices, 512, 512), syntax=RLELossless)

    def compress(ds, k):
        ds.PixelData = encapsulate([encode_rle(plan.stored(k))])
        ds["PixelData"].VR, ds["PixelData"].is_undefined_length = "OB", True

    write_series(tmp_path, plan, compress)
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())
    assert set(counts) == {expected}


MIB = 1 << 20
OF_THE_CONTAINER = (9 - 5 + 1) * MIB  # its limit, less what it uses, and files in memory, which it can drop
OF_THE_MACHINE = 1024 * MIB


@pytest.mark.fault_row(39)
@pytest.mark.parametrize(
    ("line", "files", "expected"),
    [
        ("0::/pod/box", {"pod/memory.max": 9 * MIB, "pod/memory.current": 5 * MIB, "pod/box/memory.max": "max"},
         OF_THE_CONTAINER),
        ("0::/not/seen/from/within", {"memory.max": 9 * MIB, "memory.current": 5 * MIB}, OF_THE_CONTAINER),
        ("4:cpu,memory:/box", {"memory/box/memory.limit_in_bytes": 9 * MIB,
                               "memory/box/memory.usage_in_bytes": 5 * MIB}, OF_THE_CONTAINER),
        ("0::/box", {"box/memory.max": "max", "box/memory.current": 5 * MIB}, OF_THE_MACHINE),
        ("3:cpu:/box", {"box/memory.max": 9 * MIB, "box/memory.current": 5 * MIB}, OF_THE_MACHINE),
    ],
    ids=["group around it", "its own as the root", "version 1", "no limit", "another group"],
)  # fmt: skip
def test_available_memory_is_that_of_the_container_where_it_has_a_limit(tmp_path, line, files, expected):
    proc, groups = tmp_path / "proc", tmp_path / "groups"
    (proc / "self").mkdir(parents=True)
    (proc / "meminfo").write_text(f"MemTotal: 2097152 kB\nMemAvailable: {OF_THE_MACHINE // 1024} kB\n")
    (proc / "self" / "cgroup").write_text(line + "\n")
    for name, value in files.items():
        (groups / name).parent.mkdir(parents=True, exist_ok=True)
        (groups / name).write_text(f"{value}\n")
        stat = f"anon 5\ninactive_file {MIB}\ntotal_inactive_file {MIB}\n"
        (groups / name).with_name("memory.stat").write_text(stat)
    assert memory.available_memory_bytes(proc, groups) == expected
