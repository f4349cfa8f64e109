"""The volume that a filter made, with what was done in its report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.certificate import amend
from clrecon.operators.resident.device_volume import DeviceVolume


def report_filter(volume: Volume, voxels: NDArray[Any], facts: dict[str, Any], warnings: Sequence[str]) -> Volume:
    """Return a volume with filtered voxels, and one step more in ``report["filtered"]``.

    volume: As it was before.
    voxels: ndarray, shape (nk, nj, ni)
    facts: The step, in plain JSON types.
    warnings: Go to those of the report.
    """
    made = volume.with_voxels(voxels)
    steps = (made.report.get("filtered") or {}).get("steps", [])
    told = list(made.report.get("warnings", []))
    made.report = amend(made.report, filtered={"steps": [*steps, facts]}, warnings=[*told, *warnings])
    return made


def finish_result(
    resident: DeviceVolume,
    voxels: NDArray[Any],
    voxels_d: Any,
    facts: dict[str, Any],
    warnings: Sequence[str],
    *,
    keep: bool,
) -> Volume | DeviceVolume:
    """Return the filtered volume; with `keep` on the device of `resident`.

    voxels_d: The voxels on the device, if they are there as a whole.
    others: See `report_filter`.
    """
    made = report_filter(resident.volume, voxels, facts, warnings)
    return resident.follow(made, voxels_d) if keep else made
