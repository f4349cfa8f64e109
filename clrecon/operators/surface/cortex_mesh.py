"""A surface at a low level moved onto the outer surface of bone, and how far any surface lies from it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.mesh.connectivity import Fans, find_used
from clrecon.mesh.connectivity import label_components as label_on_host
from clrecon.mesh.refine.shifts import move_vertices
from clrecon.mesh.triangles import cross_product, vertex_normals
from clrecon.opencl import Device, Stopwatch
from clrecon.operators.primitives.union_find import label_components
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.operators.surface.cortex import CortexConstants, ProfileSampler
from clrecon.operators.surface.cortex_constants import HOW_TO_FIT, STEPPED
from clrecon.operators.surface.cortex_fit import (
    BADLY_FITTED,
    DENSER_ERROR,
    FITTED,
    MOST_SHIFT_MM,
    NOT_BONE,
    CortexFit,
    fit_walls,
)
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import in_threads, side_by_side, spread_rows
from clrecon.system.progress import Progress, Steps, ignore_progress
from clrecon.system.records import Record

if TYPE_CHECKING:
    from clrecon.labels import LabelMap

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.integer]

_RINGS, _CORNERS = 3, 12.0
"""Rounds in which hidden walls ask their neighbours, and about how many corners of them there are."""

_LONE_SHARE = 0.5
"""Share of a vertex' neighbours that are fitted from which on it is of their wall, though its own profile shows none:
at the level's place it would be a spike (at the rim of a plate of 0.45 mm).  Phantoms lie 0.7 um nearer to the truth,
but those of stepped slices farther from it."""

_MOST_LOOKED_AT = 20_000
"""Vertices of a surface at a level whose distance from the bone is measured."""

_FEWEST_FITTED = 100
"""Fitted vertices below which nothing is said about a surface."""

KEPT_MM = 1e-3
"""A vertex that is still farther than this from its wall was not moved by its whole shift."""

_LEAST_TURN = 0.2
"""Least cosine between a triangle before and after it was moved."""

_LEAST_CALMED, _SHORT_ROUNDS = 0.95, 8
"""Corners of triangles that would turn over go to the mean of their neighbours as long as less than this share stays
turned, and then, in so many rounds, half back: a speck of eight triangles is turned whatever its neighbours say."""

_BENT_ERROR = 0.7
"""Error of bent surfaces, in blurs, times the root of what normals around a vertex lack of one direction."""

_BIAS_ROWS = 2000
"""Vertices by which the effect of the constants on the whole surface is measured."""


@dataclass(frozen=True, eq=False)
class CortexReport(Record):
    """What was found of a surface's distance from the bone; the entries are explained in docs/contract.md."""

    moved: bool
    constants: CortexConstants
    own_cortex_hu: list[float]
    vertices: int
    fitted: int
    not_bone: int
    metal: int
    badly_fitted: int
    no_room: int
    kept: int
    outside_mm: dict[str, float]
    error_mm: dict[str, float]
    bias_mm: float
    thickness_mm: dict[str, float]


def doubt_lone_vertices(fit: CortexFit, triangles: NDArray[np.uint32], fans: Fans) -> None:
    """Call vertices that are no bone badly fitted, in place, where `_LONE_SHARE` of those around them are fitted."""
    fitted, lone = fit.states == FITTED, fit.states == NOT_BONE
    is_rim = np.empty(len(triangles), bool)

    def find_rims(piece: slice) -> None:
        corners = triangles[piece].T.astype(np.intp)
        is_rim[piece] = np.logical_and(*(of.take(corners).any(axis=0) for of in (fitted, lone)))

    in_threads(find_rims, len(triangles))
    rows = find_used(triangles[is_rim], len(lone))
    rows = rows[lone[rows]]
    counts = fans.sums(fitted.astype(np.float32)[:, None], triangles, rows)[:, 0]
    fit.states[rows[counts >= 2.0 * _LONE_SHARE * (fans.begin[rows + 1] - fans.begin[rows])]] = BADLY_FITTED


def choose_shifts(fit: CortexFit, triangles: NDArray[np.uint32], fans: Fans) -> NDArray[np.float32]:
    """Return the shift of each vertex, mm: that of the fit; 0 where there is no wall.

    What is badly fitted lies where its neighbours say, with the weights 1 / error^2; hidden walls ask neighbours
    that did so, too.  Others are not smoothed: shifts undo the waves of the level's surface, and means keep these (0.15
    mm became 0.17 at a noise of 50 HU).
    """
    fitted, doubtful = fit.states == FITTED, np.flatnonzero(fit.states == BADLY_FITTED)
    shifts = np.where(fitted, fit.shift_mm, 0.0).astype(np.float32)
    weights = np.where(fitted, 1.0 / np.square(np.maximum(fit.spread_mm, 1e-3)), 0.0)
    for _ in range(_RINGS):
        weight, weighted = fans.sums(np.column_stack([weights, weights * shifts]), triangles, doubtful).T
        is_known = weight > 0.0
        rows, weight = doubtful[is_known], weight[is_known]
        shifts[rows] = weighted[is_known] / weight
        weights[rows] = weight / _CORNERS
        doubtful = doubtful[fit.hidden[doubtful]]
    return np.clip(shifts, -MOST_SHIFT_MM, MOST_SHIFT_MM)


def _place_vertices(
    fit: CortexFit, mesh: Mesh, normals: NDArray[np.float32], fans: Fans
) -> tuple[Float64Array, Float64Array]:
    """Return where the vertices of a mesh should go, and where they go without a triangle turned over."""
    shifts = choose_shifts(fit, mesh.triangles, fans)
    wanted = mesh.vertices.astype(np.float64) + shifts[:, None] * normals
    return wanted, calm_vertices(mesh.vertices, wanted, mesh.triangles, fans)


def calm_vertices(
    vertices: NDArray[np.floating], moved: NDArray[np.floating], triangles: NDArray[np.uint32], fans: Fans
) -> NDArray[np.float64]:
    """Return moved vertices with no triangle turned over: its corners go to the mean of their neighbours, or back."""
    places = moved.astype(np.float64)
    rows: IntArray = np.flatnonzero(find_turned(vertices, places, triangles))
    before, halved = len(triangles), 0
    while len(rows):
        bad = find_used(triangles[rows], len(places))
        if halved == _SHORT_ROUNDS:
            bad = find_used(triangles[fans.touching(bad)], len(places))
            places[bad] = vertices[bad]
            break
        if halved or len(rows) > _LEAST_CALMED * before:
            halved += 1
            places[bad] = 0.5 * (places[bad] + vertices[bad])
        else:
            before = len(rows)
            count = (fans.begin[bad + 1] - fans.begin[bad])[:, None]
            beside = 0.5 * (fans.sums(places, triangles, bad) - count * places[bad])
            places[bad] = (places[bad] + beside) / (1.0 + count)
        rows = fans.touching(bad)
        rows = rows[find_turned(vertices, places, triangles[rows])]
    return places


def find_turned(
    vertices: NDArray[np.floating], places: Float64Array, triangles: NDArray[np.uint32]
) -> NDArray[np.bool_]:
    """Mark the triangles that turn by more than `_LEAST_TURN` lets, where their vertices go to these places."""
    is_turned = np.empty(len(triangles), bool)

    def compare_normals(piece: slice) -> None:
        normals = []
        for points in (vertices, places):
            one, two, three = (points.take(row, axis=0, mode="clip") for row in triangles[piece].T.astype(np.intp))
            p, q = ((corner - one).T.astype(np.float64, order="C") for corner in (two, three))
            normals.append(cross_product(p, q))
        before, after = normals
        along, *squares = (np.einsum("an,an->n", *two) for two in ((after, before), (after, after), (before, before)))
        is_turned[piece] = along <= _LEAST_TURN * np.sqrt(squares[0] * squares[1])

    in_threads(compare_normals, len(triangles))
    return is_turned


@explains_arguments
def fit_cortex(
    mesh: Mesh,
    volume: Volume | DeviceVolume,
    *,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Move a surface at a low level onto the outer surface of bone, vertex by vertex.

    Three blurred plateaus (tissue, cortex, marrow) are fitted to the profile of HU along each vertex's normal; blur and
    HU of the cortex are measured in the scan.  A vertex without a wall of bone (vessel, marrow, metal, another wall or
    the border just outside) stays where it is.  Triangles and their order stay; no triangle is turned over, and no two
    cut each other that did not before.  See ``docs/iso_value.md``.

    Parameters
    ----------
    mesh : Mesh
        A surface of bone at a low level, such as ``extract_isosurface(volume, 200)``: walls that are not in it are not
        found.
    volume : Volume or DeviceVolume
        The scan that the mesh was made from.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Most bytes taken on the device.
    progress : callable, optional
        Called as ``progress("cortex", done, total)`` in steps.

    Returns
    -------
    Mesh
        ``values["thickness_mm"]`` and ``values["error_mm"]`` have the thickness of the wall and the standard error of
        its place at each vertex, NaN where none was fitted.  Thicknesses below the blur say "thinner than that"; from
        the depth of the profile on, 3.5 mm at voxels of 1 mm3, they stand for solid bone.  ``report["cortex"]`` says
        what was measured and counts the vertices.

    Raises
    ------
    UsageError
        ``volume`` is not a Volume, or the mesh encloses values below a level.
    NoSurfaceError
        The surface has no walls of bone.
    DeviceError
        The device does not exist, has too little memory, or fails.
    """
    progress = progress or ignore_progress
    with open_volume(volume, device, memory, "the cortex") as resident:
        return fit_meshes([mesh], resident, progress=progress)[0]


def fit_mesh(
    mesh: Mesh, resident: DeviceVolume, constants: CortexConstants | None, progress: Progress = ignore_progress
) -> Mesh:
    """Do what `fit_cortex` does, with constants of the scan that are known."""
    from clrecon.operators.surface.decimation import follow_crossings

    steps = Steps(progress, "cortex", 4)
    _refuse_few(mesh.vertex_count, mesh.vertex_count)
    normals = _normals_of(mesh)
    fit_along = partial(fit_walls, resident, mesh.vertices, stopwatch=Stopwatch(), components=_label(mesh, resident))
    fans, fit = side_by_side(
        partial(Fans, mesh.triangles, mesh.vertex_count), partial(fit_along, normals, constants=constants)
    )
    _refuse_few(int(np.count_nonzero(fit.states == FITTED)), len(fit.states))
    steps.take()
    # Normals of steps are 30 to 40 degrees off: the fit is made again along those of the moved surface, as means over
    # the triangles around.  Values between slices are then those of a cubic convolution: linear ones are blurred by
    # more (with slices of 4 mm 0.38 mm off for 0.35).
    is_stepped = fit.constants.blur_across_mm > STEPPED * fit.constants.blur_mm
    if not is_stepped:
        doubt_lone_vertices(fit, mesh.triangles, fans)
    wanted, calm = _place_vertices(fit, mesh, normals, fans)
    if is_stepped:
        around = fans.sums(vertex_normals(calm, mesh.triangles), mesh.triangles, np.arange(mesh.vertex_count))
        normals = around / np.maximum(np.linalg.norm(around, axis=1, keepdims=True), np.float32(1e-12))
        fit = fit_along(normals, constants=fit.constants, cubic=True)
        wanted, calm = _place_vertices(fit, mesh, normals, fans)
    steps.take()
    vertices, _ = move_vertices(
        mesh.vertices, mesh.triangles, calm - mesh.vertices, fans=fans,
        follow=partial(follow_crossings, resident.device),
    )  # fmt: skip
    steps.take()
    moved = Mesh(vertices, mesh.triangles, vertex_normals(vertices, mesh.triangles), mesh.report)
    fitted = fit.states == FITTED
    rows = np.flatnonzero(fitted)
    bent_mm = _BENT_ERROR * fit.constants.blur_mm * measure_bends(moved, fans, rows)
    fit.error_mm[rows] = np.hypot(fit.error_mm[rows], bent_mm)
    is_far = np.zeros(len(vertices), bool)
    for column, goals in zip(vertices.T, wanted.T, strict=True):  # rows of three take twice as long
        is_far |= np.abs(column - goals) > KEPT_MM
    unmoved = int(np.count_nonzero(fitted & is_far))
    known = np.isin(fit.states, (FITTED, BADLY_FITTED))
    moved.report = {**mesh.report, "cortex": _describe_fit(fit, resident, mesh.vertices, normals, unmoved)}
    moved.values = {
        "thickness_mm": np.where(known, fit.thickness_mm, np.float32(np.nan)),
        "error_mm": np.where(fitted, fit.error_mm, np.float32(np.nan)),
    }
    steps.take()
    return moved


def measure_bends(mesh: Mesh, fans: Fans, rows: IntArray) -> NDArray[np.float32]:
    """Return how much the normals around some vertices differ: the root of 1 less the length of their mean."""
    assert mesh.normals is not None
    count = (fans.begin[rows + 1] - fans.begin[rows]).astype(np.float32)[:, None]
    beside = fans.sums(mesh.normals, mesh.triangles, rows) - count * mesh.normals[rows]
    lengths = np.linalg.norm(beside, axis=1) / np.maximum(2.0 * count[:, 0], 1.0)
    return np.sqrt(np.maximum(1.0 - lengths, 0.0)).astype(np.float32)


def fit_meshes(meshes: Sequence[Mesh], resident: DeviceVolume, *, progress: Progress = ignore_progress) -> list[Mesh]:
    """Do what `fit_cortex` does with meshes of one scan: its constants are those of the largest that shows bone.

    Those that show none stay as they are, with ``{"reason": words}`` in place of figures; that none does is an error.
    """
    constants = None
    fitted, refused = list(meshes), []
    for row in sorted(range(len(meshes)), key=lambda row: -meshes[row].vertex_count):
        try:
            for attempt in resident.with_fallback():
                with attempt:
                    fitted[row] = fit_mesh(meshes[row], resident, constants, progress)
            constants = fitted[row].report["cortex"].constants
        except NoSurfaceError as error:
            refused.append(error)
            fitted[row].report["cortex"] = {"reason": str(error)}
    if constants is None and refused:
        raise refused[0]
    return fitted


def fit_labels(
    resident: DeviceVolume,
    labels: LabelMap,
    level: float,
    label: Sequence[int | str] | int | str | None = None,
    *,
    grow_mm: float | None = None,
    progress: Progress = ignore_progress,
) -> dict[int, Mesh]:
    """Return the filled surfaces of labels at a low level of HU, moved onto the bone."""
    from clrecon.operators.surface.labels import extract_labels

    meshes = extract_labels(resident, labels, level, label=label, grow_mm=grow_mm, solid=True, progress=progress)
    return dict(zip(meshes, fit_meshes([*meshes.values()], resident, progress=progress), strict=True))


def measure_outside(mesh: Mesh, resident: DeviceVolume, *, constants: CortexConstants | None = None) -> CortexReport:
    """Measure how far a surface at a level lies outside of the bone, at up to `_MOST_LOOKED_AT` of its vertices.

    With the constants of the scan alone: those of each component take as long as all else that a mesh does.
    """
    _refuse_few(mesh.vertex_count, mesh.vertex_count)
    rows = spread_rows(mesh.vertex_count, _MOST_LOOKED_AT)
    points, normals = mesh.vertices[rows], _normals_of(mesh)[rows]
    fit = fit_walls(resident, points, normals, stopwatch=Stopwatch(), constants=constants)
    _refuse_few(int(np.count_nonzero(fit.states == FITTED)), len(fit.states))
    return _describe_fit(fit, resident, points, normals, None)


def measure_bone_walls(
    points: Float64Array, normals: Float64Array, lengths: Float64Array, resident: DeviceVolume,
    constants: CortexConstants, thin_mm: float,
) -> Float64Array:  # fmt: skip
    """Return how thick bone is along rays through the walls of a surface, see `cast_walls`: from fit to fit, mm.

    The thickness of a fit is that of one cortex; bone has two of them, and marrow between.  Faces that would lie behind
    each other leave 0 mm.  NaN where a face is not fitted, unless no shift makes so long a ray as short as `thin_mm`.
    """
    rows = np.flatnonzero(np.isfinite(lengths))
    along, thickness = normals[rows], np.full(len(lengths), np.nan)
    ends = (points[rows], along), (points[rows] - lengths[rows, None] * along, -along)
    for attempt in resident.with_fallback():
        with attempt:
            fits = [fit_walls(resident, *end, stopwatch=Stopwatch(), constants=constants) for end in ends]
    shifts = [np.where(fit.states == FITTED, fit.shift_mm, np.float32(np.nan)) for fit in fits]
    bone = np.maximum(lengths[rows] + shifts[0] + shifts[1], 0.0)
    thickness[rows] = np.where(np.isnan(bone) & (lengths[rows] > thin_mm + 2.0 * MOST_SHIFT_MM), lengths[rows], bone)
    return thickness


def _label(mesh: Mesh, resident: DeviceVolume) -> NDArray[np.int64]:
    """Return the component of each vertex, by the host where the device has no room."""
    try:
        return label_components(resident.device, mesh.triangles, mesh.vertex_count, memory=resident.memory)[1]
    except DeviceMemoryError:
        return label_on_host(mesh.triangles, mesh.vertex_count)[1]


def _normals_of(mesh: Mesh) -> NDArray[np.float32]:
    """Return the normals of a mesh outwards; of extracted surfaces those of the field."""
    if mesh.report.get("inside") == "below":
        raise UsageError("the cortex is the outer surface of dense walls: this mesh encloses what lies below a level")
    return vertex_normals(mesh.vertices, mesh.triangles) if mesh.normals is None else mesh.normals


def _refuse_few(count: int, vertices: int) -> None:
    if count < _FEWEST_FITTED:
        raise NoSurfaceError(
            f"the surface has no walls of bone to be fitted: {count} of {vertices:,} vertices, at least"
            f" {_FEWEST_FITTED} are needed; {HOW_TO_FIT}"
        )


def _describe_fit(
    fit: CortexFit, resident: DeviceVolume, points: NDArray[np.floating], normals: NDArray[np.floating],
    unmoved: int | None,
) -> CortexReport:  # fmt: skip
    """Report a fit; unmoved is None where the surface was not moved."""
    fitted = fit.states == FITTED
    shift, thickness = fit.shift_mm[fitted].astype(np.float64), fit.thickness_mm[fitted]
    blur_mm = fit.constants.blur_mm
    return CortexReport(
        moved=unmoved is not None,
        constants=fit.constants,
        own_cortex_hu=list(fit.own_cortex_hu),
        vertices=len(fit.states),
        **{name.replace(" ", "_"): count for name, count in fit.counts().items()},
        kept=unmoved or 0,
        outside_mm={"mean": float(-shift.mean()), **_percentiles(-shift, 5, 50, 95)},
        error_mm=_percentiles(fit.error_mm[fitted], 50, 95),
        bias_mm=_measure_bias(fit, resident, points, normals),
        thickness_mm={**_percentiles(thickness, 5, 50, 95), "thin_share": float((thickness < blur_mm).mean())},
    )


def _percentiles(values: NDArray[np.floating], *which: int) -> dict[str, float]:
    return {f"p{each}": float(value) for each, value in zip(which, np.percentile(values, which), strict=True)}


def _measure_bias(
    fit: CortexFit, resident: DeviceVolume, points: NDArray[np.floating], normals: NDArray[np.floating]
) -> float:
    """Return the root of the squares of what each constant's uncertainty moves the surface by, on average."""
    fitted = np.flatnonzero(fit.states == FITTED)
    rows = fitted[spread_rows(len(fitted), _BIAS_ROWS)]
    sampler = ProfileSampler(resident, Stopwatch())
    walls, known = sampler.take(sampler.values(points[rows], normals[rows])), fit.constants
    if known.denser is not None:
        apart = walls.fit_with(known.at_dense_end()).shift_mm.astype(np.float64) - walls.fit_with(known).shift_mm
        return abs(float(DENSER_ERROR * apart.mean()))
    changes = []
    for name in ("blur_mm", "blur_across_mm", "cortex_hu"):
        error = getattr(known, f"{name.removesuffix('_mm').removesuffix('_hu')}_error_{name[-2:]}")
        below, above = (known.changed(**{name: getattr(known, name) + change}) for change in (-error, error))
        apart = walls.fit_with(above).shift_mm.astype(np.float64) - walls.fit_with(below).shift_mm
        changes.append(0.5 * apart.mean())
    return float(np.linalg.norm(changes))
