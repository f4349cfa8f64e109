"""Points and labels that surfaces grow from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs import options
from clrecon.system.arguments import name_parameter

if TYPE_CHECKING:
    from clrecon.labels import LabelMap

LABEL_SEED = "label:"
"""What a seed that is a label begins with."""


def is_label_seed(seed: object) -> bool:
    return isinstance(seed, str) and seed.startswith(LABEL_SEED)


def check_point(seed: Sequence[float]) -> None:
    if len(seed) != 3 or not all(map(math.isfinite, seed)):
        raise UsageError(f"a seed is a point of three numbers in mm, not {tuple(seed)}")


def check_growing(
    method: str,
    grow_from: Sequence[str | Sequence[float]],
    vertex_rule: str,
    *,
    topology: str,
    inside: str,
    has_labels: bool,
    makes_labels: bool,
) -> None:
    """Check the seeds, the method and the vertex rule of a mesh job, each and with its other settings."""
    for seed in grow_from:
        if not isinstance(seed, str):
            check_point(seed)
        elif seed != "auto" and not (is_label_seed(seed) and seed[len(LABEL_SEED) :].strip()):
            raise UsageError(f"{name_parameter('grow_from')} is auto, X,Y,Z in mm or label:NAME, not {seed!r}")
    from clrecon.geometry.vertices import check_vertex_rule
    from clrecon.operators.surface.methods import check_method

    chosen = check_method(
        method, grows=bool(grow_from), vertex_rule=vertex_rule, topology=topology, plain=inside == "above"
    )
    check_vertex_rule(vertex_rule, topology)
    from_labels = any(map(is_label_seed, grow_from))
    if from_labels and not has_labels:
        raise UsageError(f"a label to grow from needs its label map: give its file with {name_parameter('labels')}")
    if from_labels and makes_labels:
        raise UsageError("a label map to grow from makes no meshes of its own: leave the labels for meshes out")
    if has_labels and not from_labels and (chosen.grows or not chosen.on_device or vertex_rule != "linear"):
        raise UsageError(
            f"labels pick the cells of their surfaces: leave {name_parameter('method')},"
            f" {name_parameter('grow_from')} and {name_parameter('vertex_rule')} out, or grow from label:NAME"
        )


def parse_seed(text: str) -> str | tuple[float, ...]:
    """Read ``auto``, ``label:NAME`` or ``X,Y,Z``."""
    if text.lower() == "auto":
        return "auto"
    if text.lower().startswith(LABEL_SEED):
        return f"{LABEL_SEED}{text[len(LABEL_SEED) :]}"
    try:
        return options.parse_point(text)
    except ValueError:
        raise ValueError(f"{text!r} is neither auto nor X,Y,Z in mm nor label:NAME") from None


def find_seeds(grow_from: Sequence[str | Sequence[float]], space: str, labels: LabelMap | None) -> list[Any]:
    """Return seeds in mm of the frame `space` as `extract_isosurface` takes them; none are "auto"."""
    from clrecon.geometry import frame_from_lps

    seeds: list[Any] = []
    for seed in grow_from or ("auto",):
        if not isinstance(seed, str):
            seeds.append((frame_from_lps(space).T @ seed).tolist())
        elif is_label_seed(seed):
            name = seed[len(LABEL_SEED) :].strip()
            seeds.append((labels, int(name) if name.isascii() and name.isdigit() else name))
        else:
            seeds.append(seed)
    return seeds
