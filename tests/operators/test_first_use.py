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
from numpy.typing import NDArray
from refusals import assert_facts, refused
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

pytestmark = pytest.mark.fault_row(57)


@pytest.mark.every_device
def test_a_device_that_computes_rightly_passes(device: Device) -> None:
    assert check_ball(device) == ""


@pytest.mark.parametrize(
    ("kernel", "mutation_name", "fault"),
    daily_rows(
        1,
        [
            ("emit_vertices", "inverted positions", "vertices of a ball lie beside it"),
            ("emit_vertices", "inverted normals", "normals of a ball point elsewhere"),
            ("emit_triangles", "inverted winding", "encloses -0.999 of its volume"),
        ],
    ),
)
def test_a_device_that_computes_the_surface_of_a_ball_wrongly_fails_with_the_fault(
    device: Device, monkeypatch: pytest.MonkeyPatch, kernel: str, mutation_name: str, fault: str
) -> None:
    file = "surface/cells.cl" if kernel == "emit_triangles" else "surface/marching_cubes.cl"
    wrong_source, read_source = Mutation(file, kernel, mutation_name).source(), program.read_kernel_source
    monkeypatch.setattr(
        program, "read_kernel_source", lambda asked: wrong_source if asked == file else read_source(asked)
    )
    monkeypatch.setattr(device, "programs", {})
    monkeypatch.setattr(device, "builds_together", False)
    assert fault in check_ball(device)


def ball_with_normals() -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    vertices, triangles = sphere(CENTRE, radius=RADIUS, rounds=5)
    return vertices, triangles, (vertices - CENTRE) / RADIUS


def test_mesh_of_a_ball_has_no_fault() -> None:
    vertices, triangles, normals = ball_with_normals()
    assert _compare_mesh(Mesh(vertices, triangles, normals)) == ""


def test_mesh_of_a_ball_with_a_vertex_of_no_triangle_has_a_fault() -> None:
    vertices, triangles, normals = ball_with_normals()
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
def checked_devices(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
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


def fake_device(**changed: Any) -> Any:
    return FakeDevice(**changed)


def test_a_device_is_checked_once_for_all_processes(checked_devices: list[Any]) -> None:
    first, of_another_process = fake_device(), fake_device()
    assert select.find_fault(first) == select.find_fault(first) == ""
    assert select.find_fault(of_another_process) == ""
    assert checked_devices == [first]


@pytest.mark.parametrize("changed", [{"driver": "2.1"}, {"name": "M"}, {"platform_version": "1.1"}])
def test_another_driver_device_or_platform_is_checked_anew(checked_devices: list[Any], changed: dict[str, str]) -> None:
    first, other = fake_device(), fake_device(**changed)
    select.find_fault(first)
    select.find_fault(other)
    assert checked_devices == [first, other]


def test_another_version_of_the_package_checks_anew(
    checked_devices: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, later = fake_device(), fake_device()
    select.find_fault(first)
    monkeypatch.setattr(select, "package_version", lambda: "0.0")
    select.find_fault(later)
    assert checked_devices == [first, later]


def test_a_failed_check_is_made_again_in_the_next_process(checked_devices: list[Any]) -> None:
    of_first_process, of_next_process = fake_device(name="wrong"), fake_device(name="wrong")
    for wrong in (of_first_process, of_next_process):
        assert select.find_fault(wrong) == select.find_fault(wrong) == "wrong sums"
    assert checked_devices == [of_first_process, of_next_process]


@pytest.fixture
def cached_files(checked_devices: list[Any]) -> dict[str, bytes]:
    """What the files of the cache hold, by their keys."""
    return select.read_binary.__self__  # type: ignore[attr-defined, no-any-return]


@pytest.mark.parametrize(("name", "fault"), [("wrong", "wrong sums"), ("right", "")])
def test_what_a_check_found_is_remembered_without_another(checked_devices: list[Any], name: str, fault: str) -> None:
    first = fake_device(name=name)
    assert select.remembered_fault(first) == ""  # nothing is known yet
    select.find_fault(first)
    assert select.remembered_fault(fake_device(name=name)) == fault
    assert checked_devices == [first]


def test_no_fault_of_a_simulator_is_remembered(checked_devices: list[Any]) -> None:
    select.find_fault(fake_device(name="wrong"))
    assert select.remembered_fault(fake_device(name="wrong", is_simulator=True)) == ""


def test_no_fault_is_remembered_where_the_check_is_switched_off(
    checked_devices: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    select.find_fault(fake_device(name="wrong"))
    monkeypatch.setenv(select.VARIABLE, "off")
    assert select.remembered_fault(fake_device(name="wrong")) == ""


def test_an_interrupted_check_leaves_no_fault(checked_devices: list[Any], cached_files: dict[str, bytes]) -> None:
    def interrupt(device: Any) -> str:
        assert list(cached_files.values()) == [select._BEGUN]
        raise KeyboardInterrupt

    select.register(interrupt)
    with pytest.raises(KeyboardInterrupt):
        select.find_fault(fake_device())
    assert list(cached_files.values()) == [b""]
    assert select.remembered_fault(fake_device()) == ""


ENDED = "a process ended while it checked this device"


@pytest.mark.parametrize(
    ("kept_by_last_process", "fault"),
    [(select._BEGUN, ENDED), (select._CRASHED + b"earlier", "earlier")],
    ids=["begun", "crashed"],
)
def test_fault_of_a_check_that_a_process_did_not_end_is_remembered(
    checked_devices: list[Any], cached_files: dict[str, bytes], kept_by_last_process: bytes, fault: str
) -> None:
    cached_files[select._key(fake_device())] = kept_by_last_process
    assert select.remembered_fault(fake_device()) == fault


@pytest.mark.parametrize(
    "kept_by_last_process", [select._BEGUN, select._CRASHED + b"earlier"], ids=["begun", "crashed"]
)
@pytest.mark.parametrize(
    ("code_of_child", "fault", "mark"),
    [
        ("import os; os.abort()", "its driver ends the process (SIGABRT)", select._CRASHED),
        ("raise SystemExit(3)", "its driver ends the process (exit code 3)", select._CRASHED),
        ("print('of a driver'); print('\"wrong sums\"')", "wrong sums", select._WRONG),
        ("print('\"\"')", "", select._PASSED),
    ],
    ids=["aborts", "exits", "finds a fault", "finds none"],
)
def test_a_check_that_a_process_did_not_end_is_made_again_by_a_child(
    checked_devices: list[Any],
    cached_files: dict[str, bytes],
    kept_by_last_process: bytes,
    code_of_child: str,
    fault: str,
    mark: bytes,
) -> None:
    select.register(check_ball, "-c", code_of_child)
    key = select._key(fake_device())
    cached_files[key] = kept_by_last_process
    assert select.find_fault(fake_device(index=0)) == fault
    assert cached_files[key] == mark + fault.encode()
    assert checked_devices == []  # not by this process


@pytest.fixture
def no_linker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A PATH without ld, which PoCL calls when it builds a kernel."""
    monkeypatch.setenv("PATH", str(tmp_path))


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other linkers")
@pytest.mark.usefixtures("checked_devices")
def test_pocl_without_a_linker_is_checked_by_a_child_and_the_fault_names_ld(
    cached_files: dict[str, bytes], no_linker: None
) -> None:
    select.register(check_ball, "-c", "import os; os.abort()")

    fault = select.find_fault(fake_device(index=0, platform="Portable Computing Language"))

    assert_facts(fault, "SIGABRT", "ld")  # of the child: this process would have ended


@pytest.mark.parametrize("platform", ["NVIDIA CUDA", "rusticl"])
def test_other_drivers_without_a_linker_are_checked_by_this_process(
    checked_devices: list[Any], no_linker: None, platform: str
) -> None:
    device = fake_device(platform=platform)

    assert select.find_fault(device) == ""

    assert checked_devices == [device]


def test_a_check_that_a_process_did_not_end_stays_a_fault_where_no_child_can_be_started(
    checked_devices: list[Any], cached_files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    cached_files[select._key(fake_device())] = select._BEGUN
    monkeypatch.setattr(sys, "executable", "")
    assert select.find_fault(fake_device(index=0)) == ENDED


CRASH_IN_THE_CHECK = """
import os, sys
import clrecon.operators, clrecon.operators.first_use
from clrecon.opencl import choose_device
clrecon.operators.first_use.check_ball = lambda device: os.abort()
choose_device(int(sys.argv[1]))
"""
TAKE_THE_DEVICE = "import sys; import clrecon; clrecon.device(int(sys.argv[1]))"


@pytest.mark.release
@pytest.mark.seconds
def test_a_crash_in_the_check_is_listed_as_a_fault_until_a_process_finds_none(device: Device, tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    environment.pop(select.VARIABLE, None)

    def listed_fault() -> str:
        line = [sys.executable, "-m", "clrecon.cli.main", "devices", "--json"]
        done = subprocess.run(line, env=environment, capture_output=True, text=True, check=True)
        return str(json.loads(done.stdout)["devices"][device.index]["fault"])

    def run_code(code: str) -> int:
        return subprocess.run([sys.executable, "-c", code, str(device.index)], env=environment, check=False).returncode

    assert listed_fault() == ""
    assert run_code(CRASH_IN_THE_CHECK) == -signal.SIGABRT
    assert listed_fault() == ENDED
    assert run_code(TAKE_THE_DEVICE) == 0
    assert listed_fault() == ""


def test_a_simulator_is_not_checked(checked_devices: list[Any]) -> None:
    assert select.find_fault(fake_device(is_simulator=True)) == ""
    assert checked_devices == []


def test_a_device_is_not_checked_but_remarked_where_the_check_is_switched_off(
    checked_devices: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(select.VARIABLE, "off")
    wrong = fake_device(name="wrong")
    assert select.find_fault(wrong) == ""
    assert checked_devices == []
    assert wrong.remarks == [
        "N (P) was not checked at its first use (CLRECON_DEVICE_CHECK=off): its results may be wrong"
    ]


def test_operators_refuse_a_device_that_computes_wrongly(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "fault", "wrong sums")
    volume = Volume(np.arange(24, dtype=np.int16).reshape(2, 3, 4), np.eye(4))
    with refused(DeviceError, "check", "sums", "selftest"):
        extract_isosurface(volume, 10.5, device=device)
