"""``clrecon mesh``: from a CT series to a calibrated mesh; its options and its results in words."""

from __future__ import annotations

import argparse
from collections.abc import Container, Mapping
from typing import Any

from clrecon.cli import common
from clrecon.cli.console import Console, printable
from clrecon.jobs.mesh.purposes import settings_from
from clrecon.jobs.mesh.settings import GATE_FAILED, SCAN_GATE_FAILED, LabelChoice, MeshSettings
from clrecon.jobs.mesh.surfaces import VALUE_GATES, names_level
from clrecon.jobs.outputs import MESH_FILES, name_outputs
from clrecon.jobs.presets import PRESETS
from clrecon.system.processes import keep_freed_memory
from clrecon.system.records import describe_volume
from clrecon.system.text import count_of, format_bytes, format_digits, format_ml, format_volume

_PARTS = (
    *("device", "read", "mask", "choose", "solid", "upload", "build", "kernels", "download"),
    *("select", "cortex", "refine", "measure", "write", "other"),
)
_SHOWN_PARTS = 12

WHAT_BONE_COSTS = "in soft tissue 0.4 to 1.1 mm outside of the bone; --hu auto lies closer"
"""What the default level costs, measured by scripts/proof/measure_levels.py."""
FINE_MM = 0.5
"""In smaller voxels, of phantoms of 0.12 to 0.4 mm, it lies 0.8 voxel outside of the bone."""


def _epilog() -> str:
    width = max(map(len, PRESETS))
    lines = [f"  {p.name:<{width}}  {p.iso_value:>5g} HU  {p.description}" for p in PRESETS.values()]
    return "\n".join(
        (
            "presets:",
            *lines,
            "",
            "The mesh is in patient millimetres, by default in the DICOM frame (LPS: left, posterior, superior).",
            "It is written completely or not at all; until it is complete, an older file of that name is kept.",
            "Several meshes get different names: bone_200hu.stl, bone_001.stl, bone_200hu_001.stl.",
            "Area, volume and components take time: they are measured only with --report, --json or -v.",
            "",
            "examples:",
            "  clrecon mesh CT_FOLDER -o bone.stl",
            "  clrecon mesh CT_FOLDER -o skull.glb --hu 300 --keep-largest 1 --report skull.json",
            "  clrecon mesh CT_FOLDER -o bone.stl --hu auto",
            "  clrecon mesh CT_FOLDER -o bone.ply --surface cortex",
            "  clrecon mesh CT_FOLDER -o print.3mf --for print",
            "  clrecon mesh CT_FOLDER -o bone.stl --hu auto --keep bone --solid",
            "  clrecon mesh CT_FOLDER -o bone.stl --hu 200,350 --min-volume 1 --split",
            "  clrecon mesh CT_FOLDER -o fat.stl --hu -150:-30 --remove-table",
            "  clrecon mesh CT_FOLDER -o lung.stl --below -400 --keep-largest 2",
            "  clrecon mesh CT_FOLDER -o spine.stl --hu 226 --method i-mc --grow-from -18,-126,-448",
            "  clrecon mesh CT_FOLDER -o bone.stl --labels spine.nii.gz --label T12 --label L1",
        )
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _epilog()
    common.add_input(parser, f"{common.SCAN_FOLDER}; or {common.GRID_FILE}")
    common.add_output(parser, f"mesh file: {MESH_FILES}")
    checks = add_mesh_options(parser)
    common.add_fields(parser.add_argument_group("workers"), MeshSettings, "workers")
    common.add_report(checks, "affine, counts, quality, device and times")
    common.add_store(checks, "meshes", "Encapsulated STL")


def add_mesh_options(parser: argparse.ArgumentParser, without: Container[str] = ()) -> argparse._ArgumentGroup:
    """Add the options of a mesh but for those of labels named in `without`; return the group of the checks."""
    common.add_fields(parser, MeshSettings, "purpose")
    common.add_reading(parser)
    common.add_masking(parser, crop=True)
    common.add_fields(add_levels(parser, "surface"), MeshSettings, "kind", "surface")
    method = parser.add_argument_group("method", "variants of marching cubes that papers compare: see docs/methods.md")
    common.add_fields(method, MeshSettings, "method")
    common.add_fields(parser.add_argument_group("components"), MeshSettings, "selection", "files")
    add_labels(parser, without)
    common.add_fields(parser.add_argument_group("refinement"), MeshSettings, "refinement")
    common.add_device(parser.add_argument_group("device"))
    checks = parser.add_argument_group("checks")
    common.add_fields(checks, MeshSettings, "strict")
    common.add_no_clobber(checks)
    return checks


def add_levels(parser: argparse.ArgumentParser, title: str) -> argparse._ArgumentGroup:
    """Add the options of which values a surface encloses, and whether what is enclosed is filled."""
    group = parser.add_argument_group(title)
    common.add_fields(group.add_mutually_exclusive_group(), MeshSettings, "level")
    common.add_fields(group, MeshSettings, "inside")
    return group


def add_labels(parser: argparse.ArgumentParser, without: Container[str] = ()) -> None:
    about = "one mesh for each label: the label chooses the cells, HU place the vertices"
    common.add_fields(parser.add_argument_group("labels", about), LabelChoice, without=without)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.mesh.job import make_mesh, makes_objects

    settings = settings_from(vars(options))
    keep_freed_memory()
    report = make_mesh(
        options.input,
        options.output,
        settings,
        report_path=options.report,
        measure=bool(options.report or options.json or options.verbose),
        store=options.store,
        **common.run_options(options, console),
    )
    console.result(report)
    for line in describe_mesh(report):
        console.say(line)
    together = options.one_file or (options.all_parts and makes_objects(options.output))
    console.say(f"wrote    {_describe_files(options.output, report, together=together)}")
    for line in common.describe_stored(report):
        console.say(line)
    if options.report:
        console.say(f"report   {printable(options.report)}")
    return finish_with_gates(
        report, console, settings.strict, own_units=settings.is_for_print and names_level(settings)
    )


def describe_mesh(report: dict[str, Any]) -> list[str]:
    border = "closed" if report["closed_at_border"] else "open"
    end = "crop" if report["volume"].get("crop") else "volume"
    return [
        f"input    {describe_volume(report['volume'])}",
        f"surface  {_describe_surfaces(report)}, {border} at the border of the {end}",
        *_describe_solid(report["volume"].get("solid")),
        f"mesh     {report['vertices']:,} vertices, {report['triangles']:,} triangles",
        *_describe_quality(report),
        *describe_cortex(report["meshes"]),
        *describe_cells(report),
        *describe_labels(report["meshes"]),
        *_describe_parts(report["meshes"]),
        *describe_refinement(report["meshes"]),
        *describe_purposes(report["meshes"]),
        f"device   {printable(report['device'])}{_describe_slabs(report)}",
        f"time     {common.describe_times(report['seconds'], _PARTS)}",
    ]


def _describe_surfaces(report: dict[str, Any]) -> str:
    inside = dict.fromkeys(tuple(mesh["inside_hu"] or ()) for mesh in report["meshes"])
    if () in inside:
        return "masks of labels, whatever their HU"
    return f"{', '.join(_describe_inside(*ends) for ends in inside)} HU ({_describe_choice(report)})"


def _describe_solid(solid: dict[str, Any] | None) -> list[str]:
    if solid is None:
        return []
    left = sum(kind["ml"] for kind in solid["open"].values())
    stays = f", {format_digits(left)} ml enclosed stay open" if left >= 0.05 else ""
    share = 100.0 * solid["filled_share"]
    filled = f"{solid['filled_ml']:,.1f} ml" if solid["filled_ml"] >= 0.1 else format_ml(solid["filled_ml"])
    return [f"solid    {filled} filled, {share:.0f} % of the solid{stays}"]


def _describe_inside(low: float | None, high: float | None) -> str:
    """Describe what a surface encloses, in the form of the option."""
    if high is None:
        return f"{low:g}"
    return f"below {high:g}" if low is None else f"{low:g}:{high:g}"


def _describe_slabs(report: dict[str, Any]) -> str:
    if report["slabs"] == 1:
        return ""
    return f", {report['slabs']} slabs of at most {format_bytes(sum(report['device_bytes'].values()))}"


def _describe_choice(report: dict[str, Any]) -> str:
    choice = report["iso_value_choice"]
    if choice is None:
        if report["preset"] == "bone" and not any((mesh["cortex"] or {}).get("moved") for mesh in report["meshes"]):
            return f"preset bone: {_describe_costs(report['volume'])}"
        return f"preset {report['preset']}" if report["preset"] else "as given"
    if choice["method"] != "auto":
        return f"half way between tissue {choice['tissue_hu']:g} and bone {choice['bone_hu']:g} HU, as given"
    below = "air" if choice["background"] == "air" else "tissue"
    form = ".0f" if choice["bone_hu"] - choice["tissue_hu"] >= 10.0 else ".4g"
    tissue, bone = (format(choice[name], form) for name in ("tissue_hu", "bone_hu"))
    return f"auto: half way between {below} {tissue} and bone {bone} HU"


def _describe_costs(volume: dict[str, Any]) -> str:
    """Say what the default level costs: in mm where it was measured, voxels of half a mm and more, else in voxels."""
    if any(gate["name"] in VALUE_GATES and gate["ok"] is False for gate in volume.get("gates") or ()):
        return "a level in HU, which these values are not; --hu auto measures the level of bone"
    fine = min(volume.get("spacing_mm") or (1.0,)) < FINE_MM
    return "in soft tissue about a voxel outside of the bone; --hu auto lies closer" if fine else WHAT_BONE_COSTS


def _describe_parts(meshes: list[dict[str, Any]]) -> list[str]:
    if len(meshes) == 1:
        return []
    lines = []
    for mesh in meshes[:_SHOWN_PARTS]:
        volume = "" if mesh["volume_ml"] is None else f", {format_volume(mesh['volume_ml'])}"
        lines.append(f"         {mesh['name']}: {mesh['triangles']:,} triangles{volume}")
    if len(meshes) > _SHOWN_PARTS:
        lines.append(f"         and {len(meshes) - _SHOWN_PARTS:,} more")
    return lines


def _describe_files(output: str, report: dict[str, Any], *, together: bool) -> str:
    paths = [output] if together else name_outputs(output, [mesh["name"] or "" for mesh in report["meshes"]])
    names = [printable(str(path)) for path in (paths[0], paths[-1])]
    files = {1: names[0], 2: " and ".join(names)}.get(len(paths), f"{names[0]} to {names[1]}, {len(paths):,} files")
    return f"{files}, {format_bytes(report['output']['bytes'])}, {common.describe_space(output, report['space'])}"


def _describe_quality(report: dict[str, Any]) -> list[str]:
    if report["components"] is None:
        return []
    closed = "closed" if report["closed"] else "not closed"
    manifold = "manifold" if report["manifold"] else "not manifold"
    volume = "" if report["volume_ml"] is None else f", {format_volume(report['volume_ml'])}"
    parts = f"{report['components']:,} component{'s' * (report['components'] != 1)}"
    return [f"         {parts}, {closed}, {manifold}, {report['area_mm2']:,.0f} mm2{volume}"]


def describe_cortex(meshes: list[dict[str, Any]]) -> list[str]:
    """Describe how far the largest mesh lies or lay from the bone, in a line; no line where it was not measured."""
    fits = [mesh["cortex"] for mesh in meshes if (mesh["cortex"] or {}).get("constants")]
    if not fits:
        return []
    cortex = max(fits, key=lambda each: each["vertices"])
    outside, error = cortex["outside_mm"], cortex["error_mm"]
    walls = cortex["thickness_mm"]
    share = 100.0 * cortex["fitted"] / cortex["vertices"]
    low, high = (-outside["p95"], -outside["p5"]) if cortex["moved"] else (outside["p5"], outside["p95"])
    ends = f"5 % to 95 %: {low:+.2f} to {high:+.2f}, outward is positive"
    side = "outside" if (outside["mean"] < 0.0) == cortex["moved"] else "inside"
    if not cortex["moved"]:
        return [f"cortex   lies {abs(outside['mean']):.2f} mm {side} of the bone ({ends}), measured at {share:.0f} %"]
    return [
        f"cortex   {share:.0f} % of the vertices are fitted to the bone, {abs(outside['mean']):.2f} mm {side} of the"
        f" level ({ends}); error {error['p50']:.2f} mm (95 %: {error['p95']:.2f}), of the whole surface"
        f" {cortex['bias_mm']:.2f}; walls {walls['p50']:.1f} mm ({walls['p5']:.1f} to {walls['p95']:.1f})"
    ]


def describe_labels(meshes: list[dict[str, Any]]) -> list[str]:
    labels = [mesh for mesh in meshes if mesh["label"] is not None]
    if not labels:
        return []
    count = len({mesh["label_number"] for mesh in labels})
    if labels[0]["surface"] == "mask":
        kinds = [f"labels   {count} label{'s' * (count > 1)}, by {'their' if count > 1 else 'its'} own mask"]
        return kinds + _describe_volumes(labels)
    shares = [100.0 * mesh["vertices_by_hu_share"] for mesh in labels]
    low, high = min(shares), max(shares)
    share = f"{low:.0f}" if round(low) == round(high) else f"{low:.0f} to {high:.0f}"
    grow_mm = labels[0]["grow_mm"]
    growth = "one voxel" if grow_mm is None else f"{grow_mm:.3g} mm"
    kind = ", solid" if labels[0]["solid"] else ""
    return [
        f"labels   {count} label{'s' * (count > 1)}{kind}, grown by {growth}; HU place {share} % of the vertices",
        *_describe_volumes(labels),
    ]


def _describe_volumes(labels: list[dict[str, Any]]) -> list[str]:
    """Compare the total volume of the meshes with that of the voxels of their labels."""
    surfaces = {(mesh["label_number"], mesh["iso_value_hu"]): mesh for mesh in labels}.values()
    if any(mesh["label_mesh_ml"] is None for mesh in surfaces):
        return []
    label_ml = sum(mesh["label_compared_ml"] for mesh in surfaces)
    mesh_ml = sum(mesh["label_mesh_ml"] for mesh in surfaces)
    change = 100.0 * (mesh_ml / label_ml - 1.0)
    return [f"         {format_volume(mesh_ml)} of mesh for {format_volume(label_ml)} of labels ({change:+.1f} %)"]


def describe_cells(report: dict[str, Any]) -> list[str]:
    """Describe the cells that each grown surface visited, and what was left out; no line for whole ones."""
    lines: list[str] = []
    for mesh in report["meshes"]:
        cells, growing = mesh["cells"], mesh["growing"]
        if not growing:
            continue
        share = cells["all"] / max(cells["visited"], 1)
        sentences = [
            f"cells    {cells['visited']:,} visited, {cells['active']:,} active, {cells['all']:,} in all (1 in"
            f" {share:,.0f} visited)",
            f"grown    from {', '.join(growing['from'])}: {growing['components_taken']:,} of"
            f" {count_of(growing['components'], 'part')};"
            f" {100 * growing['cells_left_out_share']:.1f} % of the active cells left"
            f" out, the largest part of them {growing['largest_left_out_cells']:,}",
        ]
        lines += [line for line in sentences if line not in lines]
    return lines


def describe_refinement(meshes: list[dict[str, Any]]) -> list[str]:
    """Describe the changes by smoothing and decimation: those of one mesh, or the largest of several."""
    refinements = [mesh["refinement"] for mesh in meshes if mesh["refinement"]]
    if not refinements:
        return []
    worst = max(refinements, key=lambda each: each["deviation"]["hd95_mm"] / each["voxel_mm"])
    parts = []
    if "smooth" in worst:
        parts.append(_describe_smoothing(worst["smooth"]))
    if "decimate" in worst:
        parts.append(_describe_decimation(worst["decimate"]))
    deviation, voxel = worst["deviation"], worst["voxel_mm"]
    if deviation["volume_change_percent"] is not None:
        parts.append(f"volume {round(deviation['volume_change_percent'], 2) + 0.0:+.2f} %")
    which = "refined " if len(refinements) == 1 else "refined (worst mesh)"
    lengths = ", ".join(
        f"{name} {deviation[key]:.3f} mm ({deviation[key] / voxel:.2f} voxel)"
        for name, key in (("mean", "assd_mm"), ("95 % within", "hd95_mm"), ("largest", "max_mm"))
    )
    return [f"{which} {', '.join(parts)}", f"         from the surface before: {lengths}"]


def _describe_smoothing(smoothing: dict[str, Any]) -> str:
    rough, smooth = smoothing["roughness_before_mm"], smoothing["roughness_after_mm"]
    parts = [count_of(smoothing["iterations"], "iteration"), f"roughness {rough:.3f} to {smooth:.3f} mm"]
    if smoothing["components_left"]:
        parts.append(f"{count_of(smoothing['components_left'], 'component')} left unsmoothed to keep the volume")
    return f"smoothed ({'; '.join(parts)})"


def _describe_decimation(decimation: dict[str, Any]) -> str:
    asked, reached = 100 * decimation["fraction"], 100 * decimation["reached"]
    topology = _describe_topology(decimation["topology"])
    if decimation["ended_by"] == "share":
        return f"{reached:.1f} % of the triangles removed, as asked, {topology}"
    bound = f"the error bound of {format_digits(decimation['max_deviation_mm'])} mm"
    return f"{reached:.1f} % of the triangles removed; {bound} does not allow {asked:g} %; {topology}"


def _describe_topology(topology: Mapping[str, Any]) -> str:
    before, after = topology["euler_number_before"], topology["euler_number_after"]
    if not (topology["components_changed"] or topology["components_lost"]):
        return f"Euler number {before} before and after"
    parts = [f"changed in {topology['components_changed']} of {count_of(topology['components_before'], 'component')}"]
    if topology["components_lost"]:
        parts.append(f"{topology['components_lost']} lost")
    return f"Euler number {before} before, {after} after ({', '.join(parts)})"


def describe_purposes(meshes: list[dict[str, Any]]) -> list[str]:
    """Describe the facts that matter for printing the mesh; of several meshes only the first."""
    prints = [mesh["print"] for mesh in meshes if mesh.get("print")]
    if not prints:
        return []
    facts, left_out = prints[0], prints[0]["left_out"]
    which = "print    " if len(prints) == 1 else "print    (first mesh) "
    lines = [f"{which}size {' x '.join(f'{length:.1f}' for length in facts['size_mm'])} mm"]
    for of, wall in (("print", facts["wall"]), ("bone, as fitted", facts["bone_wall"])):
        if wall is not None and wall["median_mm"] is not None:
            lines.append(
                f"         walls of the {of}: {wall['median_mm']:.1f} mm (median), 5 % below"
                f" {format_digits(wall['p5_mm'], 2)} mm, {100 * wall['thin_share']:.1f} % below {wall['thin_mm']:g} mm"
                + (f", known at {100 * (1 - wall['not_measured'] / wall['samples']):.0f} %" if of != "print" else "")
            )
    pieces = f"{count_of(left_out['pieces'], 'piece')} of {format_ml(left_out['pieces_ml'])} together"
    cavities = (
        f"{count_of(left_out['cavities'], 'closed cavity', 'closed cavities')} of {format_ml(left_out['cavities_ml'])}"
    )
    if left_out["pieces"] or left_out["cavities"]:
        lines.append(f"         left out {pieces}, filled {cavities}")
    if left_out["not_bone"] is not None:
        bone = left_out["pieces"] + facts["pieces"] - left_out["not_bone"]
        lines.append(
            f"         kept {facts['pieces']:,} of {bone:,} pieces with walls like bone;"
            f" {count_of(left_out['not_bone'], 'piece')} without, or crumbs, of {format_ml(left_out['not_bone_ml'])}"
        )
    return lines


def finish_with_gates(report: dict[str, Any], console: Console, strict: bool, *, own_units: bool = False) -> int:
    """Print the warnings of a report; returns the exit code.

    With `strict` a failed gate of the volume or of a mesh is an error, which is printed even with ``--quiet`` and
    ``--json``; that of a mesh decides the code; see `find_failed`.
    """
    from clrecon.jobs.mesh.refinement import find_failed

    failed_scan, failed_mesh = find_failed(report, own_units=own_units) if strict else ([], [])
    failed = failed_scan + failed_mesh
    for warning in report["warnings"]:
        if warning not in failed:
            console.warn(warning)
    for line in failed:
        console.error(line)
    if failed_mesh:
        return GATE_FAILED
    return SCAN_GATE_FAILED if failed_scan else 0
