"""Foreign slices inside the stack of a cloud job: found before anything is masked, named, and dropped if asked for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from clrecon.jobs.cloud.settings import CloudSettings
from clrecon.jobs.cloud.trail import Trail
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.points.ghost_slices import GhostSlices

MOST_NAMED = 10
"""Most slices that a warning names."""


def find_ghosts(resident: DeviceVolume, level: float, settings: CloudSettings, progress: Progress) -> GhostSlices:
    """Test the slices of a scan by the voxels of the band, or of the iso value `level` and above."""
    from clrecon.operators.points.slice_overlap import find_ghost_slices

    band = settings.hu if isinstance(settings.hu, Sequence) else (level, math.inf)
    return find_ghost_slices(resident, band, progress=progress)


def drop_ghosts(trail: Trail, found: GhostSlices, volume: Volume) -> None:
    """Remove the points of ghost slices."""
    from clrecon.points.ghost_slices import drop_ghost_slices

    trail.start()
    step = drop_ghost_slices(trail.cloud, found, volume=volume)
    trail.add("ghost slices", step, takes_noise=True)


def warn_of_ghosts(trail: Trail, found: GhostSlices) -> None:
    """Warn of ghost slices whose points stay."""
    if not found.slices:
        return
    names = ", ".join(map(str, found.slices[:MOST_NAMED]))
    more = f" and {len(found.slices) - MOST_NAMED} more" if len(found.slices) > MOST_NAMED else ""
    one = len(found.slices) == 1
    trail.warnings.append(
        f"{'slice' if one else 'slices'} {names}{more} of {len(found.points)}, counted from 0,"
        f" {'is' if one else 'are'} unlike both neighbours, as foreign images are; the points stay: look at"
        f" {'it' if one else 'them'}, or drop {'its' if one else 'their'} points"
        f" ({name_parameter('ghost_slices', 'drop')})"
    )
