#!/usr/bin/env python3
"""Break every kernel in turn and see that the self-test notices.

    python scripts/proof/mutate_kernels.py [--device D] [--only TEXT] [--results FILE] [--seconds N] [--draw N]

Each mutation of `kernel_mutations` is built into the kernel, and the checks of the self-test that cover this kernel
run until one fails.  Exit code 1 if a mutation is not noticed that should be.  What a driver does with a broken kernel
happens in a process apart: a crash or a hang is noticed too.  With --results, what is known already is not run again,
so that a run that was ended (--seconds, Ctrl-C) goes on where it was.  --draw runs some of them, chosen by a text.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import queue
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from kernel_mutations import Mutation, all_mutations

ROOT = Path(__file__).resolve().parents[2]

HANGS_SECONDS = 120.0
"""Seconds without an answer after which a broken kernel counts as hanging, which is noticed too."""

MEMORY_BYTES = 16 << 30
"""Address space of the process: wrong counts ask for any amount of memory."""


def run_mutations(mutations: Sequence[Mutation], device: int) -> Iterator[tuple[Mutation, dict[str, Any]]]:
    """Run mutations in a process apart, and in another one after each crash.

    Yields results with ``caught`` (bool or None where it does not build), ``by`` (name of the check) and ``words``.
    """
    left, again = list(mutations), set()
    while left:
        with tempfile.TemporaryFile() as errors:
            child = subprocess.Popen(
                [sys.executable, __file__, "--child", str(device)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, cwd=ROOT,
            )  # fmt: skip
            try:
                assert child.stdin is not None
                child.stdin.write(json.dumps(left).encode())
                child.stdin.close()
                for result in _answers(child):
                    mutation = left.pop(0)
                    if not result["caught"] and not mutation.reason and mutation not in again:
                        again.add(mutation)  # memory may hold right values of an earlier run, or a kill lost a file
                        left.append(mutation)
                    else:
                        yield mutation, result
                    if "end" in result:
                        break
            finally:
                child.kill()
                child.wait()
            if child.returncode == 1 and left:
                errors.seek(0)
                raise RuntimeError(errors.read().decode(errors="replace"))


def _answers(child: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    lines: queue.Queue[bytes] = queue.Queue()

    def read() -> None:
        assert child.stdout is not None
        for line in child.stdout:
            lines.put(line)
        lines.put(b"")

    threading.Thread(target=read, daemon=True).start()
    check = ""
    while True:
        try:
            line = lines.get(timeout=HANGS_SECONDS)
        except queue.Empty:
            yield {"caught": True, "by": check, "words": f"hangs for {HANGS_SECONDS:g} s", "end": True}
            return
        if not line:
            code = child.wait()
            if code < 0:
                yield {"caught": True, "by": check, "words": f"crashes with signal {-code}", "end": True}
            return
        told = json.loads(line)
        if "check" in told:
            check = told["check"]
        else:
            yield told


def serve(device_index: int) -> None:
    """Run the mutations on stdin; a line of JSON before each check, and one with the result of each mutation."""
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    if sys.platform.startswith("linux"):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from clrecon.opencl import list_devices, program

    device = list_devices()[device_index]
    device.keeps_binaries = device.builds_together = False
    original = program.read_kernel_source
    for fields in json.load(sys.stdin):
        mutation = Mutation(*fields)
        sources = {mutation.file: mutation.source()}
        program.read_kernel_source = lambda name, new=sources: new.get(name) or original(name)  # type: ignore
        device.programs.clear()
        lines.write(json.dumps(_try(device, mutation, lines)) + "\n")


def _try(device: Any, mutation: Mutation, lines: Any) -> dict[str, Any]:
    from clrecon.proof.run import CHECKS, run_check

    checks = [check for check in CHECKS if mutation.kernel in check.kernels]
    for check in checks:
        lines.write(json.dumps({"check": check.name}) + "\n")
        outcome = run_check(device, check)
        if "does not build" in outcome["detail"]:
            return {"caught": None, "by": check.name, "words": outcome["detail"]}
        if not outcome["passed"]:
            return {"caught": True, "by": check.name, "words": outcome["detail"]}
    return {"caught": False, "by": ", ".join(check.name for check in checks), "words": "passes"}


def key_of(mutation: Mutation) -> str:
    """Return a hash of a mutation and of all checks: what a result is valid for."""
    digest = hashlib.sha256(mutation.key().encode())
    proof = ROOT / "clrecon" / "proof"
    for path in sorted([*proof.glob("*/*_checks.py"), *proof.glob("checking/*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def judge(mutation: Mutation, result: dict[str, Any]) -> str:
    """Return one word: caught, equivalent, SURVIVED, or BROKEN for a mutation that does not build."""
    if result["caught"] is None:
        return "BROKEN"
    if result["caught"]:
        return "caught" if not mutation.reason else "CAUGHT"  # it is no equivalent then
    return "equivalent" if mutation.reason else "SURVIVED"


def main() -> int:
    """Run the script; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="0", help='index of "clrecon devices"')
    parser.add_argument("--only", default="", help="mutations with this text in file, kernel or name")
    parser.add_argument("--results", type=Path, help="JSON file of results, read and written")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no further mutation after this time")
    parser.add_argument("--draw", type=int, help="this many mutations only")
    parser.add_argument("--seed", default="", help="text that decides which")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        serve(options.child)
        return 0
    mutations = [mutation for mutation in all_mutations() if options.only in " ".join(mutation)]
    if options.draw is not None:
        mutations = random.Random(options.seed).sample(mutations, min(options.draw, len(mutations)))
    known = json.loads(options.results.read_text()) if options.results and options.results.exists() else {}
    return report(mutations, known, options)


def report(mutations: list[Mutation], known: dict[str, Any], options: argparse.Namespace) -> int:
    """Run what is not known, print a line for each mutation, and return the exit code."""
    start, bad, told = time.monotonic(), 0, 0

    def tell(mutation: Mutation, result: dict[str, Any]) -> None:
        nonlocal bad, told
        word = judge(mutation, result)
        bad, told = bad + (word.isupper()), told + 1
        why = mutation.reason or f"{result['by']}: {result['words']}"
        print(f"{word:10s}  {mutation.kernel:20s}  {mutation.name:22s}  {why}", flush=True)

    left = []
    for mutation in mutations:
        result = known.get(key_of(mutation))
        if result is None:
            left.append(mutation)
        else:
            tell(mutation, result)
    for mutation, result in run_mutations(left, int(options.device)):
        known[key_of(mutation)] = result
        tell(mutation, result)
        if options.results:
            unfinished = options.results.with_suffix(".new")
            unfinished.write_text(json.dumps(known, indent=1))
            unfinished.replace(options.results)
        if time.monotonic() - start > options.seconds:
            break
    print(f"{told} of {len(mutations)} mutations run, {bad} not as they should be, {time.monotonic() - start:.0f} s")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
