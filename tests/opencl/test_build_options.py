"""Options that a user adds to the build of kernels."""

import pytest
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl.device import Device
from clrecon.opencl.program import load_program


def open_anew(device: Device) -> Device:
    """The same device as a new process has it, which reads the environment variables."""
    return Device(device.index, device.cl_device.platform, device.cl_device)


def test_programs_are_built_with_the_users_options(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLRECON_BUILD_OPTIONS", "-cl-opt-disable -DOWN=1")
    own = open_anew(device)
    load_program(own, "primitives/scan.cl", own.kernel_variants)
    [(_, options)] = own.programs
    assert {"-cl-opt-disable", "-DOWN=1"} < set(options)


def test_the_users_build_options_follow_those_of_the_device(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CLRECON_BUILD_OPTIONS", raising=False)
    without = open_anew(device).build_options
    monkeypatch.setenv("CLRECON_BUILD_OPTIONS", "-cl-opt-disable -DOWN=1")
    assert open_anew(device).build_options == (*without, "-cl-opt-disable", "-DOWN=1")


def test_build_option_that_the_driver_does_not_know_is_named(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLRECON_BUILD_OPTIONS", "-no-such-option")
    own = open_anew(device)
    with refused(DeviceError, "scan.cl", "CLRECON_BUILD_OPTIONS=-no-such-option"):
        load_program(own, "primitives/scan.cl", own.kernel_variants)
