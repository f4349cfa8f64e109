"""Options that a user adds to the build of kernels."""

import pytest
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl.device import Device
from clrecon.opencl.program import load_program


def test_the_users_options_are_in_every_build(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLRECON_BUILD_OPTIONS", "-cl-opt-disable -DOWN=1")
    own = Device(device.index, device.cl_device.platform, device.cl_device)
    load_program(own, "primitives/scan.cl", own.kernel_variants)
    [(_, options)] = own.programs
    assert {"-cl-opt-disable", "-DOWN=1"} < set(options)
    monkeypatch.delenv("CLRECON_BUILD_OPTIONS")
    plain = Device(device.index, device.cl_device.platform, device.cl_device)
    assert plain.build_options == own.build_options[: len(plain.build_options)]
    assert len(own.build_options) == len(plain.build_options) + 2


def test_an_option_that_the_driver_does_not_know_is_named(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLRECON_BUILD_OPTIONS", "-no-such-option")
    own = Device(device.index, device.cl_device.platform, device.cl_device)
    with refused(DeviceError, "scan.cl", "CLRECON_BUILD_OPTIONS=-no-such-option"):
        load_program(own, "primitives/scan.cl", own.kernel_variants)
