"""The process of the self-test: it runs checks and writes a line of JSON for each thing that it does.

Lines: ``{"check": name}`` before a check, ``{"doing": words}`` before a kernel is built or launched, ``{"warnings":
texts}`` of the device after a check, and the result of the check as `run_check` returns it.
"""

from __future__ import annotations

import json
import os
import sys
import time
from typing import Any

from clrecon.errors import ClreconError
from clrecon.jobs.selftest.check import Check
from clrecon.jobs.selftest.table import CHECKS
from clrecon.opencl import Device, list_devices


def run_check(device: Device, check: Check) -> dict[str, Any]:
    """Run one check.

    Returns: ``operator`` (str: name of the check), ``passed`` (bool), ``detail`` (str: what was compared, or what is
        wrong) and ``seconds`` (float, kernel builds included).
    """
    start = time.perf_counter()
    try:
        passed, detail = True, check.run(device)
    except (ClreconError, ArithmeticError, LookupError, ValueError, MemoryError) as error:
        # A device that computes wrongly hands sizes and places to the host that lead to any of these.
        words = str(error) if isinstance(error, ClreconError) else f"{type(error).__name__}: {error}"
        passed, detail = False, words
    return {
        "operator": check.name,
        "passed": passed,
        "detail": detail,
        "seconds": round(time.perf_counter() - start, 3),
    }


def main() -> None:
    """Run the checks that are named in the JSON object on stdin, on the device that it names by its index."""
    lines = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # a driver may print

    def tell(**line: Any) -> None:
        lines.write(json.dumps(line) + "\n")

    request = json.load(sys.stdin)
    device = list_devices()[request["device"]]
    device.trace = lambda doing: tell(doing=doing)
    for check in CHECKS:
        if check.name in request["checks"]:
            tell(check=check.name)
            result = run_check(device, check)
            if device.known_good is not None:  # after its last result the process may be ended
                device.known_good.record()
            tell(warnings=device.warnings)
            tell(**result)


if __name__ == "__main__":
    main()
