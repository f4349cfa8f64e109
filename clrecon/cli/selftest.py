"""``clrecon selftest``: a comparison of every operator with its twin, on the device that jobs would use."""

from __future__ import annotations

import argparse

from clrecon.cli.common import add_device, table
from clrecon.cli.console import Console, printable
from clrecon.errors import DeviceError

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.epilog = "Runs every operator on small volumes and compares with plain numpy. Exit code 5 when one differs."
    add_device(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    """Run the command; returns the exit code."""
    from clrecon.jobs.devices import run_device_selftest

    outcome = run_device_selftest(options.device, progress=console.progress)
    console.result(outcome)
    for warning in outcome["warnings"]:
        console.warn(warning)
    device = outcome["device"]
    name = printable(f"{device['name']} ({device['platform']}, driver {device['driver']})")
    console.say(f"device  {name}")
    rows = [
        ("pass" if r["passed"] else "FAIL", r["operator"], f"{r['seconds']:.2f} s", printable(r["detail"]))
        for r in outcome["operators"]
    ]
    for line in table(rows) if rows else []:
        console.say(line)
    if not outcome["passed"]:
        failed = ", ".join(r["operator"] for r in outcome["operators"] if not r["passed"]) or "nothing was tested"
        raise DeviceError(f"the self-test failed on {name}: {failed}; update its driver or choose another device")
    return 0
