#!/usr/bin/env python3
"""Timing of two checkouts of clrecon with the same benches, in turn.

    versions.py OLD NEW CASE... [--input NAME]... [--device D]... [--rounds N] [--pairs N] --json DIR

OLD and NEW are folders of the project, each with an environment in `.venv-test` or `.venv`.  A round runs the bench of
OLD and that of NEW on the same input and device; their order changes with every round.  The ratio of a round is that
of the medians of clrecon's seconds, OLD over NEW: above 1, NEW is faster.  The peer's code does not change: its own
ratio shows how far the machine drifted.  The exit status is 1 if NEW is slower by more than both spreads explain.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parent.parent)]

from _environment import find_python  # noqa: E402
from measure import describe_machine, write_json  # noqa: E402
from results import device_name  # noqa: E402

SIDES = ("clrecon_s", "peer_s")


def run_bench(folder: Path, case: str, given: str, device: str, options: argparse.Namespace) -> dict[str, Any]:
    """Run one case in one checkout and return its result."""
    python = find_python(folder)
    if python is None:
        raise SystemExit(f"{folder} has no environment: run its scripts/test.py or scripts/run.py once")
    with tempfile.TemporaryDirectory() as results:
        command = [python, str(folder / "scripts" / "bench" / "bench.py"), "run", case]
        command += ["--input", given, "--device", device, "--pairs", str(options.pairs), "--limit", str(options.limit)]
        done = subprocess.run([*command, "--json", results], cwd=folder, capture_output=True, text=True)
        files = list(Path(results).glob("*.json"))
        if done.returncode or len(files) != 1:
            raise SystemExit(f"{case} of {folder} failed: {done.stderr.strip()[-500:]}")
        result: dict[str, Any] = json.loads(files[0].read_text(encoding="utf-8"))
        return result


def describe(values: list[float]) -> dict[str, float]:
    """Write median and quartiles."""
    q1, median, q3 = np.percentile(values, (25, 50, 75)).tolist()
    return {"median": median, "q1": q1, "q3": q3}


def compare(case: str, given: str, device: str, options: argparse.Namespace) -> dict[str, Any]:
    """Run the rounds of one case and return their ratios."""
    folders = {"old": options.old.resolve(), "new": options.new.resolve()}
    rounds: list[dict[str, dict[str, dict[str, float]]]] = []
    last: dict[str, Any] = {}
    for number in range(options.rounds):
        medians = {}
        for which in ("old", "new") if number % 2 == 0 else ("new", "old"):
            last[which] = run_bench(folders[which], case, given, device, options)
            medians[which] = {
                name: {side: found[side]["median"] for side in SIDES} for name, found in last[which]["sides"].items()
            }
        rounds.append(medians)
    names = rounds[0]["old"].keys() & rounds[0]["new"].keys()
    ratios = {
        name: {side: describe([one["old"][name][side] / one["new"][name][side] for one in rounds]) for side in SIDES}
        for name in sorted(names)
    }
    return {
        "case": case,
        "input": last["new"]["input"],
        "device": last["new"]["device"],
        "machine": describe_machine(),
        "old_revision": last["old"]["machine"]["revision"],
        "new_revision": last["new"]["machine"]["revision"],
        "pairs_a_round": options.pairs,
        "rounds": rounds,
        "old_over_new": ratios,
    }


def is_slower(ratio: dict[str, dict[str, float]]) -> bool:
    """True if NEW took longer in three quarters of the rounds, and by more than the peer's own times drifted."""
    ours, peer = ratio["clrecon_s"], ratio["peer_s"]
    return ours["q3"] < 1.0 and ours["q3"] < peer["q1"]


def main() -> int:
    """Run all combinations, print a line for each ratio, and keep the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("cases", nargs="+", metavar="CASE")
    parser.add_argument("--input", nargs="+", action="extend", metavar="INPUT", help="as bench.py takes them")
    parser.add_argument("--device", nargs="+", action="extend", metavar="D")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--pairs", type=int, default=3, help="timed pairs in each run (default 3)")
    parser.add_argument("--limit", type=float, default=30.0, metavar="S", help="no new pair after S seconds")
    parser.add_argument("--json", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    slower = 0
    for device, given, case in itertools.product(options.device or ["0"], options.input or ["spine149"], options.cases):
        result = compare(case, given, device, options)
        name = "-".join([case, result["input"]["name"], device_name(result["device"])])
        write_json(options.json / f"{name}.json", result)
        for side, ratio in result["old_over_new"].items():
            ours, peer, flag = ratio["clrecon_s"], ratio["peer_s"], ""
            if is_slower(ratio):
                slower, flag = slower + 1, "  slower"
            print(
                f"{name:60}{side:20}{ours['median']:6.2f} ({ours['q1']:.2f} to {ours['q3']:.2f})"
                f"  peer {peer['median']:.2f} ({peer['q1']:.2f} to {peer['q3']:.2f}){flag}",
                flush=True,
            )
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
