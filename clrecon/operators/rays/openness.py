"""How open the places of a volume are, for pictures with ambient occlusion: the host's side of cl/rays/openness.cl."""

from __future__ import annotations

import math
from abc import abstractmethod
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.labels import ResampledLabels
from clrecon.opencl import Stopwatch, allocate, launch, upload
from clrecon.operators.rays.ray_slabs import OPENNESS, RaySlab, SlabPicture, ray_slabs, slab_labels, upload_part
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import FieldFrame, label_variants
from clrecon.rendering.pictures.label_style import LabelStyle
from clrecon.rendering.views.camera import box_corners
from clrecon.system.light_dataclass import dataclass

_REACH_SHARE = 0.05
"""Reach of what hides light, as a share of the diagonal of the volume: the width of a vertebra in a scan of a trunk."""

_CELLS_A_DIAGONAL = 300
"""Cells along the diagonal of a volume: 5 million in a cube, 2 mm each in a scan of a trunk."""

_WHOLE = 100.0
"""Value of the grid in the open: it fits all types of voxels."""

DIRECTIONS = tuple((k, j, i) for k, j, i in product((-1, 0, 1), repeat=3) if k or j or i)
"""Directions (k, j, i) to the neighbours of a cell, in the order in which they are swept."""

_WEIGHTS = {1: 1.0 / 21.0, 2: 4.0 / 105.0, 3: 9.0 / 280.0}
"""Weights of Lebedev's quadrature of 26 points, by the number of coordinates that are not 0."""


@dataclass(frozen=True)
class OpenCells:
    """The grid of a volume's openness: voxels of a cell and cells along i, j, k, the mm of a cell, and the reach in mm.

    Cells along k may be thicker than others where slices are far apart.
    """

    voxels: tuple[int, int, int]
    counts: tuple[int, int, int]
    sides_mm: tuple[float, float, float]
    reach_mm: float

    @classmethod
    def of(cls, volume: Volume) -> OpenCells:
        diagonal = float(np.linalg.norm(np.ptp(box_corners(volume), axis=0)))
        lengths = [max(2, n) for n in volume.shape_ijk]
        wanted = [math.ceil(diagonal / _CELLS_A_DIAGONAL / spacing) for spacing in volume.spacing]
        voxels = [max(1, min(cell, n // 2)) for cell, n in zip(wanted, lengths, strict=True)]
        counts = [-(-n // cell) for n, cell in zip(lengths, voxels, strict=True)]
        sides = [cell * spacing for cell, spacing in zip(voxels, volume.spacing, strict=True)]
        return cls(tuple(voxels), tuple(counts), tuple(sides), _REACH_SHARE * diagonal)  # type: ignore[arg-type]

    @property
    def length_mm(self) -> float:
        """Mean side of a cell: the way over which its opacity counts."""
        return float(np.cbrt(np.prod(self.sides_mm)))

    def device_bytes(self, itemsize: int) -> int:
        """Bytes of the grid and of what it is made from, on the device."""
        return math.prod(self.counts) * (itemsize + 9)

    def keep(self, direction: tuple[int, int, int]) -> float:
        """Return the share that is left of what is hidden after a step in a direction (k, j, i)."""
        step = np.array(direction[::-1]) * self.sides_mm
        return math.exp(-float(np.linalg.norm(step)) / self.reach_mm)

    def find_shown(self, volume: Volume, planes: Float64Array) -> NDArray[np.uint8]:
        """Return which cells (gk, gj, gi) have their middle within half-spaces of LPS, as of `clrecon.Clip`."""
        i, j, k = ((np.arange(count) + 0.5) * cell - 0.5 for count, cell in zip(self.counts, self.voxels, strict=True))
        frame = FieldFrame.of(volume)
        starts = frame.places(volume.ijk_to_lps(np.column_stack([0.0 * k, 0.0 * k, k])))
        shown = np.ones(self.counts[::-1], bool)
        for a, b, c, offset in frame.planes(planes):
            heights = starts @ (a, b, c)
            shown &= heights[:, None, None] + (b * j)[:, None] + a * i >= offset
        return shown.astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Openness:
    """The openness of a volume on the device, for kernels with the variant OPENNESS."""

    cells: OpenCells
    grid_d: Any

    def arguments(self, share: float) -> dict[str, Any]:
        """Return the arguments of OPENNESS_PARAMETERS; `share` of the light is lost where nothing reaches."""
        cells = np.array(self.cells.voxels, np.float64)
        open_i, open_j, open_k = self.cells.counts
        return {
            "openness": self.grid_d,
            "open_i": open_i,
            "open_j": open_j,
            "open_k": open_k,
            "open_scale": np.array([*(1.0 / cells), share / _WHOLE], np.float32),
            "open_shift": np.array([*(0.5 / cells - 0.5), 1.0 - share], np.float32),
        }


@dataclass(frozen=True, eq=False)
class Hiding:
    """What of a volume hides light: opacities by value, the nearest node to v is ``floor((v - low) * scale + 0.5)``.

    opacities_d: (nodes,) float32, over the length of a cell, on the device.
    planes: (n, 4) half-spaces in LPS that are kept, None for all.
    labels, look: Labels that scale the opacity, and how; `grown` as of `slab_labels`.
    """

    opacities_d: Any
    nodes: int
    low: float
    scale: float
    planes: Float64Array | None = None
    labels: ResampledLabels | None = None
    look: LabelStyle | None = None
    grown: bool = False


class HollowedPicture(SlabPicture):
    """A picture in which hollows lose up to a share of the light, `darkening`."""

    darkening = 0.0
    openness: Openness | None = None
    _key: tuple[object, ...] = ()

    def darken_hollows(self, share: float, shown: object, planes: Float64Array | None, look: LabelStyle | None) -> None:
        """Reckon with the openness of the volume, which `shown`, clip planes and labels decide."""
        self.darkening = share
        if share > 0.0:
            hidden = None if look is None else (look.labels, look.table[:, 3].tobytes())  # a map equals only itself
            self._key = shown, None if planes is None else planes.tobytes(), hidden
            cells = OpenCells.of(self.resident.volume)
            self.beside = {OPENNESS: cells.device_bytes(self.resident.dtype.itemsize)}

    @abstractmethod
    def hide_light(self, length_mm: float) -> Hiding:
        """Return what of the volume hides light, over a length."""

    def find_openness(self, slices: int) -> None:
        """Find the openness where hollows are darkened; that of a whole volume is kept."""
        if self.darkening == 0.0:
            return
        resident, length_mm = self.resident, OpenCells.of(self.resident.volume).length_mm

        def make_openness() -> Openness:
            return find_openness(resident, slices, self.hide_light(length_mm), self.stopwatch)

        if slices < resident.volume.shape_ijk[2]:
            self.openness = make_openness()
        else:
            self.openness = resident.keep(OPENNESS, self._key, sum(self.beside.values()), make_openness)

    def add_openness(self, variants: dict[str, str], arguments: dict[str, Any]) -> None:
        """Add what a kernel needs to know of the openness, if it was found."""
        if self.openness is not None:
            variants["OPENNESS"] = "1"
            arguments.update(self.openness.arguments(self.darkening))


def find_openness(resident: DeviceVolume, slices: int, hiding: Hiding, stopwatch: Stopwatch) -> Openness:
    """Find how open the places of a volume are, with `slices` of it on the device at a time."""
    device, cells = resident.device, OpenCells.of(resident.volume)
    count, (gi, gj, gk) = math.prod(cells.counts), cells.counts
    sizes = {"gi": gi, "gj": gj, "gk": gk}
    density_d, open_d = allocate(device, 4 * count), allocate(device, 4 * count)
    _fill_cells(resident, slices, hiding, cells, (density_d, open_d), stopwatch)
    program = resident.program("rays/openness.cl")
    grid_d = allocate(device, count * resident.dtype.itemsize)
    with stopwatch.running(device):
        for dk, dj, di in DIRECTIONS:
            steps = next(cells_along for cells_along, step in ((gk, dk), (gj, dj), (gi, di)) if step)
            launch(
                device, program["sweep_light"], count // steps, density=density_d, open=open_d, di=di, dj=dj, dk=dk,
                keep=cells.keep((dk, dj, di)), weight=_WEIGHTS[abs(dk) + abs(dj) + abs(di)], **sizes,
            )  # fmt: skip
        launch(device, program["finish_openness"], count, open=open_d, openness=grid_d, whole=_WHOLE, **sizes)
    return Openness(cells, grid_d)


def _fill_cells(
    resident: DeviceVolume,
    slices: int,
    hiding: Hiding,
    cells: OpenCells,
    grids_d: tuple[Any, Any],
    stopwatch: Stopwatch,
) -> None:
    """Set the density of all cells, part by part, and what reaches them to 0."""
    device, nk = resident.device, resident.volume.shape_ijk[2]
    (ci, cj, ck), (gi, gj, _) = cells.voxels, cells.counts
    shown = np.ones((1, 1, 1), np.uint8)
    if hiding.planes is not None:
        shown = cells.find_shown(resident.volume, hiding.planes)
    shown_d = upload(device, shown)
    at_once = nk if slices >= nk else max(ck, slices // ck * ck)
    for first in range(0, nk, at_once):
        if at_once >= nk:
            slab = next(ray_slabs(resident, nk, math.inf, stopwatch))
        else:
            voxels_d, shape = upload_part(resident, first, min(first + at_once, nk), stopwatch)
            slab = RaySlab(voxels_d, shape, first, 0.0, 0.0, (1, 1, 1), 0)
        ni, nj, nk_here = slab.shape_ijk
        variants: dict[str, str] = {}
        more: dict[str, Any] = {}
        if hiding.labels is not None and hiding.look is not None:
            variants = {"LABELS": "1", **label_variants(hiding.labels.voxels.dtype)}
            labels_d = slab_labels(resident, slab, hiding.labels, stopwatch, grown=hiding.grown)
            more = {"labels": labels_d, "label_colors": upload(device, hiding.look.table)}
        count = gi * gj * -(-nk_here // ck)
        with stopwatch.running(device):  # wait: CPU devices read host arrays
            launch(
                device, resident.program("rays/openness.cl", **variants)["fill_cells"], count,
                voxels=slab.voxels_d, opacities=hiding.opacities_d, shown=shown_d, density=grids_d[0], open=grids_d[1],
                low=hiding.low, scale=hiding.scale, last_node=hiding.nodes - 1, is_clipped=hiding.planes is not None,
                ni=ni, nj=nj, nk=nk_here, gi=gi, gj=gj, ci=ci, cj=cj, ck=ck, first=first // ck * gi * gj, count=count,
                **more,
            )  # fmt: skip
