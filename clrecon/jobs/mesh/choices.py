"""Choices of a mesh job: labels that become meshes, and the points and labels that surfaces grow from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs.options import grow_option, label_color_option, label_map_option, label_option
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import MISSING, dataclass
from clrecon.system.options import option

if TYPE_CHECKING:
    from clrecon.labels import LabelMap


@dataclass(frozen=True)
class LabelChoice:
    """The labels of a map, by numbers or names, that become meshes; without `label` all that have a surface."""

    path: str | Path = label_map_option(default=MISSING)
    label: tuple[str | int, ...] = label_option(default=())
    hidden: tuple[str | int, ...] = option(
        "--hide-label NAME|N", "not this label; may be given again", default=(), action="append"
    )
    colors: tuple[tuple[str | int, str], ...] = label_color_option(
        " in .ply and in the formats of several objects, such as L3=orange"
    )
    surface: str = "hu"
    grow_mm: float | None = grow_option()
    solid: bool = False

    def __post_init__(self) -> None:
        from clrecon.rendering.looks.colors import find_color  # numpy: not loaded before a job starts

        for _, color in self.colors:
            find_color(color)
        if self.surface not in ("hu", "mask"):
            raise UsageError(f"labels have no surface {self.surface!r}: it is hu or mask")
        if self.surface == "mask" and (self.solid or self.grow_mm is not None):
            raise UsageError(
                f"the surface of a mask is solid and does not grow: leave out {name_parameter('solid')} and"
                f" {name_parameter('grow_mm')}"
            )

    def numbers_of(self, labels: LabelMap) -> list[int]:
        hidden = {labels.find(label) for label in self.hidden}
        wanted = [labels.find(label) for label in self.label] or list(labels.numbers)
        left = [number for number in wanted if number not in hidden]
        if not left:
            raise UsageError("all labels are hidden: there is no mesh to make")
        return left

    def colors_of(
        self, labels: LabelMap, numbers: Sequence[int], distinct: bool
    ) -> dict[int, tuple[float, float, float]]:
        """Return the colours of labels: those given, and where wanted distinct ones for all others."""
        from clrecon.rendering.looks.colors import find_color
        from clrecon.rendering.pictures.label_style import distinct_colors
        from clrecon.rendering.views.directions import as_point

        given = {}
        for label, color in self.colors:
            number = labels.find(label)
            if number in given:
                raise UsageError(f"label {number} {labels.name(number)} has two colours")
            given[number] = as_point(find_color(color))
        if not distinct:
            return given
        own = distinct_colors(len(numbers))
        return {number: as_point(color) for number, color in zip(numbers, own, strict=True)} | given


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
