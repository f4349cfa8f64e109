"""The options of ``clrecon mesh`` for label maps, and the description of the surfaces of labels."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.system.text import format_volume

if TYPE_CHECKING:
    from clrecon.jobs.mesh.settings import LabelChoice


def _parse_color(text: str) -> tuple[str, str]:
    """Read ``LABEL=COLOUR``."""
    from clrecon.cli.render_values import parse_label_color  # numpy: not loaded for a help text

    return parse_label_color(text)


def add_label_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options for label maps; without `files` all labels go into one."""
    group = parser.add_argument_group("labels", "one mesh a label: the label picks the cells, HU place the vertices")
    group.add_argument(
        "--labels",
        metavar="FILE|FOLDER",
        help="label map: NIfTI, NRRD (.seg.nrrd too), MetaImage, DICOM SEG, RTSTRUCT, or a folder of masks",
    )
    group.add_argument(
        "--label", metavar="NAME|N", action="append", help="this label only; may be given again (default: all)"
    )
    group.add_argument("--hide-label", metavar="NAME|N", action="append", help="not this label; may be given again")
    group.add_argument(
        "--label-color",
        metavar="LABEL=COLOUR",
        type=_parse_color,
        action="append",
        help="colour of a label in .ply and in the formats of several objects, such as L3=orange; may be given again",
    )
    group.add_argument(
        "--surface",
        metavar="hu|mask",
        help="hu: HU place the vertices (default); mask: the label's own surface, smoothed within its voxels and with"
        " their volume, whatever the HU: organs, lungs, what HU do not show",
    )
    group.add_argument(
        "--grow",
        type=float,
        metavar="MM",
        help="dense voxels this near to a label are its own (default: one voxel each way)",
    )


def label_choice(options: argparse.Namespace) -> LabelChoice | None:
    """Make the settings of labels from the options, None without a label map."""
    if options.labels is not None:
        from clrecon.jobs.mesh.settings import LabelChoice

        surface = "hu" if options.surface is None else options.surface.lower()
        return LabelChoice(
            options.labels,
            tuple(options.label or ()),
            options.grow,
            bool(options.solid),
            surface,
            hidden=tuple(options.hide_label or ()),
            colors=tuple(options.label_color or ()),
        )
    given = {
        "--label": options.label,
        "--hide-label": options.hide_label,
        "--label-color": options.label_color,
        "--grow": options.grow is not None,
        "--surface": options.surface,
    }
    for option, value in given.items():
        if value:
            raise UsageError(f"{option} says how labels become meshes: give their file with --labels FILE")
    return None


def describe_labels(meshes: list[dict[str, Any]]) -> list[str]:
    """Describe the surfaces of labels in a line; no line without labels."""
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
