"""Mutated files: nothing but a ClreconError gets out of the reader, soon, in little memory, and nothing is printed.

The time is that of the variable CLRECON_FUZZ_SECONDS (all campaigns together, default 60); the examples of a round
depend on its number alone, so that what is found is found again.
"""

from __future__ import annotations

import json
import os
import shutil
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_bytes import CHANGE_LISTS, Seed, apply_changes, make_phases, phantom_seeds, pydicom_seeds
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from clrecon.dicom import list_series, read_volume
from clrecon.dicom import reader as reader_module
from clrecon.errors import ClreconError
from clrecon.geometry.certificate import Certificate

SECONDS = float(os.environ.get("CLRECON_FUZZ_SECONDS", "60"))
READ_LIMIT_S = 5.0
MEMORY_LIMIT_BYTES = 256 * 1024 * 1024
"""What reading one hostile file of some kB may take beyond what the process has."""
ROUND = 150


def peak_bytes() -> int:
    """Largest resident size since `forget_peak`; 0 where the system does not say."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 0


def forget_peak() -> int:
    """Start the peak anew; returns where it starts."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return peak_bytes()
    return peak_bytes()


def check_one_read(read: Callable[[], Any]) -> Any:
    """Call `read`; a refusal is one printable line, and gives None."""
    before, start = forget_peak(), time.monotonic()
    try:
        found = read()
    except ClreconError as error:
        text = str(error)
        assert "\n" not in text and text.isprintable() and 0 < len(text) < 5000
        found = None
    assert time.monotonic() - start < READ_LIMIT_S
    assert peak_bytes() - before < MEMORY_LIMIT_BYTES
    return found


def check_folder(folder: Path, force: bool = False, phase: int | None = None) -> None:
    """Read and list a folder of hostile files; whatever is said of it is JSON and holds no patient data."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        volume = check_one_read(lambda: read_volume(folder, phase=phase, force=force))
        listing = check_one_read(lambda: list_series(folder, force=force))
    told = []
    if volume is not None:
        assert np.isfinite(volume.affine).all() and volume.voxels.size > 0
        assert volume.voxels.dtype.kind != "f" or np.isfinite(volume.voxels).all()
        told.append(volume.report)
    if listing is not None:
        told += [{**entry.as_dict(), "description": ""} for entry in listing.series]
        told.append({"warnings": listing.warnings})
    assert "SECRET" not in json.dumps(told, allow_nan=False)


def write_files(folder: Path, files: list[bytes]) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for k, data in enumerate(files):
        (folder / f"{k}").write_bytes(data)


def run_campaign(strategy: Any, check: Callable[[Any], None], seconds: float) -> int:
    """Rounds of examples until the time is over; returns how many ran."""
    end, done, number = time.monotonic() + seconds, 0, 0
    while time.monotonic() < end:

        @seed(number)
        @settings(
            max_examples=ROUND,
            database=None,
            deadline=None,
            phases=[Phase.generate, Phase.shrink],
            suppress_health_check=list(HealthCheck),
            print_blob=False,
        )
        @given(strategy)
        def one_round(example: Any) -> None:
            nonlocal done
            if time.monotonic() < end:
                check(example)
                done += 1

        one_round()
        number += 1
    return done


def pick(seeds: dict[str, Seed]) -> Any:
    return st.tuples(
        st.sampled_from(sorted(seeds)), CHANGE_LISTS, st.sampled_from(["one", "one", "all", "all", "alone"])
    )


@pytest.mark.fuzz
def test_mutated_slices_of_a_series(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    phases = make_phases()
    seeds = {**phantom_seeds(), "phases": Seed("phases", phases[len(phases) // 2], phases)}

    def check(example: tuple[str, list[Any], str]) -> None:
        name, changes, scope = example
        seed_file = seeds[name]
        files = list(seed_file.series)
        chosen = range(len(files)) if scope == "all" else [len(files) // 2]
        for k in chosen:
            files[k] = apply_changes(seed_file, files[k], changes)
        write_files(tmp_path / "ct", [files[len(files) // 2]] if scope == "alone" else files)
        check_folder(tmp_path / "ct", phase=1 if name == "phases" else None)

    for name in seeds:
        write_files(tmp_path / "ct", list(seeds[name].series))
        check_folder(tmp_path / "ct")
    assert run_campaign(pick(seeds), check, 0.6 * SECONDS) > SECONDS
    assert capfd.readouterr() == ("", "")


@pytest.mark.fuzz
def test_mutated_files_of_pydicom(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    seeds = pydicom_seeds()
    assert len(seeds) > 60

    def check(example: tuple[str, list[Any], str]) -> None:
        name, changes, scope = example
        write_files(tmp_path / "ct", [apply_changes(seeds[name], seeds[name].data, changes)])
        check_folder(tmp_path / "ct", force=scope == "all")

    for name in seeds:
        write_files(tmp_path / "ct", [seeds[name].data])
        check_folder(tmp_path / "ct")
    assert run_campaign(pick(seeds), check, 0.3 * SECONDS) > SECONDS / 3
    assert capfd.readouterr() == ("", "")


@pytest.mark.fuzz
def test_random_bytes(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    start = bytes(128) + b"DICM"
    syntax = b"\x02\0\x10\0UI\x14\x001.2.840.10008.1.2.1\0"
    heads = st.sampled_from([b"", b"", start, start + syntax, start + syntax.replace(b".2.1\0", b".2.2\0")])
    bodies = st.binary(max_size=400) | st.binary(max_size=60).map(lambda data: b"\x08\0\x05\0CS\x02\0 A" + data)

    def check(example: tuple[bytes, bytes]) -> None:
        write_files(tmp_path / "ct", [b"".join(example)])
        check_folder(tmp_path / "ct", force=not example[0])

    assert run_campaign(st.tuples(heads, bodies), check, 0.1 * SECONDS) > SECONDS
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("fault", ["exception", "memory", "report"])
def test_the_campaign_sees_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    write_files(tmp_path / "ct", list(phantom_seeds()["explicit"].series))
    check_folder(tmp_path / "ct")
    whole = reader_module.certify

    def faulty(*args: Any, **kwargs: Any) -> Certificate:
        if fault == "exception":
            raise KeyError("made up")
        if fault == "memory":
            np.ones(MEMORY_LIMIT_BYTES // 4)
        made = whole(*args, **kwargs)
        return replace(made, warnings=[*made.warnings, "SECRET^NAME"]) if fault == "report" else made

    monkeypatch.setattr(reader_module, "certify", faulty)
    with pytest.raises((KeyError, AssertionError), match="made up|assert"):
        check_folder(tmp_path / "ct")
