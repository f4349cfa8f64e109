"""Row 56: a kernel that hangs.  Signals and the time limit end the command, and nothing is left of its files."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from ct_files import write_series
from hung_kernels import start_command
from variants import daily_rows


def command_line(command: str, device, tmp_path: Path) -> tuple[str, ...]:
    write_series(tmp_path / "ct")
    own = {"mesh": ("-o", str(tmp_path / "out.stl"), "--hu", "200"), "render": ("-o", str(tmp_path / "out.png"))}
    return command, str(tmp_path / "ct"), *own[command], "--device", str(device.index)


@pytest.mark.fault_row(56)
@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("command", "kernel", "sent_signal"),
    daily_rows(1, [("mesh", "emit_vertices", signal.SIGINT), ("render", "composite_rays", signal.SIGTERM)]),
)
def test_command_whose_kernel_hangs_is_ended_by_a_signal_with_130_and_leaves_nothing(
    device, tmp_path, command, kernel, sent_signal
):
    process = start_command(kernel, *command_line(command, device, tmp_path))
    assert process.stderr is not None
    assert process.stderr.readline() == "the kernel spins\n"
    time.sleep(0.3)  # the command waits for it by now
    process.send_signal(sent_signal)
    start = time.perf_counter()
    _, errors = process.communicate(timeout=60)
    assert time.perf_counter() - start < 12.0  # 0.6 s on an idle machine; the kernel spins for 30
    assert (process.returncode, errors) == (130, "clrecon: error: interrupted\n")
    assert [path.name for path in tmp_path.iterdir()] == ["ct"]


@pytest.mark.fault_row(56)
@pytest.mark.release
@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "kernel"), daily_rows(1, [("mesh", "emit_triangles"), ("render", "composite_rays")])
)
def test_command_whose_kernel_hangs_is_ended_by_its_time_limit_with_5_and_advice(device, tmp_path, command, kernel):
    process = start_command(kernel, *command_line(command, device, tmp_path), "--timeout", "1")
    assert process.stderr is not None
    assert process.stderr.readline() == "the kernel spins\n"
    start = time.perf_counter()
    _, errors = process.communicate(timeout=60)
    assert time.perf_counter() - start < 12.0  # 1.2 s on an idle machine; the kernel spins for 30
    assert process.returncode == 5
    assert errors.startswith("clrecon: error: kernel ")
    assert f"has not ended on {device.label} for 1 s, so it counts as hung: choose another --device" in errors
    assert "longer --timeout in seconds (0: none)" in errors
    assert [path.name for path in tmp_path.iterdir()] == ["ct"]
