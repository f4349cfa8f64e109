"""Methods of marching cubes in a mesh job: what they go with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from clrecon.errors import UsageError
from clrecon.system.arguments import name_parameter

if TYPE_CHECKING:
    from clrecon.jobs.mesh.label_choice import LabelChoice

LABEL_SEED = "label:"
"""What a seed that is a label begins with."""


def is_label_seed(seed: object) -> bool:
    """Return whether a seed is a label of the label map."""
    return isinstance(seed, str) and seed.startswith(LABEL_SEED)


def check_growing(
    method: str,
    grow_from: Sequence[str | Sequence[float]],
    vertex_rule: str,
    *,
    topology: str,
    inside: str,
    labels: LabelChoice | None,
) -> None:
    """Check the seeds, the method and the vertex rule of a mesh job, each and with its other settings."""
    for seed in grow_from:
        _check_seed(seed)
    if method == "t-mc" and not grow_from and vertex_rule == "linear":
        return  # what every device does: the operators need not be loaded
    from clrecon.geometry.vertex_rules import check_vertex_rule
    from clrecon.operators.surface.methods import check_method

    chosen = check_method(
        method, grows=bool(grow_from), vertex_rule=vertex_rule, topology=topology, plain=inside == "above"
    )
    check_vertex_rule(vertex_rule, topology)
    from_labels = any(map(is_label_seed, grow_from))
    if from_labels and labels is None:
        raise UsageError(f"a label to grow from needs its label map: give its file with {name_parameter('labels')}")
    if from_labels and labels is not None and labels.wanted:
        raise UsageError("a label map to grow from makes no meshes of its own: leave the labels for meshes out")
    if labels is not None and not from_labels and (chosen.grows or not chosen.on_device or vertex_rule != "linear"):
        raise UsageError(
            f"labels pick the cells of their surfaces: leave {name_parameter('method')},"
            f" {name_parameter('grow_from')} and {name_parameter('vertex_rule')} out, or grow from label:NAME"
        )


def _check_seed(seed: str | Sequence[float]) -> None:
    if isinstance(seed, str):
        if seed != "auto" and not (is_label_seed(seed) and seed[len(LABEL_SEED) :].strip()):
            raise UsageError(f"{name_parameter('grow_from')} is auto, X,Y,Z in mm or label:NAME, not {seed!r}")
    elif len(seed) != 3 or not all(map(math.isfinite, seed)):
        raise UsageError(f"a seed is a point of three numbers in mm, not {tuple(seed)}")
