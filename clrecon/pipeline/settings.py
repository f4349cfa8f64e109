"""What a job may be told, checked when it is said."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from clrecon.errors import UsageError
from clrecon.pipeline.checks import check_field_of_view, check_memory
from clrecon.pipeline.labels import LabelChoice
from clrecon.pipeline.presets import DEFAULT_PRESET, find_preset

__all__ = ["MeshSettings"]


@dataclass(frozen=True)
class MeshSettings:
    """How a mesh is made from a CT series.

    Parameters
    ----------
    iso_value : float or sequence of float, optional
        HU; inside is ``>= iso_value``.  Several make one mesh each.
    preset : str, optional
        Name of an iso value, see `clrecon.pipeline.presets`.  Neither of both means the preset "bone".
    half_way : "auto" or (bone, tissue), optional
        In place of an iso value: half way between the two materials, measured in the scan or given in HU.
    series : str or int, optional
        Which series of the input; None leaves the choice to `read_volume`.
    phase : int, optional
        Which of its phases, where it has several.
    allow_gaps : bool
        Read a stack with missing slices.
    remove_table : bool
        Turn what is not the patient's body into air first, see `clrecon.geometry.body.remove_table`.
    field_of_view : float or "auto", optional
        Turn what lies further from the centre of the slices (mm) into air first; "auto": the circle that fits them.
    force : bool
        Read data sets without preamble or meta header.
    space : {"lps", "ras"}
        Patient frame of the written mesh.
    closed : bool
        Close the surface where it meets the border of the volume (outside is air).
    topology : {"separated", "trilinear"}
        What is done where the voxels around a cell do not say which of them are joined, see `extract_isosurface`.
    keep_largest : int, optional
        Keep only this many components, the largest by area.
    min_volume_ml : float, optional
        Keep only components of at least this volume.  With `keep_largest`: of these the largest.
    seeds : sequence of (x, y, z)
        Keep only the components whose surface lies nearest to these points, in mm of the frame `space`.
    split : bool
        One mesh a component, the largest first.
    labels : LabelChoice, optional
        A label map: one mesh a label, see `clrecon.pipeline.labels`.
    device : str, optional
        Name or index of an OpenCL device; None leaves the choice to `choose_device`.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.  What does not fit goes through in slabs.
    smooth : int, optional
        Iterations of smoothing, see `clrecon.mesh.smooth_mesh`; None: none.
    decimate : float, optional
        Share of the triangles to take away, see `clrecon.mesh.decimate_mesh`; None: none.
    max_deviation_mm : float, optional
        Bound of each of both, mm; None: a quarter of the shortest voxel step.
    strict : bool
        Measure whatever a gate needs, triangles that cut each other too.

    Raises
    ------
    UsageError
        A value is impossible, or two exclude each other.
    """

    iso_value: float | Sequence[float] | None = None
    preset: str | None = None
    half_way: str | Sequence[float] | None = None
    series: str | int | None = None
    phase: int | None = None
    allow_gaps: bool = False
    remove_table: bool = False
    field_of_view: float | str | None = None
    force: bool = False
    space: str = "lps"
    closed: bool = True
    topology: str = "separated"
    keep_largest: int | None = None
    min_volume_ml: float | None = None
    seeds: Sequence[Sequence[float]] = ()
    split: bool = False
    labels: LabelChoice | None = None
    device: str | None = None
    memory: int | None = None
    smooth: int | None = None
    decimate: float | None = None
    max_deviation_mm: float | None = None
    strict: bool = False

    def __post_init__(self) -> None:
        if self.iso_value is not None and self.preset is not None:
            raise UsageError("give either an iso value in HU or a preset, not both")
        self._check_half_way()
        if self.preset is not None:
            find_preset(self.preset)
        self._check_levels()
        if self.keep_largest is not None and self.keep_largest < 1:
            raise UsageError(f"the number of components to keep must be 1 or more, not {self.keep_largest}")
        if self.min_volume_ml is not None and not (math.isfinite(self.min_volume_ml) and self.min_volume_ml > 0):
            raise UsageError(f"the smallest volume to keep must be above 0 ml, not {self.min_volume_ml}")
        check_memory(self.memory)
        for seed in self.seeds:
            if len(seed) != 3 or not all(map(math.isfinite, seed)):
                raise UsageError(f"a seed is a point of three numbers in mm, not {tuple(seed)}")
        self._check_refinement()
        check_field_of_view(self.field_of_view)
        from clrecon.geometry import frame_from_lps  # numpy: not wanted before a job starts
        from clrecon.geometry.field import check_topology

        frame_from_lps(self.space)
        check_topology(self.topology)
        if self.labels is not None and self.topology != "separated":
            raise UsageError(f"the topology {self.topology} follows HU: leave it out with labels, which pick the cells")

    def _check_half_way(self) -> None:
        if self.half_way is None:
            return
        if self.iso_value is not None or self.preset is not None:
            raise UsageError("give either an iso value, a preset or two materials, not more than one of them")
        if isinstance(self.half_way, str):
            if self.half_way != "auto":
                raise UsageError(f"half way between what? {self.half_way!r} is neither auto nor two numbers of HU")
            return
        from clrecon.geometry import half_iso_value  # numpy: not wanted before a job starts

        if len(self.half_way) != 2:
            raise UsageError(f"half way needs two numbers of HU, bone and tissue, not {tuple(self.half_way)}")
        half_iso_value(*self.half_way)

    def _check_levels(self) -> None:
        if isinstance(self.half_way, str):
            return
        if not self.levels:
            raise UsageError("give at least one iso value in HU")
        for place, value in enumerate(self.levels):
            if not math.isfinite(value):
                raise UsageError(f"the iso value must be a finite number of HU, not {value}")
            if value in self.levels[:place]:
                raise UsageError(f"the iso value {value:g} HU is given twice")

    def _check_refinement(self) -> None:
        if self.smooth is not None and not 1 <= self.smooth <= 1000:
            raise UsageError(f"smoothing takes from 1 to 1000 iterations, not {self.smooth}")
        if self.decimate is not None and not 0.0 < self.decimate < 1.0:
            raise UsageError(f"the share of triangles to take away lies between 0 and 1, {self.decimate:g} does not")
        if self.max_deviation_mm is None:
            return
        if not self.refines:
            raise UsageError("a largest deviation bounds smoothing and decimation: ask for one of them too")
        if not (math.isfinite(self.max_deviation_mm) and self.max_deviation_mm > 0.0):
            raise UsageError(f"the largest deviation is a length in mm above 0, not {self.max_deviation_mm:g}")

    @property
    def levels(self) -> tuple[float, ...]:
        """The iso values in HU that are used, one a surface; NaN for the one that the scan has yet to give."""
        if isinstance(self.half_way, str):
            return (math.nan,)
        if self.half_way is not None:
            from clrecon.geometry import half_iso_value  # numpy: not wanted before a job starts

            return (half_iso_value(*self.half_way).iso_value,)
        if self.iso_value is None:
            return (find_preset(self.preset or DEFAULT_PRESET).iso_value,)
        if isinstance(self.iso_value, Sequence):
            return tuple(self.iso_value)
        return (self.iso_value,)

    @property
    def refines(self) -> bool:
        """The surface is smoothed or decimated."""
        return self.smooth is not None or self.decimate is not None

    @property
    def preset_used(self) -> str | None:
        """Name of the preset behind `levels`, None where the value was given or is half way."""
        named = self.iso_value is not None or self.half_way is not None
        return None if named else (self.preset or DEFAULT_PRESET)

    @property
    def selects(self) -> bool:
        """Whether components are told apart."""
        return self.split or bool(self.seeds) or self.keep_largest is not None or self.min_volume_ml is not None
