"""Gates of a surface that is to be printed or used for planning: conditions that it must meet, as data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from clrecon.geometry import METAL_HU
from clrecon.system.records import Gate, at_most, is_true, none_of, unmeasured

_DEVIATION_P95_VOXEL = 0.25
"""Bound for 95 % of the surface, by its area, in shortest voxel steps."""

DEVIATION_MEAN_VOXEL = 0.1
_VOLUME_CHANGE_PERCENT = 0.5
_MASK_VOLUME_PERCENT = 1.0
"""Bound for the label's own surface, in percent of its volume: extraction takes 0.03 %, the rest is for refinement."""

_LABEL_VOLUME_PERCENT = 15.0
"""Bound for a surface placed by HU, in percent of the label's volume.  Solid surfaces of vertebrae differ by -7 to 11 %
where the iso value fits the bone, and by -14 to -29 % above thin cortex; hollow ones by -32 to -80 %.
"""


def judge_mesh(
    quality: Mapping[str, Any] | None = None,
    *,
    closed: bool = True,
    outward: bool = True,
    iso_distance: Mapping[str, Any] | None = None,
    extracted: bool = False,
    deviation: Mapping[str, Any] | None = None,
    voxel_mm: float | None = None,
) -> list[Gate]:
    """Judge the measures of a mesh by the gates; only what was measured has some.

    closed: The surface should be closed.  A surface left open at the border of the scan has no gates on closedness,
        outside and volume.
    outward: The surface should enclose a volume above zero, unlike the wall of a cavity by itself.
    extracted: Nothing was smoothed or decimated: what flat triangles leave of noise is the voxels', and not judged.
        Else vertices alone count, or with centres of triangles, whichever lie nearer: few triangles have vertices
        outside of what is round, and long cells have centres off it.
    deviation: From the surface before smoothing and decimation.
    voxel_mm: Shortest voxel step, the unit of the bounds; needed with `deviation`.
    """
    gates: list[Gate] = []
    if quality:
        gates += _gates_of_quality(quality, closed, outward)
    if iso_distance:
        gates += _gates_of_iso_distance(iso_distance, extracted)
    if deviation and voxel_mm:
        gates += _gates_of_deviation(deviation, voxel_mm, closed)
    return gates


def judge_label_volume(mesh_ml: float | None, label_ml: float, advice: str = "", *, by_hu: bool = True) -> Gate:
    """Compare the volume of a label's mesh, None where it is open, with its voxels'; `by_hu`: HU placed the surface."""
    name, bound = "label_volume", _LABEL_VOLUME_PERCENT if by_hu else _MASK_VOLUME_PERCENT
    if mesh_ml is None:
        return unmeasured(name, bound, "%", "a surface that is open at the border of the scan encloses no volume")
    change = 100.0 * (mesh_ml / label_ml - 1.0)
    gate = at_most(name, abs(change), bound, "%", "volume of the mesh against that of the label")
    both = f"the mesh has {mesh_ml:,.3g} ml, the label {label_ml:,.3g} ml"
    text = f"{both} ({change:+.3g} %, at most {bound:g} % either way)"
    return gate.changed(text=text if gate.ok or not advice else f"{text}: {advice}")


def _gates_of_quality(quality: Mapping[str, Any], closed: bool, outward: bool) -> Iterator[Gate]:
    sheets = quality["nonmanifold_edges"] + quality["nonmanifold_vertices"]
    if closed:
        if quality["boundary_edges"] or not quality["open_edges_by_place"]:
            yield none_of("closed", quality["boundary_edges"], "edges with one triangle only", quality["closed"])
        else:
            words = "edges that are not in two triangles once vertices at one place are joined, as in STL"
            yield none_of("closed", quality["open_edges_by_place"], words, quality["closed"])
    yield none_of("manifold", sheets, "edges and vertices with several sheets", quality["manifold"])
    yield is_true("oriented", quality["oriented"], "all triangles face the same side of the surface")
    if closed and outward:
        yield is_true("outward", quality["outward"], "the triangles face outward, the enclosed volume is above zero")
    yield none_of("zero_area_faces", quality["zero_area_faces"], "triangles without area")
    yield none_of("duplicate_faces", quality["duplicate_faces"], "triangles that are there twice")
    intersections = quality.get("self_intersections")
    if intersections is None:
        yield unmeasured("self_intersections", 0, None, "triangles that cut each other are not looked for")
    else:
        yield none_of("self_intersections", intersections, "pairs of triangles that cut each other")


def _gates_of_iso_distance(iso_distance: Mapping[str, Any], extracted: bool) -> Iterator[Gate]:
    words = "vertices and centres of triangles from which no trilinear iso surface was reached"
    yield none_of("iso_distance_found", iso_distance["not_found"], words)
    words = "distance of the mesh from the trilinear iso surface"
    measures = (("p95", _DEVIATION_P95_VOXEL, "95 % of it"), ("mean", DEVIATION_MEAN_VOXEL, "mean"))
    known = [iso_distance.get(name) for name in ("vertices_voxel", *["surface_voxel"] * (not extracted))]
    clear = min(filter(None, known), key=lambda one: float(one["mean"]), default=None)
    near, away = iso_distance.get("near_metal_share"), None if extracted else iso_distance.get("away_from_metal_voxel")
    metal = f"{100.0 * near:.2g} % of the surface near metal (above {METAL_HU:g} HU)" if near else ""
    for name, bound, which in measures:
        if clear and away:
            aside = f"without {metal}, with it {clear[name]:.3g}"
            yield at_most(f"iso_distance_{name}", away[name], bound, "voxel", f"{words}, {which} ({aside})")
        elif clear:
            aside = f" ({metal})" if metal else ""
            yield at_most(f"iso_distance_{name}", clear[name], bound, "voxel", f"{words}, {which}{aside}")
        else:
            yield unmeasured(f"iso_distance_{name}", bound, "voxel", f"{words}: none was reached")


def _gates_of_deviation(deviation: Mapping[str, Any], voxel_mm: float, closed: bool) -> Iterator[Gate]:
    p95, mean = deviation["hd95_mm"] / voxel_mm, deviation["assd_mm"] / voxel_mm
    words = "distance from the surface before smoothing and decimation"
    yield at_most("deviation_p95", p95, _DEVIATION_P95_VOXEL, "voxel", f"{words}, 95 % of it")
    yield at_most("deviation_mean", mean, DEVIATION_MEAN_VOXEL, "voxel", f"{words}, mean")
    change = deviation["volume_change_percent"]
    if closed and change is not None:
        words = "change of volume by smoothing and decimation"
        yield at_most("volume_change", abs(change), _VOLUME_CHANGE_PERCENT, "%", words)
