"""Settings of the compare job, validated on construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from clrecon.errors import UsageError
from clrecon.jobs.compare.methods import Compared, choose_methods
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.options import InputSettings

MOST_REPEATS = 100


@dataclass(frozen=True)
class CompareSettings(InputSettings):
    """Settings of the compare job.

    methods: Names of `clrecon.jobs.compare.methods.COMPARED`; empty: all of them.
    reference: The method whose mesh the others are compared with; it always runs.
    truth: ``truth.json`` of a phantom: what is made is compared with the true surface too.
    paper: Also compare a picture of each method with the middle slice, as a paper does, beside controls.
    repeat: Warm runs of each method, of which the median counts.
    iso_value, preset, half_way, closed: See `MeshSettings`; one level, above which is inside.
    **shared: See `clrecon.jobs.options.InputSettings`.
    """

    methods: Sequence[str] = ()
    reference: str = "t-mc"
    truth: str | Path | None = None
    paper: bool = False
    repeat: int = 3
    iso_value: float | None = None
    preset: str | None = None
    half_way: str | Sequence[float] | None = None
    closed: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        choose_methods(self.methods, self.reference)
        if not 1 <= self.repeat <= MOST_REPEATS:
            raise UsageError(f"the number of warm runs lies between 1 and {MOST_REPEATS}, not at {self.repeat}")
        if isinstance(self.iso_value, Sequence):
            raise UsageError("methods are compared at one iso value: give one number of HU, and no range")
        if len(self.as_mesh().levels) != 1:
            raise UsageError("methods are compared at one iso value")

    @property
    def chosen(self) -> tuple[Compared, ...]:
        """The methods that run, in the order of the page."""
        return choose_methods(self.methods, self.reference)

    def as_mesh(self) -> MeshSettings:
        """Return the settings of a mesh job with the same input and level."""
        shared = {field.name: getattr(self, field.name) for field in fields(InputSettings)}
        return MeshSettings(
            **shared, iso_value=self.iso_value, preset=self.preset, half_way=self.half_way, closed=self.closed
        )
