"""The points of a cloud job on their way: from a scan or a file, and through the steps, in their one order."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.jobs.cloud.settings import CloudSettings, Clustering
from clrecon.jobs.presets import DEFAULT_PRESET, find_iso_preset
from clrecon.jobs.run import trial_cube
from clrecon.points.cloud import PointCloud, PointStep, count_numbers
from clrecon.points.ghost_slices import GhostSlices, drop_ghost_slices
from clrecon.points.stencil import Lattice
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.records import Gate
from clrecon.system.text import join_names

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clrecon.labels import LabelMap
    from clrecon.opencl import Device
    from clrecon.operators.resident.device_volume import DeviceVolume


def take_points(
    subject: Volume | PointCloud,
    labels: LabelMap | None,
    device: Device,
    settings: CloudSettings,
    progress: Progress,
    ghosts: GhostSlices | None = None,
) -> CloudSteps:
    """Make the cloud of a volume, or take one that was read, and run the steps; `ghosts` are of the unmasked scan."""
    from clrecon.operators.resident.device_volume import DeviceVolume

    if not isinstance(subject, Volume):
        steps = CloudSteps(subject)
        run_steps(steps, settings, device, None, progress)
        return steps
    with DeviceVolume(subject, device=device, memory=settings.memory) as resident:
        if ghosts is None:
            ghosts = find_ghosts(resident, iso_value_of(settings), settings, progress)
        steps = _extract_cloud(resident, labels, settings, progress)
        if settings.ghost_slices == "drop":
            step = drop_ghost_slices(steps.cloud, ghosts, volume=subject)
            steps.add("ghost slices", step, takes_noise=True)
        else:
            warn_of_ghosts(steps, ghosts)
        run_steps(steps, settings, device, resident, progress)
    return steps


def _extract_cloud(
    resident: DeviceVolume, labels: LabelMap | None, settings: CloudSettings, progress: Progress
) -> CloudSteps:
    from clrecon.operators.points.point_extraction import extract_points

    began = time.perf_counter()
    level: dict[str, Any] = {"hu": settings.hu} if settings.is_band else {"iso_value": iso_value_of(settings)}
    cloud = extract_points(
        resident, **level, kind=settings.kind, labels=labels, label=settings.label, paper=settings.paper,
        progress=progress,
    )  # fmt: skip
    return CloudSteps(cloud, began)


def iso_value_of(settings: CloudSettings) -> float:
    """Return the iso value that was given, or that of the default preset of meshes."""
    if settings.hu is None or settings.is_band:
        return find_iso_preset(DEFAULT_PRESET).iso_value
    assert not isinstance(settings.hu, (tuple, list))
    return float(settings.hu)  # type: ignore[arg-type]


def try_steps(device: Device, settings: CloudSettings, is_cloud: bool) -> None:
    """Build the kernels by running all steps on a small cube."""
    cube = trial_cube()
    subject: Volume | PointCloud = PointCloud(np.argwhere(cube.voxels >= 0).astype(np.float32)) if is_cloud else cube
    take_points(subject, None, device, settings.for_trial(), ignore_progress)


def run_steps(
    steps: CloudSteps, settings: CloudSettings, device: Device, resident: DeviceVolume | None, progress: Progress
) -> None:
    """Run the steps that are asked for, from the clusters to the spacing; `resident` is the volume of a scan."""
    shared: dict[str, Any] = {"device": device.current, "memory": settings.memory, "progress": progress}
    if settings.clustering is not None:
        _cluster_points(steps, settings, settings.clustering, resident, shared)
    if "grid" in settings.denoise:  # what paper B's grid takes for noise
        from clrecon.operators.points.thinning import remove_sparse_cells

        steps.add("sparse cells", remove_sparse_cells(steps.cloud, **shared), takes_noise=True)
    if settings.outliers is not None:
        from clrecon.operators.points.denoising import remove_outliers

        steps.add("outliers", remove_outliers(steps.cloud, deviations=settings.outliers, **shared), takes_noise=True)
    if "bilateral" in settings.denoise:
        from clrecon.operators.points.denoising import denoise_points

        steps.add("bilateral", denoise_points(steps.cloud, paper=settings.paper, **shared))
    # Points of a surface have the normals of its field until they move.
    if settings.normals and steps.cloud.normals is None:
        from clrecon.operators.points.normals import estimate_normals

        inside = None if settings.viewpoint is None else in_lps(settings.viewpoint, settings.space)
        steps.add("normals", estimate_normals(steps.cloud, viewpoint=inside, **_with_volume(resident, shared)))
    if settings.spacing is not None:
        from clrecon.operators.points.thinning import thin_points

        steps.add("spacing", thin_points(steps.cloud, settings.spacing, **shared))


def _cluster_points(
    steps: CloudSteps,
    settings: CloudSettings,
    chosen: Clustering,
    resident: DeviceVolume | None,
    shared: dict[str, Any],
) -> None:
    """Cluster the points; drop noise and the clusters that no keep rule names."""
    from clrecon.operators.points.clusters import cluster_points
    from clrecon.points.keep import keep_clusters

    eps, volume = chosen.eps, resident
    if resident is not None and not steps.cloud.has_ijk:  # points of a surface: free, but of that scan
        eps, volume = Lattice.of(resident.volume).default_eps if eps is None else eps, None
    groups = cluster_points(steps.cloud, eps, chosen.min_samples, **_with_volume(volume, shared))
    steps.add("clusters", groups)
    rules = rules_in_lps(settings)
    steps.add("keep", keep_clusters(groups.cloud, rules, cores=groups.cores, figures=groups.figures), takes_noise=True)


def _with_volume(resident: DeviceVolume | None, shared: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments for a function that wants the volume, which has a device of its own."""
    return shared if resident is None else {"volume": resident, "progress": shared["progress"]}


def in_lps(point: Sequence[float], space: str) -> tuple[float, ...]:
    x, y, z = point
    return (x, y, z) if space == "lps" else (-x, -y, z)


def rules_in_lps(settings: CloudSettings) -> list[str]:
    """Return the keep rules with seeds in LPS; they are given in the frame of the output."""
    if settings.space == "lps":
        return list(settings.keep)
    rules = []
    for rule in settings.keep:
        kind, _, rest = rule.partition(":")
        if kind.strip().lower() == "seed":
            point = in_lps([float(word) for word in rest.split(",")], settings.space)
            rule = f"seed:{','.join(map(repr, point))}"
        rules.append(rule)
    return rules


_MOST_NAMED = 10
"""Most slices that a warning names."""


def find_ghosts(resident: DeviceVolume, level: float, settings: CloudSettings, progress: Progress) -> GhostSlices:
    """Test the slices of a scan by the voxels of the band, or of the iso value `level` and above."""
    from clrecon.operators.points.slice_overlap import find_ghost_slices

    band = settings.hu if isinstance(settings.hu, Sequence) else (level, math.inf)
    return find_ghost_slices(resident, band, progress=progress)


def warn_of_ghosts(steps: CloudSteps, ghosts: GhostSlices) -> None:
    if not ghosts.slices:
        return
    single = len(ghosts.slices) == 1
    steps.warnings.append(
        f"{'slice' if single else 'slices'} {join_names(ghosts.slices, _MOST_NAMED)} of {len(ghosts.points)}, counted"
        f" from 0, {'is' if single else 'are'} unlike both neighbours, as foreign images are; the points stay: look at"
        f" {'it' if single else 'them'}, or drop {'its' if single else 'their'} points"
        f" ({name_parameter('ghost_slices', 'drop')})"
    )


_LEAST_KEPT = 0.5
"""Least share of its points that a step must keep which is there to take noise away."""

_EXTRACTED = (
    *("kind", "iso_value_hu", "band_hu", "voxels", "voxels_in_band", "cortex"),
    *("share", "label", "paper", "slabs", "device_bytes"),
)
"""Entries of the first cloud's report that its step tells."""

_TAKEN_BY_RULE = ("small cluster", "other cluster")
"""Reasons that the caller asks for by number or place; they say nothing about noise."""


class CloudSteps:
    """The points of a job, from the first cloud to the last.

    began: When the extraction began, by `perf_counter`; None for a cloud that was read.
    fate: ndarray, shape (n,), uint8. For each point of the first cloud 0, or r where it went by ``reasons[r - 1]``.
    """

    def __init__(self, cloud: PointCloud, began: float | None = None):
        self.first = self.cloud = cloud
        self.entries: list[dict[str, Any]] = []
        self.reasons: list[str] = []
        self.fate: NDArray[np.uint8] = np.zeros(len(cloud), np.uint8)
        self.gates: list[Gate] = []
        self.warnings: list[str] = []
        self._there: NDArray[np.intp] | None = None
        self._lap = time.perf_counter() if began is None else began
        self.warnings += cloud.report.get("warnings", ())
        if began is not None:
            facts = {name: cloud.report[name] for name in _EXTRACTED if name in cloud.report}
            self.entries.append({"step": "points", "points_after": len(cloud), **facts, "seconds": self._seconds()})

    def _seconds(self) -> float:
        now = time.perf_counter()
        elapsed, self._lap = now - self._lap, now
        return round(elapsed, 4)

    def add(self, name: str, step: PointStep, *, takes_noise: bool = False) -> None:
        """Take the result of a step over; one that `takes_noise` is judged by the share of points that it took."""
        numbers = [0]
        for reason, count in step.counts.items():
            if count and reason not in self.reasons:
                self.reasons.append(reason)
            numbers.append(self.reasons.index(reason) + 1 if count else 0)
        is_gone = step.removed > 0
        if is_gone.any():
            gone, left = np.flatnonzero(is_gone), np.flatnonzero(~is_gone)
            there = self._there
            self.fate[gone if there is None else there[gone]] = np.array(numbers, np.uint8)[step.removed[gone]]
            self._there = left if there is None else there[left]
        self.cloud = step.cloud
        self.entries.append({"step": name, **step.as_dict(), "seconds": self._seconds()})
        self.warnings += step.warnings
        if takes_noise:
            self._judge(name, len(step.removed), step.counts)

    def _judge(self, name: str, before: int, counts: Mapping[str, int]) -> None:
        lost = sum(count for reason, count in counts.items() if reason not in _TAKEN_BY_RULE)
        share = 1.0 - lost / before if before else 1.0
        by_reason = ", ".join(f"{count:,} {reason}" for reason, count in counts.items() if count)
        text = f"{name}: {lost:,} of {before:,} points gone ({by_reason})" if lost else f"{name}: no point gone"
        self.gates.append(
            Gate(f"points_kept_{name.replace(' ', '_')}", share, _LEAST_KEPT, None, share >= _LEAST_KEPT, text)
        )

    def check(self, allow_point_loss: bool) -> None:
        """Refuse the loss of more points than noise can be."""
        failed = [gate for gate in self.gates if gate.ok is False]
        if not failed:
            return
        text = f"{failed[0].text}: more than half is no noise"
        if not allow_point_loss:
            raise RefusedInputError(
                f"{text}; look at its parameters, or allow it ({name_parameter('allow_point_loss', True)})"
            )
        self.warnings += [f"{gate.text}: more than half is no noise, and was allowed" for gate in failed]

    @property
    def counts(self) -> dict[str, int]:
        """Points that went, by reason, in the order of the steps."""
        return count_numbers(self.fate, self.reasons)

    def removed_cloud(self) -> PointCloud:
        """Return the first cloud with the fate of each point as its label: 0 kept, else the number of the reason."""
        names = {0: "kept", **dict(enumerate(self.reasons, 1))}
        report = {**self.first.report, "label_names": names}
        cloud = self.first.changed(labels=self.fate.astype(np.int32))
        cloud.report = report
        return cloud
