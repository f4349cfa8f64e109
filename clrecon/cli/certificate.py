"""Description of a certificate in words, for ``clrecon info``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_DIRECTIONS = {"L": "left", "R": "right", "P": "back", "A": "front", "S": "head", "I": "feet"}
_FIRST = {"HF": "head first", "FF": "feet first"}
_LYING = {"S": "supine", "P": "prone", "DR": "on the right side", "DL": "on the left side"}
_RUNS_SHOWN = 6
_OBLIQUE_DEG = 0.05
_SAME = 0.01
"""Lengths are shown as equal if they differ by less than this share of a gap."""
_FINEST_MM = 0.001


def describe_certificate(certificate: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Describe a series by its certificate: (subject, text) pairs, the gates last; no pairs without a certificate."""
    if certificate is None:
        return []
    return [*_describe_places(certificate), *_describe_values(certificate), *_describe_gates(certificate["gates"])]


def _describe_places(of: dict[str, Any]) -> Iterator[tuple[str, str]]:
    size = " x ".join(str(count) for count in of["shape_ijk"])
    if of["spacing_mm"] is None:
        yield "voxels", f"{size}; their places are refused"
    else:
        box = "" if of["extent_mm"] is None else f"; the box is {_times(of['extent_mm'], '.1f')} mm"
        yield "voxels", f"{size} of {_times(of['spacing_mm'], '.4g')} mm{box}"
    if of["orientation"] is not None:
        yield "directions", _describe_directions(of["orientation"], of["patient_position"])
    if of["anatomical_orientation"] is not None:
        yield "anatomy", "QUADRUPED: an animal; back is dorsal, front ventral, head cranial, feet caudal (trunk)"
    if of["grid_residual_max_mm"] is not None:
        yield "positions", _describe_residual(of)
        yield "gaps", _describe_gaps(of)
    if of["thickness"] is not None:
        yield "thickness", _describe_thickness(of["thickness"], of["gap_mm"]["median"])
    if of["tilt_deg"] is not None:
        edge = "front" if of["tilt_deg"] > 0.0 else "back"
        tilted = abs(of["tilt_deg"]) > _OBLIQUE_DEG
        said = f"{of['tilt_deg']:+.2f} degrees ({edge} edge towards the head), kept exactly as a shear"
        yield "tilt", said if tilted else "none"
    reasons = "".join(f", {count} dropped ({reason})" for reason, count in of["dropped"].items())
    missing = f", {of['slices_missing']} missing" if of["slices_missing"] else ""
    yield "slices", f"{of['slices']} used{reasons or ', none dropped'}{missing}"
    if of["phase"] is not None:
        phase = of["phase"]
        yield "phase", f"{phase['number']} of {phase['of']}, {phase['keyword']} {phase['value']}"


def _describe_directions(orientation: dict[str, Any], position: str | None) -> str:
    row, column, normal = (_DIRECTIONS[letter] for letter in orientation["axes"])
    text = f"rows run to the {row}, columns to the {column}, slices to the {normal}"
    if orientation["off_axis_deg"] > _OBLIQUE_DEG:
        text += f", their normal {orientation['off_axis_deg']:.1f} degrees off that axis"
    if not orientation["right_handed"]:
        text += "; left-handed"
    if position:
        words = [_FIRST.get(position[:2], ""), _LYING.get(position[2:], "")]
        text += f"; {', '.join(words)} ({position})" if all(words) else f"; patient position {position}"
    return text


def _describe_residual(of: dict[str, Any]) -> str:
    largest, rms, allowed = (of[f"grid_{name}_mm"] for name in ("residual_max", "residual_rms", "tolerance"))
    if of["uneven"]:
        far = f"up to {largest:.3g} mm off even steps (rms {rms:.3g}, allowed {allowed:.3g})"
        return f"uneven, {far}" + (": each slice has its own place" if of["spacing_mm"] else "")
    return f"within {max(largest, _FINEST_MM):.3g} mm of even steps (allowed {allowed:.3g})"


def _describe_gaps(of: dict[str, Any]) -> str:
    low, high, usual = (of["gap_mm"][name] for name in ("min", "max", "median"))
    stated = of["stated_gap_mm"]
    said = "" if stated is None else f"; SpacingBetweenSlices says {stated:g}"
    runs = of["gap_runs"]
    if not high:
        return f"none, all slices are at one place{said}"
    if runs and len(runs) <= _RUNS_SHOWN:
        return ", then ".join(f"{run['count']} of {run['gap_mm']:.4g}" for run in runs) + f" mm{said}"
    if high - low > _SAME * usual:
        return f"{low:.4g} to {high:.4g} mm, usually {usual:.4g}{said}"
    return f"{usual:.4g} mm{said}"


def _describe_thickness(thickness: dict[str, Any], usual_gap: float) -> str:
    low, high = thickness["min_mm"], thickness["max_mm"]
    text = f"{low:g} mm" if low == high else f"{low:g} to {high:g} mm"
    least, most, overlap = (thickness["overlap_mm"][name] for name in ("min", "max", "median"))
    if most - least > _SAME * usual_gap:
        return f"{text}: {_overlaps(least, most, _SAME * usual_gap)}"
    if abs(overlap) <= _SAME * usual_gap:
        return f"{text}: neighbouring slices touch"
    percent = thickness["overlap_percent"]
    share = "" if percent is None else f" ({abs(percent):.0f} % of the gap)"
    return f"{text}: {_overlap(overlap, usual_gap)} between neighbouring slices{share}"


def _overlaps(least: float, most: float, nothing: float) -> str:
    """Describe by how much neighbouring slices overlap where that differs; below 0 is what lies between them."""
    least, most = (0.0 if abs(length) <= nothing else length for length in (least, most))
    if least >= 0.0:
        return f"neighbouring slices overlap by {least:.3g} to {most:.3g} mm"
    if most <= 0.0:
        return f"{abs(most):.3g} to {-least:.3g} mm between neighbouring slices are not measured"
    return f"neighbouring slices overlap by up to {most:.3g} mm, or up to {-least:.3g} mm between them are not measured"


def _overlap(length: float, usual_gap: float) -> str:
    if abs(length) <= _SAME * usual_gap:
        return "nothing"
    return f"{length:.3g} mm overlap" if length > 0.0 else f"{-length:.3g} mm not measured"


def _describe_values(of: dict[str, Any]) -> Iterator[tuple[str, str]]:
    rescale = of["rescale"]
    slope, intercept = (_span(rescale[name]) for name in ("slope", "intercept"))
    span = "" if of["hu_range"] is None else f"{of['hu_range'][0]:g} to {of['hu_range'][1]:g} "
    kind = rescale["type"] or "HU (the type is not stated)"
    given = ", as given" if rescale.get("given") else ""
    yield "values", f"{span}{kind}; slope {slope}, intercept {intercept}{given}"
    if of["padding_share"] is None:
        yield "padding", "not looked at" + (" (--pixels reads it)" if of["spacing_mm"] else "")
    else:
        yield "padding", f"{100.0 * of['padding_share']:.1f} % of the voxels hold no measurement"
    yield "stored", "; ".join(of["transfer_syntax_names"]) + "; with lossy compression" * of["lossy"]
    frame = of["frame_of_reference_hash"]
    yield "frame", f"{frame} (hash of the FrameOfReferenceUID)" if frame else "no FrameOfReferenceUID"


def _describe_gates(gates: list[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    kept = sum(gate["ok"] is True for gate in gates)
    failed = [gate for gate in gates if gate["ok"] is False]
    unknown = [gate["name"] for gate in gates if gate["ok"] is None]
    text = f"{kept} kept, {len(failed)} failed"
    yield "gates", text + (f", not measured: {', '.join(unknown)}" if unknown else "")
    for gate in failed:
        yield "FAILED", f"{gate['name']}: {gate['text']}"


def _times(lengths: list[float], form: str) -> str:
    return " x ".join(f"{length:{form}}" for length in lengths)


def _span(ends: list[float]) -> str:
    return f"{ends[0]:g}" if ends[0] == ends[1] else f"{ends[0]:g} to {ends[1]:g}"
