"""Try clrecon on a graphics card within six minutes, without a network, from the source tree.

    python scripts/gpu_check.py [--device NAME] [--reference NAME] [--out gpu-check.json]

It needs numpy, scipy, pyopencl and pydicom, and a CPU device such as PoCL to compare with.  Each step runs in a process
of its own with a limit of time, and the next one goes on whatever became of it:

- devices: what the drivers say of themselves;
- results: surfaces, clouds, clusters and pictures, byte for byte against the CPU device;
- times: surfaces, pictures and clouds of 512 x 512 x 559 voxels, by part and by kernel, with the calls of the driver;
- copies: the bandwidth of transfers, and what a launch and an allocation cost;
- selftest: every kernel against its twin.

It writes one JSON file, which holds no patient data, and a page of text, see docs/gpu.md for where to send it."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

LEVEL = 226.0
"""HU of the surfaces."""

RUNS = 7
"""Timed runs of a case, after one that warms up."""

LIMITS = {"devices": 60, "results": 120, "times": 200, "copies": 60, "selftest": 300}
"""Seconds that a step may take."""

MOST_SECONDS = 360
"""Seconds of all steps together: those that are left then have one second each."""

VOLUME = "volume.npz"
"""File beside the JSON of a step, made once for all of them."""

Keep = Callable[[dict[str, Any]], object]
"""Writes what a step has so far: its process may be ended."""


def make_volume(folder: Path, slices: int) -> Any:
    """Make a spine, 512 x 512 in each slice; more than 149 slices are the same ones mirrored."""
    import numpy as np

    from clrecon import Volume
    from clrecon.proof.phantom import PhantomSettings, make_phantom

    if not (folder / VOLUME).exists():
        settings = PhantomSettings(kind="spine", size=(512, 512), slices=149, spacing=(0.7, 0.7, 1.0))
        voxels, affine, _ = make_phantom(settings)
        np.savez(folder / VOLUME, voxels=voxels, affine=affine)
    with np.load(folder / VOLUME) as arrays:
        voxels, affine = arrays["voxels"], arrays["affine"]
    repeats = -(-slices // len(voxels))
    turned = [voxels if n % 2 == 0 else voxels[::-1] for n in range(repeats)]
    return Volume(np.concatenate(turned)[:slices], affine)


# --- what is compared -------------------------------------------------------------------------------------------------


def results(device: Any, volume: Any) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Yield the name of each result that two devices are compared in, and a function that makes its arrays."""
    import numpy as np

    import clrecon
    from clrecon.rendering.pictures.styles import Projection, SurfaceLook, VolumeLook

    band = {"hu": (LEVEL, None), "device": device}

    def surface(level: Any = LEVEL, **options: Any) -> dict[str, Any]:
        return arrays(clrecon.extract_isosurface(volume, level, device=device, **options))

    def arrays(mesh: Any) -> dict[str, Any]:
        return {"vertices": mesh.vertices, "normals": mesh.normals, "triangles": mesh.triangles}

    def picture(shown: Any, style: Any = None, **view: Any) -> dict[str, Any]:
        made = clrecon.render(shown, style, size=(256, 256), device=device, **view)
        return {"image": made.image, "depth": made.depth, "values": made.values}

    def cloud_of(kind: Any) -> dict[str, Any]:
        cloud = clrecon.extract_points(volume, kind=kind, **band)
        return {"points": cloud.points, "hu": cloud.hu}

    def label() -> dict[str, Any]:
        labels = clrecon.LabelMap((volume.voxels > 150).astype(np.uint8), volume.affine, {1: "bone"})
        return arrays(clrecon.extract_labels(volume, labels, LEVEL, device=device)[1])

    for name, options in {
        "surface": {}, "surface, open": {"closed": False}, "surface below": {"below": True},
        "surface, trilinear": {"topology": "trilinear"}, "surface, golden": {"vertex_rule": "golden"},
        "surface of the large parts": {"grow_from": "auto"}, "surface, solid": {"solid": True},
        "surface of a range": {"level": (150.0, 400.0)}, "surface in slabs": {"memory": 64 << 20},
    }.items():  # fmt: skip
        yield name, lambda options=options: surface(**options)  # type: ignore[misc]
    yield "surface of a label", label
    for kind in ("voxels", "shell"):
        yield f"cloud of {kind}", lambda kind=kind: cloud_of(kind)  # type: ignore[misc]
    yield "clusters", lambda: {"labels": clrecon.cluster_points(volume, **band).cloud.labels}
    for mode, style in {
        "volume rendering": VolumeLook("bone"), "maximum": Projection("mip"), "mean": Projection("mean"),
        "surface without a mesh": SurfaceLook(LEVEL),
    }.items():  # fmt: skip
        yield f"picture, {mode}", lambda style=style: picture(volume, style)  # type: ignore[misc]
        yield (
            f"picture, {mode}, perspective",
            lambda style=style: picture(  # type: ignore[misc]
                volume, style, view=(30, 20), view_angle=30.0
            ),
        )
    yield "slice", lambda: {"image": clrecon.cut_slice(volume, "axial", (256, 256), device=device).image}
    yield "bilateral filter", lambda: {"voxels": clrecon.filter_bilateral(volume, device=device).voxels}
    mesh = clrecon.extract_isosurface(volume, LEVEL, device=device)
    yield "picture of a mesh", lambda: picture(mesh)
    yield "decimated", lambda: arrays(clrecon.decimate_mesh(mesh, 0.5, device=device))
    cloud = clrecon.extract_points(volume, **band)
    yield "picture of a cloud", lambda: picture(cloud)
    yield "normals of points", lambda: {"normals": clrecon.estimate_normals(cloud, device=device).cloud.normals}


def step_results(device: Any, folder: Path, keep: Keep) -> dict[str, Any]:
    """Write the arrays of each result into `folder`; a result that fails is told in words."""
    import numpy as np

    told: dict[str, Any] = {}
    for name, make in results(device, make_volume(folder.parent, 60)):
        start = time.perf_counter()
        try:
            made = {key: np.ascontiguousarray(value) for key, value in make().items() if value is not None}
        except Exception as error:  # noqa: BLE001  # the next result goes on
            told[name] = {"error": f"{type(error).__name__}: {error}", "where": traceback.format_exc()[-1500:]}
            keep(told)
            continue
        file = f"{len(told)}.npz"
        np.savez(folder / file, **made)  # type: ignore[arg-type]
        digest = hashlib.sha256(b"".join(value.tobytes() for value in made.values())).hexdigest()
        told[name] = {"file": file, "sha256": digest, "seconds": round(time.perf_counter() - start, 3)}
        keep(told)
    return told


def compare(ours: dict[str, Any], theirs: dict[str, Any], folders: tuple[Path, Path]) -> dict[str, Any]:
    """Compare the results of two devices: "equal", or where they differ and by how much."""
    import numpy as np

    told: dict[str, Any] = {}
    names = [name for name, each in {**ours, **theirs}.items() if isinstance(each, dict)]
    for name in names:
        one, other = ours.get(name, {}), theirs.get(name, {})
        if "sha256" not in one or "sha256" not in other:
            told[name] = one.get("error") or other.get("error") or "not reached on one of the devices"
        elif one["sha256"] == other["sha256"]:
            told[name] = "equal"
        else:
            with np.load(folders[0] / one["file"]) as left, np.load(folders[1] / other["file"]) as right:
                told[name] = {key: _difference(left[key], right[key]) for key in left.files if key in right.files}
    return told


def _difference(left: Any, right: Any) -> str:
    import numpy as np

    if left.shape != right.shape:
        return f"{left.shape} is not {right.shape}"
    unequal = ~((left == right) | ((left != left) & (right != right)))
    if not unequal.any():
        return "equal"
    with np.errstate(all="ignore"):
        apart = np.abs(left.astype(np.float64) - right)
    return f"{int(unequal.sum()):,} of {left.size:,} differ, by at most {np.nanmax(apart):.3g}"


# --- what is timed ----------------------------------------------------------------------------------------------------


def timed(run: Callable[[], Any], runs: int = RUNS) -> dict[str, Any]:
    """Time a case after a run that warms up; with the parts and kernels that reports know, as medians, and the calls of
    the last run.
    """
    from counted_calls import counting_calls

    seconds: list[float] = []
    reports: list[dict[str, Any]] = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        made = run()
        seconds.append(time.perf_counter() - start)
        reports.append(getattr(made, "report", None) or {})
        del made
    with counting_calls() as counts:
        run()
    first, ordered = seconds[0], sorted(seconds[1:])

    def middle(what: str) -> dict[str, float]:
        tables = [report.get(what, {}) for report in reports[1:]]
        names = dict.fromkeys(name for table in tables for name in table)
        return {name: round(1e3 * median(table.get(name, 0.0) for table in tables), 3) for name in names}

    return {
        "first_ms": round(1e3 * first, 2), "median_ms": round(1e3 * median(ordered), 2),
        "quartiles_ms": [round(1e3 * ordered[len(ordered) // 4], 2), round(1e3 * ordered[-1 - len(ordered) // 4], 2)],
        "parts_ms": middle("seconds"), "kernels_ms": middle("kernel_seconds"), "calls": dict(counts),
    }  # fmt: skip


def turning(renderer: Any, style: Any, size: int) -> Callable[[], Any]:
    """Return a function that makes a picture, each time from another side."""
    angles = iter(range(0, 10000, 7))
    return lambda: renderer.render(style, view=(next(angles), 10), size=(size, size))


def step_times(device: Any, folder: Path, slices: int, keep: Keep) -> dict[str, Any]:
    """Time surfaces, pictures and clouds."""
    import clrecon
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.rendering.pictures.styles import Projection, SurfaceLook, VolumeLook

    volume = make_volume(folder, slices)
    told: dict[str, Any] = {"voxels": list(volume.shape_ijk)}

    def attempt(name: str, run: Callable[[], Any], runs: int = RUNS) -> None:
        try:
            told[name] = timed(run, runs)
        except Exception as error:  # noqa: BLE001  # the next case goes on
            told[name] = {"error": f"{type(error).__name__}: {error}"}
        keep(told)

    levels = iter(LEVEL + 7.0 * n for n in range(1000))
    attempt("cold isosurface", lambda: clrecon.extract_isosurface(volume, LEVEL, device=device))
    mesh = clrecon.extract_isosurface(volume, LEVEL, device=device)
    told["mesh"] = {"vertices": len(mesh.vertices), "triangles": len(mesh.triangles)}
    with clrecon.SurfaceExtractor(volume, device=device) as extractor:
        attempt("new iso value, resident", lambda: extractor.extract(next(levels)))
    with clrecon.VolumeRenderer(volume, device=device) as renderer:
        for size in (512, 1024):
            for mode, style in {
                "bone": VolumeLook("bone"), "spine": VolumeLook("spine"), "mip": Projection("mip"),
                "surface": SurfaceLook(LEVEL),
            }.items():  # fmt: skip
                attempt(f"frame of {mode}, {size} x {size}", turning(renderer, style, size))
    attempt("picture, cold", lambda: clrecon.render(volume, VolumeLook("bone"), size=(1024, 1024), device=device), 3)
    with DeviceVolume(volume, device=device) as resident:
        attempt("cloud of voxels", lambda: clrecon.extract_points(resident, hu=(LEVEL, None)), 3)
        attempt("cloud of a shell", lambda: clrecon.extract_points(resident, kind="shell", hu=(LEVEL, None)), 3)
        attempt("clusters of voxels", lambda: clrecon.cluster_points(resident, hu=(LEVEL, None)), 3)
    part = make_volume(folder, 149)
    attempt("bilateral filter, 149 slices", lambda: clrecon.filter_bilateral(part, device=device), 2)
    attempt("decimation to a half", lambda: clrecon.decimate_mesh(mesh, 0.5, device=device), 1)
    return told


def step_copies(device: Any) -> dict[str, Any]:
    """Measure transfers of 256 MiB in GB/s, pageable and pinned, and what a launch and an allocation cost in us."""
    import numpy as np
    import pyopencl as cl

    context, queue, size = device.context, device.queue, 256 << 20
    flags = cl.mem_flags
    one, two = (cl.Buffer(context, flags.READ_WRITE, size) for _ in range(2))
    pinned_d = cl.Buffer(context, flags.READ_WRITE | flags.ALLOC_HOST_PTR, size)
    mode = cl.map_flags.READ | cl.map_flags.WRITE
    pinned, _ = cl.enqueue_map_buffer(queue, pinned_d, mode, 0, (size,), np.uint8)
    pageable, fresh = np.ones(size, np.uint8), []

    def rate(run: Callable[[], Any], moved: int = size) -> float:
        run()
        queue.finish()
        spent = []
        for _ in range(5):
            start = time.perf_counter()
            run()
            queue.finish()
            spent.append(time.perf_counter() - start)
        return round(1e-9 * moved / min(spent), 2)

    def read_fresh() -> None:
        fresh.append(np.empty(size, np.uint8))
        cl.enqueue_copy(queue, fresh[-1], one)

    def cost(run: Callable[[], Any], times: int = 200) -> float:
        run()
        queue.finish()
        start = time.perf_counter()
        for _ in range(times):
            run()
        queue.finish()
        return round(1e6 * (time.perf_counter() - start) / times, 2)

    four = np.zeros(1, np.uint32)

    def allocate(size: int) -> None:
        buffer = cl.Buffer(context, flags.READ_WRITE, size)
        cl.enqueue_fill_buffer(queue, buffer, four, 0, 4)
        queue.finish()
        buffer.release()

    def upload() -> None:
        from clrecon.opencl.transfers import write_buffer

        write_buffer(device, pageable, one)

    def read() -> None:
        from clrecon.opencl.transfers import read_buffers

        read_buffers(device, [(pageable, one, 0)])

    return {
        "GB/s": {
            "upload, pageable": rate(lambda: cl.enqueue_copy(queue, one, pageable)),
            "upload, with its buffer": rate(
                lambda: cl.Buffer(context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=pageable)
            ),
            "upload, pinned": rate(lambda: cl.enqueue_copy(queue, one, pinned)),
            "upload, as clrecon does": rate(upload),
            "read, as clrecon does, used pages": rate(read),
            "read, used pages": rate(lambda: cl.enqueue_copy(queue, pageable, one)),
            "read, fresh pages": rate(read_fresh),
            "read, pinned": rate(lambda: cl.enqueue_copy(queue, pinned, one)),
            "copy on the device, read and written": rate(lambda: cl.enqueue_copy(queue, two, one), 2 * size),
            "copy of numpy, read and written": rate(lambda: np.copyto(fresh[0], pageable), 2 * size),
        },
        "us": {
            "launch": cost(lambda: cl.enqueue_fill_buffer(queue, one, four, 0, 4)),
            "launch and wait": cost(lambda: cl.enqueue_fill_buffer(queue, one, four, 0, 4).wait()),
            "read of 4 bytes": cost(lambda: cl.enqueue_copy(queue, four, one)),
            "allocation of 4 KiB, used": cost(lambda: allocate(4096)),
            "allocation of 64 MiB, used": cost(lambda: allocate(64 << 20), 20),
        },
    }


def step_devices(device: Any) -> dict[str, Any]:
    """Return what the driver says of the device."""
    cl_device = device.cl_device
    asked = (
        "name", "vendor", "version", "driver_version", "opencl_c_version", "extensions", "max_clock_frequency",
        "max_compute_units", "global_mem_size", "global_mem_cache_size", "local_mem_size", "max_mem_alloc_size",
        "max_work_group_size", "host_unified_memory", "mem_base_addr_align", "profiling_timer_resolution",
        "preferred_vector_width_float", "svm_capabilities", "max_constant_buffer_size", "address_bits",
        "warp_size_nv", "registers_per_block_nv", "compute_capability_major_nv", "compute_capability_minor_nv",
    )  # fmt: skip
    told = {}
    for name in asked:
        try:
            told[name] = getattr(cl_device, name)
        except Exception as error:  # noqa: BLE001  # drivers do not know all of them
            told[name] = f"({type(error).__name__})"
    return {
        **device.describe(), "shares_host_memory": device.shares_host_memory, "variants": device.kernel_variants,
        "group_size": device.group_size, "driver says": told,
    }  # fmt: skip


def step_selftest(device: Any) -> dict[str, Any]:
    """Compare every kernel with its twin."""
    from clrecon.proof.run import CHECKS, run_selftest

    rows = list(run_selftest(device, CHECKS, silent_seconds=120.0))
    return {"failed": [row for row in rows if not row["passed"]], "checks": rows}


# --- the parent -------------------------------------------------------------------------------------------------------


def work(step: str, name: str, out: Path, slices: int) -> None:
    """Do one step in this process and write its JSON."""
    from clrecon.opencl import choose_unchecked

    device = choose_unchecked(name)
    device.fault = ""  # the self-test says what is wrong

    def keep(told: dict[str, Any]) -> None:
        half = out.with_suffix(".half")
        half.write_text(json.dumps({"device": device.label, **told}, default=str))
        half.replace(out)

    if step == "results":
        out.with_suffix("").mkdir()
        keep(step_results(device, out.with_suffix(""), keep))
    elif step == "times":
        keep(step_times(device, out.parent, slices, keep))
    else:
        keep({"devices": step_devices, "copies": step_copies, "selftest": step_selftest}[step](device))


def start(step: str, name: str, out: Path, slices: int) -> subprocess.Popen[bytes]:
    """Start a process for a step; what it prints goes beside its JSON."""
    options = [f"--step={step}", f"--device={name}", f"--out={out}", f"--slices={slices}"]
    command = [sys.executable, "-X", "faulthandler", __file__, *options]
    with open(out.with_suffix(".log"), "wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)


def finish(process: subprocess.Popen[bytes], out: Path, since: float, limit: float) -> dict[str, Any]:
    """Wait for a step, and return its JSON or what became of it."""
    how = ""
    try:
        process.wait(limit)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        how = f"not done within {limit:.0f} s"
    told: dict[str, Any]
    try:
        told = json.loads(out.read_text())
    except (OSError, ValueError):
        told, how = {}, how or "no result"
    if how or process.returncode:
        tail = out.with_suffix(".log").read_text(errors="replace")[-3000:]
        told |= {"error": how or f"exit code {process.returncode}", "output": tail}
    return {**told, "step_seconds": round(time.perf_counter() - since, 1)}


def check(device: str, reference: str, slices: int) -> dict[str, Any]:
    """Run all steps; those that are timed run alone."""
    begin = time.perf_counter()
    told: dict[str, Any] = {"python": sys.version.split()[0], "cores": os.cpu_count(), "steps": {}}
    steps = told["steps"]
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)

        def run(step: str, name: str, key: str) -> dict[str, Any]:
            out, since = folder / f"{len(steps)}.json", time.perf_counter()
            limit = max(1.0, min(LIMITS[step], begin + MOST_SECONDS - since))
            steps[key] = finish(start(step, name, out, slices), out, since, limit)
            print(f"{time.perf_counter() - begin:6.1f} s  {key}: {steps[key].get('error', 'done')}", flush=True)
            return {**steps[key], "folder": out.with_suffix("")}

        run("devices", device, "device")
        run("devices", reference, "reference")
        make_volume(folder, 1)
        run("copies", device, "copies")
        run("times", device, "times")
        ours, theirs = run("results", device, "results"), run("results", reference, "results of the reference")
        told["comparison"] = compare(ours, theirs, (ours["folder"], theirs["folder"]))
        run("selftest", device, "selftest")
        run("times", reference, "times of the reference")
    told["seconds"] = round(time.perf_counter() - begin, 1)
    return told


def page(told: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the page of text."""
    steps = told["steps"]
    for key in ("device", "reference"):
        each = steps[key]
        yield f"{key:10} {each.get('name')}, {each.get('platform')}, driver {each.get('driver')}"
    test = steps["selftest"]
    checks, failed = test.get("checks", []), test.get("failed", [])
    yield f"self-test  {len(checks) - len(failed)} of {len(checks)} pass"
    for row in failed:
        yield f"  FAIL {row['operator']}: {row['detail']}"
    equal = [name for name, how in told["comparison"].items() if how == "equal"]
    yield f"results    {len(equal)} of {len(told['comparison'])} are the reference's byte for byte"
    for name, how in told["comparison"].items():
        if name not in equal:
            yield f"  {name}: {how}"
    yield "times, ms: device, reference; the device's parts, kernels and calls"
    other = steps["times of the reference"]
    for name, each in steps["times"].items():
        if isinstance(each, dict) and "median_ms" in each:
            peer = other.get(name, {}).get("median_ms", "-")
            yield f"  {name}: {each['median_ms']} (first {each['first_ms']}), {peer}"
            for what in ("parts_ms", "kernels_ms", "calls"):
                yield f"      {each[what]}"
        elif isinstance(each, dict):
            yield f"  {name}: {each}"
    for unit in ("GB/s", "us"):
        for name, value in steps["copies"].get(unit, {}).items():
            yield f"  {name}: {value} {unit}"
    for key, each in steps.items():
        if "error" in each:
            yield f"{key}: {each['error']}\n{each.get('output', '')}"
    yield f"all of it  {told['seconds']} s"


def main() -> None:
    """Run the check, or with ``--step`` one step of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="gpu", help="index or part of the name, as for clrecon (default: gpu)")
    parser.add_argument("--reference", default="cpu", help="the device to compare with (default: cpu)")
    parser.add_argument("--out", type=Path, default=Path("gpu-check.json"), help="JSON file (default: gpu-check.json)")
    parser.add_argument("--slices", type=int, default=559, help="slices of the volume that is timed (default: 559)")
    parser.add_argument("--step", choices=LIMITS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.step:
        work(options.step, options.device, options.out, options.slices)
        return
    told = check(options.device, options.reference, options.slices)
    options.out.write_text(json.dumps(told, indent=1, default=str) + "\n")
    text = "\n".join(page(told))
    options.out.with_suffix(".txt").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
