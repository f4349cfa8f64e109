"""`Trail`: a cloud on its way through the steps, and why each of its first points went."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import RefusedInputError
from clrecon.points.step import count_numbers
from clrecon.system.arguments import name_parameter
from clrecon.system.records import Gate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clrecon.points import PointCloud, PointStep

LEAST_KEPT = 0.5
"""Least share of its points that a step must keep which is there to take noise away."""

_EXTRACTED = (
    "kind",
    "iso_value_hu",
    "band_hu",
    "voxels",
    "voxels_in_band",
    "share",
    "label",
    "paper",
    "slabs",
    "device_bytes",
)
"""Entries of the first cloud's report that its step tells."""

_TAKEN_BY_RULE = ("small cluster", "other cluster")
"""Reasons that the caller asks for by number or place; they say nothing about noise."""


class Trail:
    """The points of a job, from the first cloud to the last.

    cloud: As it was extracted or read.
    began: When its extraction began, see `clock`; None for a cloud that was read.

    first, cloud: The first cloud, and what is left of it.
    steps: The report's entry of each step.
    reasons: All reasons so far for which a point went: number r of `fate` is ``reasons[r - 1]``.
    fate: ndarray, shape (n,), uint8. For each point of the first cloud 0, or the number of the reason why it went.
    """

    def __init__(self, cloud: PointCloud, began: float | None = None):
        self.first = self.cloud = cloud
        self.steps: list[dict[str, Any]] = []
        self.reasons: list[str] = []
        self.fate: NDArray[np.uint8] = np.zeros(len(cloud), np.uint8)
        self.gates: list[Gate] = []
        self.warnings: list[str] = []
        self._there: NDArray[np.intp] | None = None
        self._lap = time.perf_counter() if began is None else began
        self.warnings += cloud.report.get("warnings", ())
        if began is not None:
            facts = {name: cloud.report[name] for name in _EXTRACTED if name in cloud.report}
            self.steps.append({"step": "points", "points_after": len(cloud), **facts, "seconds": self._seconds()})

    @staticmethod
    def clock() -> float:
        """Return the time from which the seconds of the first step count."""
        return time.perf_counter()

    def _seconds(self) -> float:
        return round(time.perf_counter() - self._lap, 4)

    def start(self) -> None:
        """Begin to count the time of a step."""
        self._lap = time.perf_counter()

    def add(self, name: str, step: PointStep, *, takes_noise: bool = False) -> None:
        """Take the result of a step over.

        name: One of `clrecon.jobs.cloud.settings.STEPS`.
        takes_noise: A step that takes more than half of the points by reasons that are no rule of the caller fails a
            gate.
        """
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
        told = step.as_dict()
        self.steps.append({"step": name, **told, "seconds": self._seconds()})
        self.warnings += step.warnings
        if takes_noise:
            self._judge(name, len(step.removed), step.counts)

    def _judge(self, name: str, before: int, counts: Mapping[str, int]) -> None:
        taken = sum(count for reason, count in counts.items() if reason not in _TAKEN_BY_RULE)
        share = 1.0 - taken / before if before else 1.0
        by_reason = ", ".join(f"{count:,} {reason}" for reason, count in counts.items() if count)
        text = f"{name}: {taken:,} of {before:,} points gone ({by_reason})" if taken else f"{name}: no point gone"
        self.gates.append(
            Gate(f"points_kept_{name.replace(' ', '_')}", share, LEAST_KEPT, None, share >= LEAST_KEPT, text)
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


def name_reasons(reasons: Sequence[str]) -> list[dict[str, Any]]:
    """Return the report's list of labels of the removed points."""
    return [{"label": number, "reason": reason} for number, reason in enumerate(("kept", *reasons))]
