"""The folder of a comparison, which appears as a whole or not at all."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from clrecon.errors import UsageError
from clrecon.jobs.compare.methods import COMPARED
from clrecon.jobs.run import to_json
from clrecon.system.files import StagedFolder, check_folder, temporary_folder
from clrecon.system.paths import final_mode, system_errors

PAGE, REPORT = "index.html", "report.json"

_NAMES = "|".join(map(re.escape, COMPARED))
_OWN = re.compile(rf"index\.html|report\.json|(?:{_NAMES})(?:-difference|-along)?\.png|slice-[a-z]+(?:-detail)?\.png")


def check_report_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder that will be made, or that of an earlier comparison, which will be replaced."""
    folder = check_folder(path, _OWN, "report")
    names = set(os.listdir(folder)) if folder.is_dir() else set()
    if names and not {PAGE, REPORT} <= names:
        raise UsageError(
            f"the folder {path} holds pictures without the page of a comparison: name a new or empty one for the report"
        )
    return folder


class MadeFolder(StagedFolder):
    """The folder while it is filled.

    path: Its temporary place.
    """

    def __init__(self, path: str | os.PathLike[str], made: Path, folder: Path):
        super().__init__(path, made, folder, 0)
        self._shown, self.path = path, made

    def write(self, name: str, text: str) -> None:
        """Write a file of text."""
        with system_errors(self._shown), open(self.path / name, "x", encoding="utf-8", newline="\n") as stream:
            stream.write(text)

    def write_report(self, report: Mapping[str, Any]) -> None:
        """Write the report as JSON."""
        self.write(REPORT, to_json(report) + "\n")

    def commit(self) -> None:
        """Bring all files to the disk, and the folder to its place."""
        with system_errors(self._shown):
            for entry in os.scandir(self.path):
                with open(entry.path, "rb") as stream:
                    os.fsync(stream.fileno())
                    self.size += os.fstat(stream.fileno()).st_size
        super().commit()


@contextlib.contextmanager
def stage_report_folder(path: str | os.PathLike[str]) -> Iterator[MadeFolder]:
    """Make a folder under a temporary name; one that is not committed is removed at the end of the block."""
    folder = check_report_folder(path)
    with contextlib.ExitStack() as stack:
        with system_errors(path):
            made = stack.enter_context(temporary_folder(folder.parent))
            made.chmod(final_mode(folder, 0o777))
        yield MadeFolder(path, made, folder)
