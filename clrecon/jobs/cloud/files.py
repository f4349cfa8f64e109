"""The files of a cloud job: their names and early checks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from clrecon.jobs.shared.outputs import check_distinct


@dataclass(frozen=True)
class CloudFiles:
    """Files that a cloud job writes.

    output: The cloud: ``.ply``, ``.vtp``, ``.npz``, ``.xyz`` or ``.las``.
    removed: The points as they were extracted, each with the number of the reason why it went as its label; 0 is kept.
    surface: A closed mesh around the cloud, in a format of meshes.
    report: The report as JSON.
    """

    output: str | Path
    removed: str | Path | None = None
    surface: str | Path | None = None
    report: str | Path | None = None

    def check(self) -> list[tuple[str, str | Path]]:
        """Refuse outputs that cannot be written, before any work is done.

        Returns: list of (str, path). Description and path of each output.
        """
        from clrecon.exchange.clouds.formats import check_cloud_format
        from clrecon.system.files import check_writable

        named = [
            ("the cloud", self.output),
            ("the cloud of removed points", self.removed),
            ("the surface", self.surface),
            ("the report", self.report),
        ]
        outputs = [(what, path) for what, path in named if path is not None]
        for path in (self.output, self.removed):
            if path is not None:
                check_cloud_format(path)
        if self.surface is not None:
            from clrecon.exchange.formats import check_format

            check_format(self.surface)
        check_distinct(outputs)
        for _, path in outputs:
            check_writable(path)
        return outputs
