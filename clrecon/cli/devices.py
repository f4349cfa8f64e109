"""``clrecon devices``: the OpenCL devices of this computer."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.system.text import format_bytes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "The device marked * is the one that would be used: GPUs before CPUs, cards with memory of their own before\n"
        "others, then the most compute units. One that failed the check at its first use, and a simulator (Oclgrind),\n"
        "are used only when they are named."
    )
    common.add_device(parser, computes=False, memory=False)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.devices import survey_devices

    survey, problem = survey_devices(options.device)
    console.result(survey)
    for warning in survey["warnings"]:
        console.warn(warning)
    for line in _describe_survey(survey):
        console.say(line)
    if problem is not None:
        raise problem
    return 0


def _describe_survey(survey: dict[str, Any]) -> list[str]:
    lines = []
    for device in survey["devices"]:
        mark = "*" if device["chosen"] else " "
        kind = "simulator" if device["simulator"] else device["type"]
        ownership = " of its own" if device["has_own_memory"] else ""
        memory, largest = (format_bytes(device[name]) for name in ("memory_bytes", "max_allocation_bytes"))
        lines.append(f"{mark} {device['index']}  {kind:<11}  {printable(device['name'])}")
        lines.append(f"{'':18}{device['compute_units']} compute units, {memory}{ownership}, largest buffer {largest}")
        driver = f"{device['platform']}, {device['version']}, driver {device['driver']}"
        lines.append(f"{'':18}{printable(driver)}")
        if device["chosen"]:
            lines.append(f"{'':18}taken {survey['reason']}")
        if device["shortcoming"]:
            lines.append(f"{'':18}cannot be used: {printable(device['shortcoming'])}")
        if device["fault"]:
            lines.append(f"{'':18}failed the check at its first use: {printable(device['fault'])}")
    if survey["platforms"]:
        lines += ["", "platforms:"]
        rows = [(printable(p["name"]), printable(p["note"]), printable(p["version"])) for p in survey["platforms"]]
        lines += [f"  {line}" for line in common.table(rows)]
    return lines
