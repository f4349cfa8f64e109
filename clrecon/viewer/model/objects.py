"""What a view shows: scans, meshes, clouds and label maps, the modes of scans, and what they show at the start."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from clrecon.errors import UsageError
from clrecon.exchange.content import certificate_lines
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.labels import LabelMap
from clrecon.mesh import Mesh
from clrecon.mesh.triangles import vertex_normals
from clrecon.points.cloud import PointCloud
from clrecon.rendering.looks.presets import PRESETS
from clrecon.rendering.pictures.label_style import distinct_colors
from clrecon.rendering.views.camera import box_corners
from clrecon.rendering.views.directions import as_point
from clrecon.system.light_dataclass import dataclass
from clrecon.system.records import describe_volume
from clrecon.viewer.model.state import ShownPart

if TYPE_CHECKING:
    from clrecon.jobs.view.inputs import OpenedInput


@dataclass(frozen=True)
class ViewMode:
    """A mode; `words` say what is seen.

    kind: "surface", "volume" (volume rendering), "projection", "slices" or "labels".
    style: Name of the preset or of the projection.
    joins: Other objects are shown with it in one picture.
    window: HU of black and white of a projection; None: chosen from the picture.
    """

    name: str
    words: str
    kind: str
    style: str = ""
    joins: bool = True
    window: tuple[float, float] | None = None

    @property
    def is_dark(self) -> bool:
        """True where black is behind the picture on light pages too, on which translucent tissue looks washed out."""
        return self.kind in ("volume", "projection", "slices")


@cache
def find_modes() -> dict[str, ViewMode]:
    modes = [ViewMode("surface", "the surface at the iso value", "surface")]
    modes += [
        ViewMode(preset.name, preset.description, "volume", preset.name)
        for preset in PRESETS.values()
        if preset.mode == "dvr"
    ]
    modes += [
        ViewMode(
            preset.mode, preset.description.partition(" (mode")[0], "projection", preset.mode, False, preset.window
        )
        for preset in PRESETS.values()
        if preset.mode != "dvr"
    ]
    modes.append(ViewMode("slices", "translucent slices in space", "slices"))
    modes.append(ViewMode("labels", "the labels alone, as solid shapes", "labels"))
    return {mode.name: mode for mode in modes}


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownObject:
    """One input of a view, in LPS mm.  Its name is shown and no file's, which can hold the name of a patient."""

    kind: ClassVar[str]
    number: int
    name: str
    said: tuple[str, ...] = ()

    @property
    def corners(self) -> Float64Array:
        """Points whose convex hull holds the object, (n, 3) in LPS mm."""
        raise NotImplementedError


_SAMPLED_SLICES, _BARS = 16, 100
"""Of the histogram of a scan."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownScan(ShownObject):
    """A scan: shown as a surface, by volume rendering, as a projection or in slices."""

    kind = "scan"
    volume: Volume

    @property
    def corners(self) -> Float64Array:
        return box_corners(self.volume)

    def describe_scan(self, low: float, high: float) -> dict[str, Any]:
        """Return what a page says of a scan: size, gates, certificate, and the histogram between two HU."""
        report, voxels = self.volume.report, self.volume.voxels
        judged = [gate["ok"] for gate in report.get("gates") or () if gate["ok"] is not None]
        sample = voxels[:: max(1, len(voxels) // _SAMPLED_SLICES), ::4, ::4]
        return {
            "name": self.name,
            "words": describe_volume(report),
            "position": report.get("patient_position"),
            "gates": [sum(judged), len(judged)],
            "certificate": certificate_lines(report),
            "counts": np.histogram(sample, bins=_BARS, range=(low, high))[0].tolist(),
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownMesh(ShownObject):
    """A mesh; it has normals, so that they are not made again for each picture."""

    kind = "mesh"
    mesh: Mesh

    @property
    def corners(self) -> Float64Array:
        return _box(self.mesh.vertices)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownCloud(ShownObject):
    kind = "cloud"
    cloud: PointCloud

    @property
    def corners(self) -> Float64Array:
        return _box(self.cloud.points)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownLabels(ShownObject):
    """A label map: it colours and divides the scan of number `within`, or is shown alone."""

    kind = "labels"
    labels: LabelMap
    within: int | None = None

    @property
    def corners(self) -> Float64Array:
        return box_corners(self.labels)


def _box(points: Any) -> Float64Array:
    return np.array([points.min(axis=0), points.max(axis=0)], dtype=np.float64)


def show_objects(
    subjects: Sequence[Volume | Mesh | PointCloud | LabelMap],
    names: Sequence[str] = (),
    said: Sequence[Sequence[str]] = (),
) -> list[ShownObject]:
    """Number and name what was read or made, "scan 1" by default; a label map belongs to the first scan."""
    if not subjects:
        raise UsageError("there is nothing to show")
    scan = next((number for number, each in enumerate(subjects, start=1) if isinstance(each, Volume)), None)
    shown: list[ShownObject] = []
    for number, subject in enumerate(subjects, start=1):
        given = names[number - 1] if number <= len(names) else ""
        notes = tuple(said[number - 1]) if number <= len(said) else ()

        def own(kind: str, given: str = given, number: int = number, lines: tuple[str, ...] = notes) -> dict[str, Any]:
            return {"number": number, "name": given or f"{kind} {number}", "said": lines}

        if isinstance(subject, Volume):
            shown.append(ShownScan(**own("scan"), volume=subject))
        elif isinstance(subject, Mesh):
            shown.append(ShownMesh(**own("mesh"), mesh=_with_normals(subject)))
        elif isinstance(subject, PointCloud):
            if not len(subject):
                raise UsageError(f"{own('cloud')['name']} has no points: there is nothing to show")
            shown.append(ShownCloud(**own("cloud"), cloud=subject))
        elif isinstance(subject, LabelMap):
            shown.append(ShownLabels(**own("labels"), labels=subject, within=scan))
        else:
            raise UsageError(f"a view shows a Volume, Mesh, PointCloud or LabelMap, not {type(subject).__name__}")
    return shown


def _with_normals(mesh: Mesh) -> Mesh:
    if not mesh.triangle_count:
        raise UsageError("a mesh has no triangle: there is nothing to show")
    if mesh.normals is not None:
        return mesh
    normals = vertex_normals(mesh.vertices, mesh.triangles)
    return Mesh(mesh.vertices, mesh.triangles, normals, dict(mesh.report), trusted=True)


def wrap_inputs(inputs: Sequence[OpenedInput], names: Sequence[str] = ()) -> list[ShownObject]:
    """Wrap what `clrecon.jobs.view.inputs.open_inputs` has read."""
    return show_objects([each.subject for each in inputs], names, [each.said for each in inputs])


_ISO_ENDS = (-1000.0, 2000.0)
"""Ends of the slider, as far as the values of the scan go: air, and dense cortex."""


def first_parts(objects: Sequence[ShownObject]) -> list[ShownPart]:
    """Return the objects as wholes, and the labels of label maps."""
    parts = []
    for item in objects:
        count: int | None = None
        if isinstance(item, ShownMesh):
            count = item.mesh.triangle_count
        elif isinstance(item, ShownCloud):
            count = len(item.cloud)
        parts.append(ShownPart(key=str(item.number), name=item.name, kind=item.kind, object=item.number, count=count))
        if isinstance(item, ShownLabels):
            parts += _label_parts(item)
    return parts


def _label_parts(shown: ShownLabels) -> list[ShownPart]:
    """Return a part for each label, and within a scan one for what has none."""
    labels = shown.labels
    voxel_ml = abs(float(np.linalg.det(labels.affine[:3, :3]))) / 1000.0
    colors = distinct_colors(len(labels.numbers))
    parts = [
        ShownPart(
            key=f"{shown.number}/{number}", name=labels.name(number), kind="label", object=shown.number,
            number=number, ml=voxels * voxel_ml, count=voxels, color=as_point(color),
        )
        for (number, voxels), color in zip(labels.counts.items(), colors, strict=True)
    ]  # fmt: skip
    if shown.within is not None:
        parts.append(ShownPart(key=f"{shown.number}/0", name="without a label", kind="rest", object=shown.number))
    return parts


def find_iso_range(scans: Sequence[ShownScan]) -> tuple[float, float]:
    """Return the ends of the slider: values that some scan has."""
    ranges = [each.volume.hu_range for each in scans]
    known = [each for each in ranges if each is not None]
    if not known:
        return _ISO_ENDS
    low, high = min(each[0] for each in known), max(each[1] for each in known)
    first, last = max(low, _ISO_ENDS[0]), min(high, _ISO_ENDS[1])
    return (float(math.ceil(first)), float(math.floor(last))) if math.ceil(first) < math.floor(last) else (low, high)
