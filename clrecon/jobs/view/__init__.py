"""The job of the view: its settings here, its inputs and its page beside it.  The settings load no numpy."""

from __future__ import annotations

from collections.abc import Sequence

from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.options import check_space, mesh_space_option
from clrecon.system.arguments import Space
from clrecon.system.light_dataclass import dataclass, field, replace
from clrecon.system.options import option

_MOST_NAME = 80


@dataclass(frozen=True, kw_only=True)
class ViewSettings:
    """Settings of the view.

    scan: How surfaces are made of inputs that are scans; its `space` is the frame in which places are shown.
    names: Those without one are numbered; file names are not shown, as they can hold the name of a patient.
    """

    scan: MeshSettings = field(default_factory=MeshSettings)
    names: Sequence[str] = option(
        "--name TEXT",
        "name of an input on the page, in the order of the inputs; may be given again (default: surface 1 ...)",
        default=(),
        action="append",
    )
    mesh_space: Space | None = mesh_space_option("mesh files that do not name theirs")
    with_slices: bool = option(
        "--with-slices", "put slices of the scan on the page of --html: 10 MB at most, or coarser", first=True
    )
    state: str | None = option(
        "--state FILE",
        "show what a view showed when it was saved: a file .view.json of the key s, of the same inputs",
        group="state",
        first=True,
    )

    def __post_init__(self) -> None:
        check_space(self.mesh_space)
        for name in self.names:
            if not name.strip() or len(name) > _MOST_NAME or not name.isprintable():
                raise UsageError(f"a name has 1 to {_MOST_NAME} printable characters, not {name[:_MOST_NAME]!r}")
        if self.scan.labels_pick and not self.scan.one_file:  # each label with a colour of its own
            object.__setattr__(self, "scan", replace(self.scan, one_file=True))
