"""``clrecon selftest``: a comparison of every kernel with its twin, on the device that jobs would use."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.errors import DeviceError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "Compares every kernel with its reference implementation. Exit code 5 if one differs."
    common.add_device(parser, memory=False)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.proof.run import CHECKS, run_device_selftest

    width = max(len(check.name) for check in CHECKS)
    results: list[dict[str, Any]] = []

    def tell_result(device: dict[str, Any], result: dict[str, Any]) -> None:
        if not results:
            console.say(f"device  {common.name_device(device)}")
        results.append(result)
        word, seconds = "pass" if result["passed"] else "FAIL", f"{result['seconds']:.2f} s"
        console.say(f"{word}  {result['operator']:{width}}  {seconds:7}  {printable(result['detail'])}")

    outcome = run_device_selftest(options.device, progress=console.progress, tell=tell_result)
    console.result(outcome)
    for warning in outcome["warnings"]:
        console.warn(warning)
    if not outcome["passed"]:
        failed = ", ".join(r["operator"] for r in outcome["operators"] if not r["passed"]) or "nothing was tested"
        name = common.name_device(outcome["device"])
        raise DeviceError(f"the self-test failed on {name}: {failed}; update its driver or choose another device")
    return 0
