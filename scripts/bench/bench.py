#!/usr/bin/env python3
"""Benches of clrecon beside its peers: running, comparison with a stored baseline, tables and plots.

    bench.py list
    bench.py run CASE... [--input NAME]... [--device D]... --json DIR
    bench.py compare BASELINE_DIR NEW_DIR
    bench.py plot DIR -o ratios.png
    bench.py table DIR

Candidate and peer alternate in one run on the same input.  The result is the median of the ratios of the pairs (above
1: clrecon is faster) with quartiles.  Needs the extra `bench` (SimpleITK, matplotlib); VTK comes with
pyvista.  Keep the machine quiet: the results state how many cores were free.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[2])]

from compare import compare_results, format_changes  # noqa: E402
from inputs import parse_input  # noqa: E402
from measure import describe_machine, write_json  # noqa: E402
from registry import Case, Job, load_cases  # noqa: E402
from results import SCHEMA, load_results, pick, result_key, result_path  # noqa: E402
from tables import format_results, markdown, seconds  # noqa: E402

from clrecon.errors import ClreconError, UsageError  # noqa: E402
from clrecon.proof.timing import usable_cores  # noqa: E402

QUIET_SHARE = 0.85
"""Smallest share of free cores without a warning that the machine is busy."""


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of all commands and their options."""
    import inputs

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="show all cases")
    kinds = argparse.RawDescriptionHelpFormatter
    run = commands.add_parser("run", help="run cases", epilog=f"inputs: {inputs.__doc__}", formatter_class=kinds)
    run.add_argument("cases", nargs="+", metavar="CASE", help='names as "list" shows them, or all')
    run.add_argument("--input", nargs="+", action="extend", metavar="INPUT", help="see below (default spine149)")
    run.add_argument("--device", nargs="+", action="extend", metavar="D", help="as in `clrecon devices`, or all")
    run.add_argument("--hu", type=float, default=226.0, help="iso value (default 226)")
    run.add_argument("--pairs", type=int, default=15, help="timed pairs (default 15)")
    run.add_argument(
        "--peer-threads", type=int, default=usable_cores(), help="threads of the peer (default: all cores)"
    )
    run.add_argument(
        "--limit", type=float, default=120.0, metavar="S", help="no new pair after S seconds (default 120)"
    )
    run.add_argument(
        "--work", type=Path, default=default_work(), help="folder for made-up inputs (default %(default)s)"
    )
    run.add_argument("--pictures", type=Path, metavar="DIR", help="keep the pictures of both sides here, as PNG")
    run.add_argument("--json", type=Path, metavar="DIR", help="keep the results here")
    compare = commands.add_parser("compare", help="compare with a baseline; exit code 1 when a ratio fell")
    compare.add_argument("baseline", type=Path)
    compare.add_argument("new", type=Path)
    compare.add_argument("--percent", type=float, default=10.0, help="allowed fall below the spread (default 10)")
    plot = commands.add_parser("plot", help="draw ratios, and curves of each scaling result beside them")
    plot.add_argument("folder", type=Path)
    plot.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")
    table = commands.add_parser("table", help="print a markdown table")
    table.add_argument("folder", type=Path)
    for shown in (plot, table):
        shown.add_argument("--case", nargs="+", action="extend", metavar="CASE", help="only these cases")
        shown.add_argument(
            "--ratio", nargs="+", action="extend", metavar="R", help="only these ratios (all_threads, ...)"
        )
    return parser


def default_work() -> Path:
    """Return the temporary folder of this user; phantoms stay there for the next run."""
    owner = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "")
    return Path(tempfile.gettempdir()) / f"clrecon-bench-{owner}"


def choose_cases(names: list[str], cases: dict[str, Case]) -> list[Case]:
    """Return the requested cases, each once."""
    unknown = [name for name in names if name not in cases and name != "all"]
    if unknown:
        raise UsageError(f"no case {', '.join(unknown)}: use {', '.join(cases)} or all")
    return list(cases.values()) if "all" in names else [cases[name] for name in dict.fromkeys(names)]


def choose_devices(names: list[str] | None) -> list[Any]:
    """Return the requested devices; "all" means every usable device except simulators."""
    from clrecon.opencl import choose_device, list_devices

    if names and "all" in names:
        return [device for device in list_devices() if not device.is_simulator and not device.shortcoming]
    return [choose_device(name) for name in (names or [None])]  # type: ignore[list-item]


def run_cases(options: argparse.Namespace) -> int:
    """Measure every case on every input and device; returns 1 if one fails."""
    if options.pairs < 1 or options.peer_threads < 1:
        raise UsageError("--pairs and --peer-threads are 1 or more")
    cases = choose_cases(options.cases, load_cases())
    inputs = [parse_input(text, options.work) for text in options.input or ["spine149"]]
    machine = describe_machine()
    if machine["free_cores"] < QUIET_SHARE * machine["cores"]:
        print(f"warning: only {machine['free_cores']:.1f} of {machine['cores']} cores are free", file=sys.stderr)
    failed = 0
    for device in choose_devices(options.device):
        for given in inputs:
            for case in cases:
                job = Job(
                    given, options.hu, options.pairs, device, options.peer_threads, options.limit, options.pictures
                )
                print(f"{case.name} on {given.name}, {device.label} {device.driver} ...", file=sys.stderr, flush=True)
                try:
                    result = complete(case, job, machine, case.measure(job))
                except (ClreconError, RuntimeError, ImportError, MemoryError) as error:
                    print(f"{case.name} on {given.name} failed: {error}", file=sys.stderr)
                    failed += 1
                    continue
                keep(result, options.json)
    return 1 if failed else 0


def complete(case: Case, job: Job, machine: dict[str, Any], figures: dict[str, Any]) -> dict[str, Any]:
    """Make a result: the measurements with case, input, device and machine."""
    return {
        "schema": SCHEMA,
        "case": case.name,
        "description": case.description,
        "input": {"name": job.input.name, "made_up": job.input.folder is None},
        "device": job.device.describe(),
        "machine": machine,
        "parameters": {"hu": job.hu, "pairs": job.pairs, "peer_threads": job.peer_threads, "limit_s": job.limit_s},
        **figures,
    }


def keep(result: dict[str, Any], folder: Path | None) -> None:
    """Print the ratios of a result, and write it if a folder is given."""
    for name, ratio in result["ratios"].items():
        side = result.get("sides", {}).get(name)
        times = f"  {seconds(side['clrecon_s']['median'])} : {seconds(side['peer_s']['median'])}" if side else ""
        print(f"  {name:<18}{ratio['median']:6.2f}  ({ratio['q1']:.2f} to {ratio['q3']:.2f}){times}", flush=True)
    shares = result.get("kernel_percent_of_copy", {})
    for name, value in result.get("kernel_seconds", {}).items():
        share = f"{shares[name]:6.1f} % of copy bandwidth" if shares.get(name) else ""
        print(f"    {name:<28}{seconds(value):>10}{share}")
    for name, sides in result.get("resident_scratch_bytes_a_voxel", {}).items():
        print(f"    scratch, {name:<19}{sides['median']:10.3f} bytes a voxel")
    if result.get("scratch_bytes_a_voxel") is not None:
        print(f"    scratch, as summed          {result['scratch_bytes_a_voxel']:10.3f} bytes a voxel")
    for name, found in result.get("ssim", {}).items():
        print(f"    SSIM, {name:<22}{found['same_box']:10.4f}  (whole volume {found['whole_volume']:.4f})")
    if "transfer_change" in result:
        print(f"    another transfer function   {result['transfer_change']['percent_of_frame']:10.1f} % of a frame")
    for over, fits in result.get("fits", {}).items():
        print(f"    linear over {over}: R2 {fits['clrecon']['r2']:.4f} (peer {fits['peer']['r2']:.4f})")
    if folder is not None:
        write_json(result_path(folder, result), result)


def draw(options: argparse.Namespace) -> int:
    """Write the PNG files and print their names."""
    from plots import plot_ratios, plot_scaling

    results = pick(load_results(options.folder), options.case, options.ratio)
    bars = plot_ratios(results, options.output)
    print(f"{options.output}: {bars} ratios")
    for result in results.values():
        if result["case"] == "scaling":
            path = options.output.with_name("-".join([options.output.stem, *result_key(result)]) + ".png")
            plot_scaling(result, path)
            print(path)
    return 0


def compare_folders(options: argparse.Namespace) -> int:
    """Print the changes; returns 1 if a ratio fell, 2 if nothing can be compared."""
    changes, left_out = compare_results(load_results(options.baseline), load_results(options.new), options.percent)
    for text in left_out:
        print(text, file=sys.stderr)
    if not changes:
        print("nothing to compare: no case, input and device is in both folders", file=sys.stderr)
        return 2
    print(format_changes(changes))
    return 1 if any(change.fell for change in changes) else 0


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    options = make_parser().parse_args(arguments)
    try:
        if options.command == "list":
            print(markdown(("case", "what"), [(case.name, case.description) for case in load_cases().values()]))
            return 0
        if options.command == "run":
            return run_cases(options)
        if options.command == "compare":
            return compare_folders(options)
        if options.command == "plot":
            return draw(options)
        print(format_results(pick(load_results(options.folder), options.case, options.ratio)))
        return 0
    except (ClreconError, FileNotFoundError, ValueError) as error:
        print(f"bench: error: {error}", file=sys.stderr)
        return error.exit_code if isinstance(error, ClreconError) else 3


if __name__ == "__main__":
    sys.exit(main())
