"""Settings of the mesh job, validated on construction, and those of labels that become meshes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from clrecon.errors import UsageError
from clrecon.exchange.formats import IN_PIECES, list_extensions
from clrecon.jobs import options
from clrecon.jobs.cluster import LOCAL
from clrecon.jobs.mesh.seeds import LABEL_SEED, check_growing, check_point, is_label_seed, parse_seed
from clrecon.jobs.outputs import OBJECT_FILES
from clrecon.jobs.presets import DEFAULT_PRESET, PURPOSES, Purpose, find_iso_preset, find_purpose
from clrecon.system.arguments import MethodName, Space, Topology, VertexRule, name_parameter
from clrecon.system.light_dataclass import MISSING, dataclass
from clrecon.system.options import option

if TYPE_CHECKING:
    from clrecon.labels import LabelMap


@dataclass(frozen=True)
class LabelChoice:
    """The labels of a map, by numbers or names, that become meshes; without `label` all that have a surface."""

    path: str | Path = options.label_map_option(default=MISSING)
    label: tuple[str | int, ...] = options.label_option(default=())
    hidden: tuple[str | int, ...] = option(
        "--hide-label NAME|N", "leave this label out; may be given again", default=(), action="append"
    )
    colors: tuple[tuple[str | int, str], ...] = options.label_color_option(
        " in .ply and in formats that hold several objects, such as L3=orange"
    )
    surface: str = "hu"
    grow_mm: float | None = options.grow_option()
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
        palette = distinct_colors(len(numbers))
        return {number: as_point(color) for number, color in zip(numbers, palette, strict=True)} | given


_ITERATIONS = 20

METHOD_NAMES = ("t-mc", "i-mc", "g-mc", "s-mc", "t-mc-soup", "skimage")

SCAN_GATE_FAILED, GATE_FAILED = 7, 8
"""Exit codes for a failed gate where gates are strict; everything is written."""


def _describe_purpose(purpose: Purpose) -> str:
    words = []
    for field, value in purpose.settings.items():
        words.append(f"--{field.replace('_', '-')}")
        if value is not True:
            words += value if isinstance(value, tuple) else [f"{value}"]
    return f"{purpose.name}: {' '.join(words)}: {purpose.description}".replace("%", "%%")


def name_level(level: float | Sequence[float]) -> str:
    """Write an iso value or a range as text: ``200``, ``100:300``."""
    return ":".join(f"{value:g}" for value in level) if isinstance(level, Sequence) else f"{level:g}"


_OF_WHOLE_MESHES = (
    *("purpose", "labels", "grow_from", "method", "surface", "keep", "keep_largest", "min_volume_ml", "seeds"),
    *("all_parts", "split", "one_file", "smooth", "decimate", "max_deviation_mm", "strict"),
)
"""Settings of steps that take the mesh as a whole."""

_inside_option = partial(option, group="inside")
_method_option = partial(option, group="method")
_selection_option = partial(option, group="selection")
_files_option = partial(option, group="files")
_refinement_option = partial(option, group="refinement")


@dataclass(frozen=True)
class MeshSettings(options.SharedSettings):
    """Settings of the mesh job; options say in their help what they do.

    iso_value: float or sequence of float or (low, high). A pair in the sequence is a range: ``((100, 300),)``.
    half_way: "auto" or (bone, tissue), see `clrecon.jobs.options.parse_hu`.
    preset: If no level is given, it is "bone".
    surface: "mask" is that of the labels, `LabelChoice.surface`.
    method: One of `clrecon.operators.surface.methods.METHODS`; None: "i-mc" with seeds in `grow_from`, else "t-mc".
    grow_from: With ``label:NAME`` the label map makes no meshes of its own.
    keep: With `keep_largest`: of these the largest, as with `min_volume_ml`.
    purpose: More is measured for it.  It sets nothing here, see `clrecon.jobs.mesh.purposes.settings_for`.
    """

    purpose: str | None = option(
        "--for PURPOSE",
        "choose the settings for a purpose (options given beside it win); "
        + "; ".join(map(_describe_purpose, PURPOSES.values())),
        group="purpose",
        parse=str.lower,
        first=True,
        words=PURPOSES,
    )
    iso_value: float | Sequence[float | Sequence[float]] | None = options.hu_option(
        options.LEVELS_HELP, "N[,N...]|A:B|auto|half:B,T", group="level", parse=options.parse_hu, first=True
    )
    below: float | Sequence[float] | None = option(
        "--below N[,N...]",
        "enclose the voxels below N HU instead, such as lungs, airways and sinuses (-400); the air around the patient"
        " is left out",
        group="level",
        parse=options.parse_levels,
    )
    preset: str | None = options.iso_preset_option()
    half_way: str | Sequence[float] | None = None
    keep_outside: bool = _inside_option("--keep-outside", "with --below: keep the air around the patient")
    solid: bool = _inside_option(
        "--solid",
        "fill what the bone encloses: marrow, and canals that the ends of the scan cut; brain, chest and air stay open;"
        " with --labels: fill the less dense voxels within each label",
        action="yes-no",
        first=True,
    )
    seal_mm: float | None = _inside_option(
        "--seal MM", "with --solid: close pores up to 2 x MM wide, less one voxel (default: depends on the voxels)"
    )
    surface: str = options.surface_option(
        "vertices lie at the level (default)",
        "mask: with --labels the surface of the label's voxels, regardless of the HU, as for organs and lungs",
        group="kind",
        default="hu",
    )
    space: Space = options.space_option("patient frame of the mesh", group="surface")
    topology: Topology = option(
        "--topology T",
        "resolve ambiguous marching-cubes cases: separated keeps corners apart (default), trilinear joins those that"
        " trilinear interpolation joins",
        group="surface",
        default="separated",
        parse=str.lower,
        words=("separated", "trilinear"),
    )
    closed: bool = options.closed_option()
    method: MethodName | None = _method_option(
        f"--method {'|'.join(METHOD_NAMES)}",
        "t-mc: every cell (default); i-mc: only components connected to seeds; g-mc: t-mc, then quadric collapse"
        " without an error bound; s-mc: t-mc, then decimation within one; t-mc-soup, skimage: on the CPU, to compare",
        parse=str.lower,
    )
    grow_from: Sequence[str | Sequence[float]] = _method_option(
        "--grow-from auto|X,Y,Z|label:NAME",
        "seeds of i-mc: auto, all parts with at least 1/20 of the cells of the largest; a point in mm of the frame of"
        " --space, at most 10 mm from the surface; or a label of --labels; may be given again",
        default=(),
        parse=parse_seed,
        action="append",
    )
    vertex_rule: VertexRule = _method_option(
        "--vertex-rule linear|golden|golden-search",
        "place vertices on their edges: linear (default); golden: at 0.618 regardless of the HU, up to 0.6 voxels off;"
        " golden-search: where a cubic crosses the iso value, no better than linear",
        default="linear",
        parse=str.lower,
    )
    keep: str | None = _selection_option(
        "--keep bone",
        "keep the components whose walls look like bone, not heart and vessels with contrast medium, nor a table",
        parse=str.lower,
    )
    keep_largest: int | None = _selection_option("--keep-largest N", "keep only the N largest components", first=True)
    min_volume_ml: float | None = _selection_option(
        "--min-volume ML", "keep only components of at least ML millilitres", first=True
    )
    seeds: Sequence[Sequence[float]] = options.seeds_option(
        "keep the component whose surface is nearest to this point, in mm of the frame of --space; may be given again",
        group="selection",
    )
    all_parts: bool = _files_option(
        "--all-parts",
        "with --for print: keep all bones, not only the largest; named objects in a .3mf, one mesh in other formats",
    )
    split: bool = _files_option("--split", "write one file for each component, the largest first")
    one_file: bool = _files_option(
        "--one-file",
        f"write labels, components of --split or several iso values into one file ({OBJECT_FILES}), each as an object"
        " with its name and colour",
    )
    by_slabs: bool = _files_option(
        "--by-slabs",
        f"write each surface ({list_extensions(IN_PIECES)}) slab by slab while it is made, with memory for a slab and"
        " not for the mesh, which is not measured",
    )
    labels: LabelChoice | None = None
    smooth: int | None = _refinement_option(
        "--smooth N",
        f"smooth with N iterations of a windowed sinc filter (default: {_ITERATIONS})",
        nargs="?",
        const=_ITERATIONS,
    )
    decimate: float | None = _refinement_option(
        "--decimate SHARE",
        "remove this share of the triangles, such as 0.9, or as many as the error bound allows",
        first=True,
    )
    max_deviation_mm: float | None = _refinement_option(
        "--max-deviation MM",
        "error bound of smoothing, and of decimation (default: a quarter of the shortest voxel step)",
    )
    strict: bool = options.strict_option(
        f"{GATE_FAILED} if a gate of a mesh fails (closed, manifold, no self-intersections, close to the scan ...),"
        f' with {SCAN_GATE_FAILED} if only gates of the scan fail (see "clrecon info")',
        group="strict",
    )
    scheduler: str | None = options.scheduler_option(
        f"extract the surface on the workers of this Dask scheduler, such as tls://host:8786; {LOCAL}: start them on"
        f" this machine. --device {options.ALL_DEVICES}: extract it on all devices of this machine",
        group="workers",
    )

    def __post_init__(self) -> None:
        if self.is_shared_out:
            names = ("labels", "grow_from", "method", "vertex_rule", "surface")
            options.refuse_changed(self, names, options.describe_sharing(self.scheduler))
        if self.by_slabs:
            asked = name_parameter("by_slabs", True)
            options.refuse_changed(self, _OF_WHOLE_MESHES, f"{asked} keeps no mesh in memory, which this needs")
        if self.iso_value is not None and self.preset is not None:
            raise UsageError("give either an iso value in HU or a preset, not both")
        self._check_masks()
        self._check_surface()
        self._check_below()
        if self.purpose is not None:
            find_purpose(self.purpose)
        self._check_half_way()
        if self.preset is not None:
            find_iso_preset(self.preset)
        self._check_levels()
        self._check_keep()
        self._check_all_parts()
        if self.keep_largest is not None and self.keep_largest < 1:
            raise UsageError(f"the number of components to keep must be 1 or more, not {self.keep_largest}")
        if self.min_volume_ml is not None and not (math.isfinite(self.min_volume_ml) and self.min_volume_ml > 0):
            raise UsageError(f"the smallest volume to keep must be above 0 ml, not {self.min_volume_ml}")
        super().__post_init__()
        for seed in self.seeds:
            check_point(seed)
        self._check_refinement()
        self._check_solid()
        if self.one_file and not (self.labels_pick or self.split or len(self.levels) > 1):
            raise UsageError(
                f"there is one mesh: {name_parameter('one_file', True)} puts labels, components"
                f" ({name_parameter('split', True)}) or several iso values into one file"
            )
        from clrecon.geometry.iso_rule import check_topology  # numpy: not loaded before a job starts

        options.check_space(self.space)
        check_topology(self.topology)
        if self.grow_from or self.method_used != "t-mc" or self.vertex_rule != "linear":
            check_growing(
                self.method_used, self.grow_from, self.vertex_rule, topology=self.topology, inside=self.inside,
                has_labels=self.labels is not None, makes_labels=self.labels is not None and bool(self.labels.label),
            )  # fmt: skip
        if self.labels_pick and self.below is not None:
            raise UsageError("labels take what lies from one iso value on, not below it")
        if self.labels_pick and self.topology != "separated":
            raise UsageError(f"the topology {self.topology} follows HU: leave it out with labels, which pick the cells")

    def _check_surface(self) -> None:
        """Refuse an unknown kind of surface, and `cortex` where HU do not place the outer surface of bone."""
        options.check_surface(self.surface, None, "mask")
        if self.surface == "hu":
            return
        name = name_parameter("surface", self.surface)
        if self.surface == "mask":
            if self.labels is None:
                raise UsageError(f"{name} is that of labels: give their file with {name_parameter('labels')}")
            return
        if not self.follows_hu:
            raise UsageError(f"{name} is read from the HU: the surface of a mask does not depend on them")
        if self.inside != "above":
            raise UsageError(
                f"{name} is the outer surface of bone, which lies above an iso value: leave ranges and"
                f" {name_parameter('below')} out"
            )
        if self.method_used in ("t-mc-soup", "skimage"):
            raise UsageError(f"{name} moves the vertices of one mesh: leave {name_parameter('method')} out")

    def _check_masks(self) -> None:
        """Refuse settings that have no effect on labels' own surfaces, which do not depend on HU."""
        if self.follows_hu:
            return
        levels = (self.iso_value, self.below, self.preset, self.half_way)
        turned = (self.field_of_view, self.region, self.preprocess)
        if any(given is not None for given in (*levels, *turned)) or self.remove_table:
            raise UsageError(
                "the surface of a mask does not depend on HU: leave out iso values, presets, and what turns voxels into"
                " air"
            )

    def _check_half_way(self) -> None:
        if self.half_way is None:
            return
        if self.iso_value is not None or self.preset is not None:
            raise UsageError("give either an iso value, a preset or two materials, not more than one of them")
        if isinstance(self.half_way, str):
            if self.half_way != "auto":
                raise UsageError(f"half way between what? {self.half_way!r} is neither auto nor two numbers of HU")
            return
        from clrecon.anatomy.iso_choice import half_iso_value

        if len(self.half_way) != 2:
            raise UsageError(f"half way needs two numbers of HU, bone and tissue, not {tuple(self.half_way)}")
        half_iso_value(*self.half_way)

    def _check_keep(self) -> None:
        if self.keep is None:
            return
        if self.keep != "bone":
            raise UsageError(f"what is kept can be told for bone, not for {self.keep!r}: keep is bone or left out")
        if self.labels_pick:
            raise UsageError("labels say what is kept: leave keep bone out")
        if self.inside != "above":
            raise UsageError("bone lies above an iso value: keep bone goes with neither below nor a range")

    def _check_all_parts(self) -> None:
        if not self.all_parts:
            return
        option = name_parameter("all_parts", True)
        if not self.is_for_print:
            raise UsageError(
                f"{option} belongs to {name_parameter('purpose', 'print')}; without it the largest bone alone is kept;"
                " other meshes have all components unless an option leaves some out"
            )
        if self.keep_largest is not None or self.seeds or self.labels_pick:
            raise UsageError(
                f"{option} keeps all bones: leave out what chooses some (seeds, labels, a number of parts)"
            )

    def _check_below(self) -> None:
        if self.below is None:
            if self.keep_outside:
                raise UsageError("what is outside of the patient is only left out of what lies below an iso value")
            return
        if self.iso_value is not None or self.preset is not None or self.half_way is not None:
            raise UsageError("give either an iso value or what to stay below, not both")

    def _check_levels(self) -> None:
        if isinstance(self.half_way, str) or not self.follows_hu:
            return
        if not self.levels:
            raise UsageError("give at least one iso value in HU")
        for number, level in enumerate(self.levels):
            for value in level if isinstance(level, tuple) else (level,):
                if not math.isfinite(value):
                    raise UsageError(f"the iso value must be a finite number of HU, not {value}")
            if level in self.levels[:number]:
                raise UsageError(f"the iso value {name_level(level)} HU is given twice")
            self._check_range(level)

    def _check_range(self, level: float | tuple[float, ...]) -> None:
        if not isinstance(level, tuple):
            return
        name = name_level(level)
        if len(level) != 2:
            raise UsageError(f"a range of HU has two ends, {name} has {len(level)}")
        if level[0] >= level[1]:
            raise UsageError(f"the range {name} HU holds nothing: give its lower end first, then a higher one")
        if self.below is not None:
            raise UsageError(f"below takes iso values, not the range {name} HU")
        if self.labels_pick:
            raise UsageError(f"labels take one iso value, not the range {name} HU")
        if self.topology == "trilinear":
            raise UsageError(f"the topology trilinear follows one level, the range {name} HU has two: leave it out")

    def _check_solid(self) -> None:
        solid = name_parameter("solid", True)
        if self.seal_mm is not None:
            if not self.solid:
                raise UsageError(f"{name_parameter('seal_mm')} closes pores for {solid}: ask for that too")
            if not (math.isfinite(self.seal_mm) and self.seal_mm > 0.0):
                raise UsageError(f"the radius that closes pores is a length in mm above 0, not {self.seal_mm:g}")
        if not self.solid:
            return
        if self.labels_pick:
            raise UsageError("labels are made solid one by one: LabelChoice(solid=True)")
        if self.inside != "above":
            raise UsageError(
                f"{solid} fills what lies within the values from one level on: it goes with neither"
                f" {name_parameter('below')} nor a range"
            )
        if len(self.levels) > 1:
            raise UsageError(
                f"{solid} takes one iso value, not {len(self.levels)}: what is enclosed differs at each; make one mesh"
                " at a time"
            )

    def _check_refinement(self) -> None:
        if self.smooth is not None and not 1 <= self.smooth <= 1000:
            raise UsageError(f"smoothing takes from 1 to 1000 iterations, not {self.smooth}")
        if self.decimate is not None and not 0.0 < self.decimate < 1.0:
            raise UsageError(f"the share of triangles to remove is between 0 and 1, not {self.decimate:g}")
        if self.max_deviation_mm is None:
            return
        if self.method == "g-mc":
            raise UsageError(
                f"{name_parameter('method', 'g-mc')} collapses without a bound: leave"
                f" {name_parameter('max_deviation_mm')} out, or take {name_parameter('method', 's-mc')}"
            )
        if not self.refines:
            raise UsageError("a largest deviation bounds smoothing and decimation: ask for one of them too")
        if not (math.isfinite(self.max_deviation_mm) and self.max_deviation_mm > 0.0):
            raise UsageError(f"the largest deviation is a length in mm above 0, not {self.max_deviation_mm:g}")

    @property
    def is_shared_out(self) -> bool:
        """True where spans of slices go to several devices, or to workers."""
        return self.scheduler is not None or self.uses_all_devices

    @property
    def levels(self) -> tuple[float | tuple[float, ...], ...]:
        """The iso values or ranges in HU, one for each surface; NaN for values that are measured in the scan."""
        if not self.follows_hu:
            return ()
        if self.below is not None:
            return tuple(self.below) if isinstance(self.below, Sequence) else (self.below,)
        if isinstance(self.half_way, str):
            return (math.nan,)
        if self.half_way is not None:
            from clrecon.anatomy.iso_choice import half_iso_value

            return (half_iso_value(*self.half_way).iso_value,)
        if self.iso_value is None:
            return (find_iso_preset(self.preset or DEFAULT_PRESET).iso_value,)
        if isinstance(self.iso_value, Sequence):
            return tuple(tuple(level) if isinstance(level, Sequence) else level for level in self.iso_value)
        return (self.iso_value,)

    @property
    def follows_hu(self) -> bool:
        """True where HU place the surfaces; False for labels' own surfaces."""
        return self.labels is None or self.labels.surface == "hu"

    @property
    def labels_pick(self) -> bool:
        """True where the label map makes the meshes; False without one, and where it only has seeds."""
        return self.labels is not None and not self.seed_labels

    @property
    def seed_labels(self) -> tuple[str, ...]:
        return tuple(str(seed)[len(LABEL_SEED) :] for seed in self.grow_from if is_label_seed(seed))

    @property
    def method_used(self) -> MethodName:
        return self.method or ("i-mc" if self.grow_from else "t-mc")

    @property
    def decimate_used(self) -> float | None:
        """Share of the triangles to take away, where the method says one if none is given."""
        if self.decimate is not None or self.method not in ("g-mc", "s-mc"):
            return self.decimate
        from clrecon.operators.surface.methods import DECIMATED_SHARE

        return DECIMATED_SHARE

    @property
    def inside(self) -> str:
        """Values that the surfaces enclose, see `clrecon.geometry.iso_rule.IsoRule`; "between" if one is a range."""
        if self.below is not None:
            return "below"
        return "between" if any(isinstance(level, tuple) for level in self.levels) else "above"

    @property
    def is_for_print(self) -> bool:
        """True where what a printer needs to know is measured."""
        return self.purpose is not None and find_purpose(self.purpose).is_for_print

    @property
    def refines(self) -> bool:
        return self.smooth is not None or self.decimate_used is not None

    @property
    def preset_used(self) -> str | None:
        """Name of the preset behind `levels`; None if the value was given, is half way, or there is none."""
        named = any(given is not None for given in (self.iso_value, self.below, self.half_way))
        return None if named or not self.follows_hu else find_iso_preset(self.preset or DEFAULT_PRESET).name

    @property
    def selects(self) -> bool:
        if self.keep is not None:
            return True
        return self.split or bool(self.seeds) or self.keep_largest is not None or self.min_volume_ml is not None
