"""Rows 54 and 56 in whole jobs: the report says which device did the work, and the files are those of that device."""

from __future__ import annotations

from pathlib import Path

import pytest
from ct_files import write_series
from failing_devices import Failing, lost_error, pretended_gpu
from variants import daily

from clrecon.cli.main import main

NEVER = 1 << 30

COMMANDS = {
    "mesh": ("out.stl", ("--hu", "200", "--keep-largest", "1")),
    "render": ("out.png", ("--size", "24", "--mode", "mip")),
}


@pytest.fixture
def gpu(device, monkeypatch):
    """The GPU that is chosen where no device is named, beside the CPU device."""
    gpu = pretended_gpu(device)
    gpu.stand_in = None
    monkeypatch.setattr("clrecon.opencl.select.list_devices", lambda: [device, gpu])
    for variable in ("CLRECON_DEVICE", "PYOPENCL_CTX"):
        monkeypatch.delenv(variable, raising=False)
    return gpu


@pytest.mark.fault_row(54)
@pytest.mark.seconds
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("first_to_fail", daily(1, [1, 2]))
def test_job_whose_device_fails_is_done_again_on_the_cpu_device_with_a_warning(
    device, gpu, tmp_path, capsys, monkeypatch, command, first_to_fail
):
    output, options = COMMANDS[command]
    write_series(tmp_path / "ct")
    (tmp_path / "alone").mkdir()
    arguments = [command, str(tmp_path / "ct"), *options]
    assert main([*arguments, "-o", str(tmp_path / "alone" / output), "--device", str(device.index)]) == 0
    capsys.readouterr()
    with monkeypatch.context() as patch:
        Failing(patch, "launch", first=first_to_fail, last=NEVER, label=gpu.label)
        report = tmp_path / "report.json"
        assert main([*arguments, "-o", str(tmp_path / output), "--report", str(report)]) == 0
    said = capsys.readouterr()
    assert said.err.count(f"all was done on {device.label} instead of {gpu.label}") == 1
    assert f'"device": "{device.label}"' in report.read_text()
    assert f"all was done on {device.label}" in report.read_text()
    assert (tmp_path / output).read_bytes() == (tmp_path / "alone" / output).read_bytes()


@pytest.mark.fault_row(54)
@pytest.mark.parametrize("command", daily(1, COMMANDS))
def test_job_on_a_named_device_that_fails_is_refused_with_the_number_of_the_cpu_device(
    device, gpu, tmp_path, printed, monkeypatch, command
):
    name, options = COMMANDS[command]
    write_series(tmp_path / "ct")
    Failing(monkeypatch, "launch", first=3, last=NEVER, label=gpu.label)  # the third launch and all later ones
    output: Path = tmp_path / name
    assert main([command, str(tmp_path / "ct"), "-o", str(output), *options, "--device", "gpu"]) == 5
    printed().assert_error("--device", device.index)
    assert not output.exists()


@pytest.mark.fault_row(56)
def test_job_whose_device_is_lost_is_done_again_on_it_in_a_new_context(gpu, tmp_path, printed, monkeypatch):
    write_series(tmp_path / "ct")
    # nothing is tried beside the reading: the launch that fails is one of the work
    monkeypatch.setattr("clrecon.jobs.mesh.make._try_steps", lambda device, settings: None)
    Failing(monkeypatch, "launch", first=3, label=gpu.label, error=lost_error())
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(tmp_path / "out.stl"), "--hu", "200"]) == 0
    said = printed()
    said.assert_error("again", "context")
    said.assert_output("pretended")
