"""Settings and inputs of a view: scans, meshes, clouds and a label map, each read as the other jobs read it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import RefusedInputError, UsageError
from clrecon.exchange.formats import MESH_INPUTS
from clrecon.geometry import Volume
from clrecon.jobs.distance import read_side
from clrecon.jobs.inputs import crop_labels, holds_triangles, is_cloud_file, refuse_other_clouds
from clrecon.jobs.mesh.labels import open_labels
from clrecon.jobs.options import InputSettings, changed_fields
from clrecon.jobs.preprocess import mask_volume, preprocess_volume, restrict_volume
from clrecon.jobs.view import ViewSettings
from clrecon.mesh import Mesh
from clrecon.points.cloud_reader import read_points
from clrecon.reading import read_selected, tell_format
from clrecon.system.arguments import Space, name_parameter
from clrecon.system.light_dataclass import dataclass, field, fields
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import escape_text

if TYPE_CHECKING:
    from clrecon.labels import LabelMap
    from clrecon.points.cloud import PointCloud


_OF_A_VIEW = {"iso_value", "preset", "half_way", "space", "labels", "one_file"}
"""Settings of meshes that a view has a meaning for; a label map sets the last one by itself."""


def check_view_settings(settings: ViewSettings) -> None:
    """Refuse settings that a view has no meaning for, before anything is read."""
    scan = settings.scan
    ignored = {own.name for own in fields(InputSettings)} | _OF_A_VIEW
    if scan.surface == "cortex":
        ignored.add("surface")
    for name in changed_fields(scan):
        if name not in ignored:
            raise UsageError(
                f"{name_parameter(name)} says how a mesh is made, and a view makes none: leave it out, or write a"
                " page instead"
            )
    if isinstance(scan.iso_value, Sequence) and (len(scan.levels) != 1 or isinstance(scan.levels[0], tuple)):
        raise UsageError("a view begins with one iso value: give one, and move the slider")


Reader = Callable[..., Volume]

_MOST_LABELS = 1000
"""Values up to which whole numbers from 0 are taken for labels; air of a CT is negative."""

_LEAST_EMPTY = 0.2
"""Least share of voxels without a label."""


@dataclass(frozen=True, eq=False)
class OpenedInput:
    """What was read of an input; `said`: warnings of its certificate, and the frame that it was turned from."""

    subject: Volume | Mesh | PointCloud | LabelMap
    said: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)


def open_inputs(
    inputs: Sequence[str | Path],
    settings: ViewSettings | None = None,
    *,
    progress: Progress | None = None,
    ready: Callable[[OpenedInput], None] | None = None,
    read: Reader = read_selected,
) -> list[OpenedInput]:
    """Read the inputs of a view, its label map last; `ready` gets each as soon as it is read, a scan by `read`."""
    settings, tell = settings or ViewSettings(), progress or ignore_progress
    labels = settings.scan.labels
    if not inputs and labels is None:
        raise UsageError("there is nothing to show: name a scan, a mesh, a cloud or a label map")
    kinds = [_tell_kind(path) for path in inputs]
    if labels is not None and kinds.count("scan") > 1:
        raise UsageError(f"a label map belongs to one scan, {kinds.count('scan')} are given")
    readers: dict[str, Callable[[str | Path], OpenedInput]] = {
        "mesh": partial(_open_mesh, space=settings.mesh_space),
        "cloud": partial(_open_cloud, space=settings.mesh_space),
        "scan": partial(_open_scan, settings=settings, progress=tell, read=read),
    }
    by_position: dict[int, OpenedInput] = {}
    for position in sorted(range(len(inputs)), key=lambda place: kinds[place] == "scan"):
        tell("read", len(by_position), len(inputs))
        by_position[position] = readers[kinds[position]](inputs[position])
        if ready is not None:
            ready(by_position[position])
    opened = [by_position[place] for place in range(len(inputs))]
    if labels is not None:
        scans = (each.subject for each in opened if isinstance(each.subject, Volume))
        opened.append(_open_labels(settings, next(scans, None)))
        if ready is not None:
            ready(opened[-1])
    return opened


def _tell_kind(path: str | Path) -> str:
    """Return "mesh", "cloud" or "scan" by the extension; a PLY or VTP file with faces is a mesh."""
    file = Path(path)
    refuse_other_clouds(path)
    suffix = file.suffix.lower()
    if file.name.lower().endswith(".view.json"):
        advice = f"name the scan that it was saved of, and this file with {name_parameter('state')}"
        raise UsageError(f"{escape_text(file.name)} is a saved view, without voxels: {advice}")
    if suffix not in MESH_INPUTS and not is_cloud_file(file):
        return "scan"
    if not file.is_file():
        raise UsageError(f"{escape_text(str(path), 200)}: there is no file of that name")
    return "mesh" if holds_triangles(file) else "cloud"


def _describe_frame(name: str, file: dict[str, Any]) -> tuple[str, ...]:
    turned = () if file["space"] == "LPS" else (f"{name} was turned from {file['space']} to LPS",)
    return (*turned, *file["warnings"])


def read_shown_mesh(path: str | Path, space: Space | None) -> tuple[Mesh, str]:
    """Read a mesh in which there is something to show; return also the name of its file."""
    mesh, name = read_side(path, space), escape_text(Path(path).name)
    if not mesh.triangle_count:
        raise RefusedInputError(f"{name} has no triangle: there is nothing to show")
    return mesh, name


def _open_mesh(path: str | Path, space: Space | None) -> OpenedInput:
    mesh, name = read_shown_mesh(path, space)
    return OpenedInput(mesh, _describe_frame(name, mesh.report["file"]), dict(mesh.report["file"]))


def _open_cloud(path: str | Path, space: Space | None) -> OpenedInput:
    cloud = read_points(path)
    if space is not None and cloud.report["file"]["space_from"] == "assumed":
        cloud = read_points(path, space=space)
    file, name = cloud.report["file"], escape_text(Path(path).name)
    assumed = file["space_from"] == "assumed"
    notes = (f"{name} names no patient frame: its coordinates are taken as LPS",) if assumed else ()
    return OpenedInput(cloud, (*_describe_frame(name, file), *notes), dict(file))


def _open_scan(path: str | Path, settings: ViewSettings, progress: Progress, read: Reader) -> OpenedInput:
    """Read a scan, and mask and crop it; a file of whole numbers from 0 is a label map."""
    from clrecon.labels.reader import is_dicom_map, read_labels

    scan, name = settings.scan, escape_text(Path(path).name)
    if tell_format(path) is None and is_dicom_map(path):
        labels = read_labels(path)
        return OpenedInput(labels, labels.warnings)
    volume = read(path, scan, progress=progress)
    if tell_format(path) is not None and _holds_labels(volume):
        labels = read_labels(path)
        note = f"{name} is taken for a label map: its values are whole numbers from 0"
        return OpenedInput(labels, (note, *labels.warnings))
    volume = mask_volume(volume, scan, progress)
    if scan.crop is not None or scan.region or scan.preprocess is not None:
        from clrecon.operators import take_device

        device = take_device(scan.device)
        volume = restrict_volume(volume, scan, device, [], progress)
        volume = preprocess_volume(volume, scan, device, [], progress)
    return OpenedInput(volume, tuple(volume.report.get("warnings", ())), dict(volume.report))


def _holds_labels(volume: Volume) -> bool:
    """True for whole numbers from 0, many of them 0, as no scan in HU has."""
    if volume.voxels.dtype.kind not in "iu":
        return False
    low, high = volume.hu_range or (0.0, 0.0)
    if low != 0.0 or not 1.0 <= high <= _MOST_LABELS:
        return False
    return float((volume.voxels == 0).mean()) >= _LEAST_EMPTY


def _open_labels(settings: ViewSettings, scan: Any) -> OpenedInput:
    labels = open_labels(settings.scan.labels, scan, follow_links=settings.scan.follow_links)
    assert labels is not None
    labels = crop_labels(labels, settings.scan.crop, settings.scan.space)
    return OpenedInput(labels, labels.warnings)
