"""Settings of the job that shows, validated on construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import MeshSettings

MOST_NAME = 80


@dataclass(frozen=True, kw_only=True)
class ViewSettings:
    """Settings of the job.

    scan: How surfaces are made of inputs that are scans; its `space` is the frame in which places are shown.
    mesh_space: {"lps", "ras"}. Patient frame of mesh files that do not name theirs; None: LPS, with a warning.
    names: Names of the inputs, in their order, to be shown; those without one are numbered.  File names are not shown:
        they can hold the name of a patient.
    """

    scan: MeshSettings = field(default_factory=MeshSettings)
    mesh_space: str | None = None
    names: Sequence[str] = ()

    def __post_init__(self) -> None:
        from clrecon.geometry import frame_from_lps

        if self.mesh_space is not None:
            frame_from_lps(self.mesh_space)
        for name in self.names:
            if not name.strip() or len(name) > MOST_NAME or not name.isprintable():
                raise UsageError(f"a name has 1 to {MOST_NAME} printable characters, not {name[:MOST_NAME]!r}")
        if self.scan.labels_pick and not self.scan.one_file:  # each label with a colour of its own
            object.__setattr__(self, "scan", replace(self.scan, one_file=True))
