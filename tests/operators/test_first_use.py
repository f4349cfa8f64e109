"""The check of a device at its first use: what it finds, when it runs, and what is remembered."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import refused
from sample_meshes import sphere
from variants import daily_rows

from clrecon import operators
from clrecon.errors import DeviceError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.opencl import Device, program, select
from clrecon.operators.first_use import CENTRE, RADIUS, _compare_mesh, check_ball
from clrecon.operators.surface.extract import extract_isosurface

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts" / "proof"))

from kernel_mutations import Mutation  # noqa: E402


@pytest.mark.every_device
def test_row_57_a_device_that_computes_rightly_passes(device: Device) -> None:
    assert check_ball(device) == ""


@pytest.mark.parametrize(
    ("kernel", "name", "words"),
    daily_rows(
        1,
        [
            ("emit_vertices", "inverted positions", "vertices of a ball lie beside it"),
            ("emit_vertices", "inverted normals", "normals of a ball point elsewhere"),
            ("emit_triangles", "inverted winding", "encloses -0.999 of its volume"),
        ],
    ),
)
def test_row_57_a_device_that_computes_wrongly_does_not(
    device: Device, monkeypatch: pytest.MonkeyPatch, kernel: str, name: str, words: str
) -> None:
    file = "surface/cells.cl" if kernel == "emit_triangles" else "surface/marching_cubes.cl"
    mutation, original = Mutation(file, kernel, name), program.read_kernel_source
    source = mutation.source()
    monkeypatch.setattr(program, "read_kernel_source", lambda file: source if file == mutation.file else original(file))
    monkeypatch.setattr(device, "programs", {})
    assert words in check_ball(device)


def test_row_57_a_vertex_without_triangles_is_none_of_a_ball() -> None:
    vertices, triangles = sphere(CENTRE, RADIUS, 5)
    normals = (vertices - CENTRE) / RADIUS
    assert _compare_mesh(Mesh(vertices, triangles, normals)) == ""
    more = Mesh(np.concatenate([vertices, vertices[:1]]), triangles, np.concatenate([normals, normals[:1]]))
    assert _compare_mesh(more) == f"the surface of a ball has 0 open edges and {len(triangles):,} triangles"


class FakeDevice(SimpleNamespace):
    """What the memory of the check looks at."""

    def __init__(self, **changed: Any) -> None:
        self.remarks: list[str] = []
        known = {"platform": "P", "platform_version": "1", "driver": "2", "version": "3", "name": "N"}
        super().__init__(
            **known | {"fault": None, "is_simulator": False, "label": "N (P)", "build_options": ()} | changed,
            kernel_variants={"LANES": "1"},
            remark=self.remarks.append,
        )


@pytest.fixture
def checked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """The devices that were checked; those named "wrong" fail.  Files of the cache are a dict."""
    seen: list[Any] = []
    files: dict[str, bytes] = {}

    def check(device: Any) -> str:
        seen.append(device)
        assert select.find_fault(device) == ""  # what the check itself asks of the device
        return "wrong sums" if device.name == "wrong" else ""

    select.register(check)
    monkeypatch.setattr(select, "read_binary", files.get)
    monkeypatch.setattr(select, "store_binary", files.__setitem__)
    yield seen
    select.register(operators._check_device, "-m", "clrecon.operators.first_use")


def test_row_57_the_check_runs_once_for_a_driver_a_device_and_a_version(
    checked: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    first: Any = FakeDevice()
    assert select.find_fault(first) == select.find_fault(first) == ""
    assert checked == [first]
    another_process: Any = FakeDevice()
    assert select.find_fault(another_process) == "" and len(checked) == 1
    for changed in ({"driver": "2.1"}, {"name": "M"}, {"platform_version": "1.1"}):
        other: Any = FakeDevice(**changed)
        assert select.find_fault(other) == "" and checked[-1] is other
    monkeypatch.setattr(select, "package_version", lambda: "0.0")
    assert select.find_fault(FakeDevice()) == "" and len(checked) == 5  # type: ignore[arg-type]


def test_row_57_failed_check_is_not_remembered_for_the_next_process(checked: list[Any]) -> None:
    for count in (1, 2):
        wrong: Any = FakeDevice(name="wrong")
        assert select.find_fault(wrong) == select.find_fault(wrong) == "wrong sums"
        assert len(checked) == count


@pytest.fixture
def kept(checked: list[Any]) -> dict[str, bytes]:
    """What the files say."""
    return select.read_binary.__self__  # type: ignore[attr-defined, no-any-return]


def test_row_57_what_was_found_is_told_without_a_check(checked: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, words in (("wrong", "wrong sums"), ("right", "")):
        device: Any = FakeDevice(name=name)
        assert select.remembered_fault(device) == ""
        select.find_fault(device)
        assert select.remembered_fault(FakeDevice(name=name)) == words  # type: ignore[arg-type]
    assert len(checked) == 2
    assert select.remembered_fault(FakeDevice(name="wrong", is_simulator=True)) == ""  # type: ignore[arg-type]
    monkeypatch.setenv(select.VARIABLE, "off")
    assert select.remembered_fault(FakeDevice(name="wrong")) == ""  # type: ignore[arg-type]


def test_row_57_an_interrupted_check_says_nothing(
    checked: list[Any], kept: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(device: Any) -> str:
        assert list(kept.values()) == [select._BEGUN]
        raise KeyboardInterrupt

    select.register(interrupt)
    with pytest.raises(KeyboardInterrupt):
        select.find_fault(FakeDevice())  # type: ignore[arg-type]
    assert list(kept.values()) == [b""] and select.remembered_fault(FakeDevice()) == ""  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("code", "fault", "remembered"),
    [
        ("import os; os.abort()", "its driver ends the process (SIGABRT)", select._CRASHED),
        ("raise SystemExit(3)", "its driver ends the process (exit code 3)", select._CRASHED),
        ("print('of a driver'); print('\"wrong sums\"')", "wrong sums", select._WRONG),
        ("print('\"\"')", "", select._PASSED),
    ],
)
def test_row_57_where_a_process_died_in_the_check_a_child_makes_it(
    checked: list[Any],
    kept: dict[str, bytes],
    monkeypatch: pytest.MonkeyPatch,
    code: str,
    fault: str,
    remembered: bytes,
) -> None:
    select.register(check_ball, "-c", code)
    key = select._key(FakeDevice())  # type: ignore[arg-type]
    for before in (select._BEGUN, select._CRASHED + b"earlier"):
        kept[key] = before
        expected = {select._BEGUN: "a process ended while it checked this device"}.get(before, "earlier")
        assert select.remembered_fault(FakeDevice()) == expected  # type: ignore[arg-type]
        device: Any = FakeDevice(index=0)
        assert select.find_fault(device) == fault
        assert kept[key] == remembered + (fault.encode() if fault else b"")
    assert checked == []
    monkeypatch.setattr(sys, "executable", "")
    kept[key] = select._BEGUN
    assert select.find_fault(FakeDevice(index=0)) == "a process ended while it checked this device"  # type: ignore[arg-type]


CRASH = """
import os, sys
import clrecon.operators, clrecon.operators.first_use
from clrecon.opencl import choose_device
clrecon.operators.first_use.check_ball = lambda device: os.abort()
choose_device(int(sys.argv[1]))
"""


@pytest.mark.release
@pytest.mark.seconds
def test_row_57_a_crash_in_the_check_becomes_words_in_the_next_process(device: Device, tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop(select.VARIABLE, None)

    def devices() -> dict[str, Any]:
        line = [sys.executable, "-m", "clrecon.cli.main", "devices", "--json"]
        done = subprocess.run(line, env=environment, capture_output=True, text=True, check=True)
        return json.loads(done.stdout)["devices"][device.index]

    assert devices()["fault"] == ""
    done = subprocess.run([sys.executable, "-c", CRASH, str(device.index)], env=environment, check=False)
    assert done.returncode == -signal.SIGABRT
    assert devices()["fault"] == "a process ended while it checked this device"
    take = "import sys; import clrecon; clrecon.device(int(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", take, str(device.index)], env=environment, check=True)
    assert devices()["fault"] == ""  # the child has found nothing wrong


def test_row_57_simulators_and_those_who_say_so_are_not_checked(
    checked: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator: Any = FakeDevice(is_simulator=True)
    assert select.find_fault(simulator) == ""
    monkeypatch.setenv(select.VARIABLE, "off")
    wrong: Any = FakeDevice(name="wrong")
    assert select.find_fault(wrong) == "" and checked == []
    assert wrong.remarks == [
        "N (P) was not checked at its first use (CLRECON_DEVICE_CHECK=off): its results may be wrong"
    ]


def test_row_57_operators_refuse_a_device_that_computes_wrongly(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "fault", "wrong sums")
    volume = Volume(np.arange(24, dtype=np.int16).reshape(2, 3, 4), np.eye(4))
    with refused(DeviceError, "computes", "sums"):
        extract_isosurface(volume, 10.5, device=device)
