"""What a view shows: scans, meshes, clouds and label maps, read once and shared by all views of a process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.labels import LabelMap
from clrecon.mesh import Mesh
from clrecon.points import PointCloud
from clrecon.rendering.views.camera import box_corners

if TYPE_CHECKING:
    from clrecon.jobs.view.inputs import OpenedInput


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownObject:
    """One input of a view, in LPS mm.  It does not change.

    number: From 1, in the order of the inputs.
    name: Shown in lists.  No file name: it can hold the name of a patient.
    said: What has to be said of it, such as that it was turned from RAS.
    """

    number: int
    name: str
    said: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """ "scan", "mesh", "cloud" or "labels"."""
        raise NotImplementedError

    @property
    def corners(self) -> Float64Array:
        """Points whose convex hull holds the object, (n, 3) in LPS mm."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownScan(ShownObject):
    """A scan: shown as a surface, by volume rendering, as a projection or in slices."""

    volume: Volume

    @property
    def kind(self) -> str:
        return "scan"

    @property
    def corners(self) -> Float64Array:
        return box_corners(self.volume)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownMesh(ShownObject):
    """A mesh; it has normals, so that they are not made again for each picture."""

    mesh: Mesh

    @property
    def kind(self) -> str:
        return "mesh"

    @property
    def corners(self) -> Float64Array:
        return _box(self.mesh.vertices)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownCloud(ShownObject):
    """A cloud of points."""

    cloud: PointCloud

    @property
    def kind(self) -> str:
        return "cloud"

    @property
    def corners(self) -> Float64Array:
        return _box(self.cloud.points)


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownLabels(ShownObject):
    """A label map: it colours and divides the scan that it lies in, or is shown alone.

    within: Number of the scan that it lies in.
    """

    labels: LabelMap
    within: int | None = None

    @property
    def kind(self) -> str:
        return "labels"

    @property
    def corners(self) -> Float64Array:
        return box_corners(self.labels)


def _box(points: Any) -> Float64Array:
    """Return the corners of the box around points."""
    return np.array([points.min(axis=0), points.max(axis=0)], dtype=np.float64)


def show_objects(
    subjects: Sequence[Volume | Mesh | PointCloud | LabelMap],
    names: Sequence[str] = (),
    said: Sequence[Sequence[str]] = (),
) -> list[ShownObject]:
    """Number and name what was read or made.

    subjects: A label map belongs to the first scan, if there is one.
    names: Names in their order; those that are missing or empty are "scan 1", "mesh 2" and so on.
    said: What has to be said of each.
    """
    if not subjects:
        raise UsageError("there is nothing to show")
    scan = next((number for number, each in enumerate(subjects, start=1) if isinstance(each, Volume)), None)
    made: list[ShownObject] = []
    for number, subject in enumerate(subjects, start=1):
        given = names[number - 1] if number <= len(names) else ""
        told = tuple(said[number - 1]) if number <= len(said) else ()

        def own(kind: str, given: str = given, number: int = number, told: tuple[str, ...] = told) -> dict[str, Any]:
            return {"number": number, "name": given or f"{kind} {number}", "said": told}

        if isinstance(subject, Volume):
            made.append(ShownScan(**own("scan"), volume=subject))
        elif isinstance(subject, Mesh):
            made.append(ShownMesh(**own("mesh"), mesh=_with_normals(subject)))
        elif isinstance(subject, PointCloud):
            if not len(subject):
                raise UsageError(f"{own('cloud')['name']} has no points: there is nothing to show")
            made.append(ShownCloud(**own("cloud"), cloud=subject))
        elif isinstance(subject, LabelMap):
            made.append(ShownLabels(**own("labels"), labels=subject, within=scan))
        else:
            raise UsageError(f"a view shows a Volume, Mesh, PointCloud or LabelMap, not {type(subject).__name__}")
    return made


def _with_normals(mesh: Mesh) -> Mesh:
    if not mesh.triangle_count:
        raise UsageError("a mesh has no triangle: there is nothing to show")
    if mesh.normals is not None:
        return mesh
    from clrecon.mesh.triangles import vertex_normals

    normals = vertex_normals(mesh.vertices, mesh.triangles)
    return Mesh(mesh.vertices, mesh.triangles, normals, dict(mesh.report), trusted=True)


def wrap_inputs(inputs: Sequence[OpenedInput], names: Sequence[str] = ()) -> list[ShownObject]:
    """Wrap what `clrecon.jobs.view.inputs.open_inputs` has read."""
    return show_objects([each.subject for each in inputs], names, [each.said for each in inputs])
