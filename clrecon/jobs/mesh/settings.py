"""Settings of the mesh job, validated on construction, and the choice of labels that become meshes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs.mesh.seeds import LABEL_SEED, check_growing, check_point, is_label_seed
from clrecon.jobs.options import InputSettings
from clrecon.jobs.presets import DEFAULT_PRESET, find_iso_preset, find_purpose
from clrecon.system.arguments import name_parameter
from clrecon.system.options import option

if TYPE_CHECKING:
    from clrecon.labels import LabelMap


_ITERATIONS = 20


def name_level(level: float | Sequence[float]) -> str:
    """Write an iso value or a range as text: ``200``, ``100:300``."""
    return ":".join(f"{value:g}" for value in level) if isinstance(level, Sequence) else f"{level:g}"


@dataclass(frozen=True)
class MeshSettings(InputSettings):
    """Settings of the mesh job.

    iso_value: float or sequence of float or (low, high). HU; inside is ``>= iso_value``.  Several make one mesh each.
        A pair in the sequence is a range, both ends included: ``((100, 300),)``.
    below: In place of an iso value: inside is ``< below``, HU.  The air around the patient is left out.
    keep_outside: With `below`: keep the air around the patient.
    preset: Name of an iso value, see `clrecon.jobs.presets`. If neither is given, the preset is "bone".
    half_way: "auto" or (bone, tissue). In place of an iso value: half way between the two materials, measured in the
        scan or given in HU.
    space: {"lps", "ras"}. Patient frame of the written mesh.
    closed: Close the surface where it meets the border of the volume (outside is air).
    topology: {"separated", "trilinear"}. Rule where the voxels around a cell do not tell which of them are joined, see
        `extract_isosurface`.
    method: One of `clrecon.operators.surface.methods.METHODS`; None: "i-mc" with seeds in `grow_from`, else "t-mc".
    grow_from: sequence of str or (x, y, z). Seeds of the method "i-mc": "auto", points in mm of the frame `space`, and
        ``label:NAME`` of the label map `labels`, which then makes no meshes of its own.
    vertex_rule: {"linear", "golden", "golden-search"}. Where on an edge a vertex lies, see `extract_isosurface`.
    keep: "bone". Keep only components that look like bone, see `clrecon.mesh.compare.walls`.  With `keep_largest`: of
        these the largest.
    keep_largest: Keep only this many components, the largest by area.
    min_volume_ml: Keep only components of at least this volume.  With `keep_largest`: of these the largest.
    seeds: sequence of (x, y, z). Keep only the components whose surface lies nearest to these points, in mm of the
        frame `space`.
    solid: Fill what the surface encloses, such as marrow, see `clrecon.fill_enclosed`.
    seal_mm: With `solid`: radius of the balls that close pores, mm; None: 2.5 to 3, by the voxels.
    all_parts: With the purpose ``"print"``: keep all components that look like bone, not the largest alone.  They are
        named objects of a .3mf, and one mesh in other formats.
    split: Write one mesh for each component, the largest first.
    one_file: Write all meshes (labels, components, iso values) as named objects of one file, each in a colour of its
        own.
    labels: A label map: one mesh for each label, see `LabelChoice`.
    smooth: Iterations of smoothing, see `clrecon.mesh.smooth_mesh`; None: none.
    decimate: Share of the triangles to remove, see `clrecon.mesh.decimate_mesh`; None: none.
    max_deviation_mm: Bound of smoothing and of decimation, mm; None: a quarter of the shortest voxel step.
    purpose: Purpose of the mesh, for which more is measured.  It sets nothing here, see
        `clrecon.jobs.mesh.purposes.settings_for`.
    strict: Measure everything that a gate needs, triangles that cut each other included.
    **shared: See `clrecon.jobs.options.InputSettings`.
    """

    iso_value: float | Sequence[float | Sequence[float]] | None = None
    below: float | Sequence[float] | None = None
    keep_outside: bool = False
    preset: str | None = None
    half_way: str | Sequence[float] | None = None
    space: str = "lps"
    closed: bool = True
    topology: str = "separated"
    method: str | None = None
    grow_from: Sequence[str | Sequence[float]] = ()
    vertex_rule: str = "linear"
    keep: str | None = option(
        "--keep",
        "bone",
        "bone: keep the components whose walls look like bone, not heart and vessels with contrast medium, nor a table",
        group="selection",
        parse=str.lower,
    )
    keep_largest: int | None = option(
        "--keep-largest", "N", "keep the N largest components only", group="selection", parse=int, first=True
    )
    min_volume_ml: float | None = option(
        "--min-volume",
        "ML",
        "keep components of at least ML millilitres only",
        group="selection",
        parse=float,
        first=True,
    )
    seeds: Sequence[Sequence[float]] = ()
    solid: bool = False
    seal_mm: float | None = None
    all_parts: bool = False
    split: bool = False
    one_file: bool = False
    labels: LabelChoice | None = None
    smooth: int | None = option(
        "--smooth",
        "N",
        f"smooth with N iterations of a windowed sinc filter (default: {_ITERATIONS})",
        group="refinement",
        parse=int,
        nargs="?",
        const=_ITERATIONS,
    )
    decimate: float | None = option(
        "--decimate",
        "SHARE",
        "take away this share of the triangles, such as 0.9, or as much as the largest deviation lets",
        group="refinement",
        parse=float,
        first=True,
    )
    max_deviation_mm: float | None = option(
        "--max-deviation",
        "MM",
        "smoothing and decimation each move nothing further (default: a quarter of the shortest voxel step)",
        group="refinement",
        parse=float,
    )
    purpose: str | None = None
    strict: bool = False

    def __post_init__(self) -> None:
        if self.iso_value is not None and self.preset is not None:
            raise UsageError("give either an iso value in HU or a preset, not both")
        self._check_masks()
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
        from clrecon.geometry import frame_from_lps  # numpy: not loaded before a job starts
        from clrecon.geometry.iso_rule import check_topology

        frame_from_lps(self.space)
        check_topology(self.topology)
        if self.grow_from or self.method_used != "t-mc" or self.vertex_rule != "linear":
            check_growing(
                self.method_used, self.grow_from, self.vertex_rule, topology=self.topology, inside=self.inside,
                has_labels=self.labels is not None, makes_labels=self.labels is not None and bool(self.labels.wanted),
            )  # fmt: skip
        if self.labels_pick and self.below is not None:
            raise UsageError("labels take what lies from one iso value on, not below it")
        if self.labels_pick and self.topology != "separated":
            raise UsageError(f"the topology {self.topology} follows HU: leave it out with labels, which pick the cells")

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
        for place, level in enumerate(self.levels):
            for value in level if isinstance(level, tuple) else (level,):
                if not math.isfinite(value):
                    raise UsageError(f"the iso value must be a finite number of HU, not {value}")
            if level in self.levels[:place]:
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
            raise UsageError(f"the share of triangles to take away lies between 0 and 1, {self.decimate:g} does not")
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
        """Labels that surfaces grow from."""
        return tuple(str(seed)[len(LABEL_SEED) :] for seed in self.grow_from if is_label_seed(seed))

    @property
    def method_used(self) -> str:
        """The method of marching cubes."""
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
        """True where the surface is smoothed or decimated."""
        return self.smooth is not None or self.decimate_used is not None

    @property
    def preset_used(self) -> str | None:
        """Name of the preset behind `levels`; None if the value was given, is half way, or there is none."""
        named = any(given is not None for given in (self.iso_value, self.below, self.half_way))
        return None if named or not self.follows_hu else find_iso_preset(self.preset or DEFAULT_PRESET).name

    @property
    def selects(self) -> bool:
        """True where components are selected."""
        if self.keep is not None:
            return True
        return self.split or bool(self.seeds) or self.keep_largest is not None or self.min_volume_ml is not None


@dataclass(frozen=True)
class LabelChoice:
    """The labels of a map that become meshes, and the kind of their surfaces.

    path: NIfTI, NRRD, DICOM SEG or RTSTRUCT.
    wanted: Numbers or names; empty means all that have a surface.
    grow_mm: See `clrecon.operators.surface.labels.extract_labels`.
    solid: Fill less dense parts within a label.
    surface: {"hu", "mask"}. HU place the vertices (`clrecon.operators.surface.labels.extract_labels`), or each label
        has its own surface (`clrecon.operators.surface.label_masks.extract_label_masks`).
    hidden: Labels that become no mesh.
    colors: tuple of (str or int, str). Labels and their colours, for PLY, GLB and 3MF.
    """

    path: str | Path
    wanted: tuple[str | int, ...] = ()
    grow_mm: float | None = None
    solid: bool = False
    surface: str = "hu"
    hidden: tuple[str | int, ...] = ()
    colors: tuple[tuple[str | int, str], ...] = ()

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
        """Return the numbers of the labels that become meshes."""
        hidden = {labels.find(label) for label in self.hidden}
        wanted = [labels.find(label) for label in self.wanted] or list(labels.numbers)
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

        given = {}
        for label, color in self.colors:
            number = labels.find(label)
            if number in given:
                raise UsageError(f"label {number} {labels.name(number)} has two colours")
            given[number] = _as_tuple(find_color(color))
        if not distinct:
            return given
        own = distinct_colors(len(numbers))
        return {number: _as_tuple(color) for number, color in zip(numbers, own, strict=True)} | given


def _as_tuple(color: Any) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in color)
    return red, green, blue
