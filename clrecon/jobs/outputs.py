"""The files of a job: their names, checks that none replaces another or an input, and writing under temporary names."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from clrecon.errors import ClreconError, OutputError, UsageError
from clrecon.exchange.formats import ASSEMBLIES, FORMATS, check_format, list_extensions
from clrecon.system.arguments import name_parameter
from clrecon.system.files import Staged, check_writable, hold_interrupts
from clrecon.system.light_dataclass import dataclass
from clrecon.system.paths import existing_stay, keep_existing, open_regular, refuse_existing, resolve_target
from clrecon.system.text import count_of

MESH_FILES, OBJECT_FILES = list_extensions(tuple(FORMATS)), list_extensions(ASSEMBLIES)
"""Extensions of mesh files, and of those that hold several objects, for help texts."""

MOST_FILES = 1000
"""Most meshes of a job.  More are useless crumbs, and each keeps a file open until all are written."""


@dataclass(frozen=True)
class MeshFiles:
    """Files that a job writes: meshes, with several labels named by each; pictures in the same way; the report."""

    output: str | Path | None = None
    picture: str | Path | None = None
    report: str | Path | None = None

    def named(self, mesh: str) -> list[tuple[str, str | Path | None]]:
        return [(mesh, self.output), ("the picture", self.picture), ("the report", self.report)]


def name_outputs(output: str | Path, names: Sequence[str], report_path: str | Path | None = None) -> list[str | Path]:
    """Name the files of several meshes: ``bone.stl`` and ``200hu`` give ``bone_200hu.stl``, an empty name nothing."""
    if len(names) > MOST_FILES:
        raise UsageError(
            f"{len(names):,} meshes are more than {MOST_FILES:,} files:"
            f" leave small components out ({name_parameter('min_volume_ml', 'ML')},"
            f" {name_parameter('keep_largest', 'N')}) or ask for fewer iso values"
        )
    stem, extension = os.path.splitext(os.fspath(output))
    paths = [f"{stem}_{name}{extension}" if name else output for name in names]
    for name in names:
        if os.path.basename(name) != name or "\\" in name:
            raise UsageError(f"{name!r} cannot be a part of the name of a file")
    owned = [(f"the mesh {name}" if name else "the mesh", path) for name, path in zip(names, paths, strict=True)]
    check_distinct([] if report_path is None else [("the report", report_path)], owned)
    return paths


def check_distinct(*owned: Sequence[tuple[str, str | Path]]) -> None:
    """Refuse two outputs that are the same file, each given by description and path."""
    owners: dict[str, str] = {}
    for role, path in chain(*owned):
        owner = owners.get(_identity(path))
        if owner is not None:
            raise UsageError(f"{role} and {owner} cannot be the same file: {path}")
        owners[_identity(path)] = role


def check_files(*owned: Sequence[tuple[str, str | Path]]) -> None:
    """Refuse outputs that are the same file, or that cannot be written; see `check_distinct`."""
    check_distinct(*owned)
    for _, path in chain(*owned):
        check_writable(path)


def check_kept(outputs: Sequence[tuple[str, str | Path | None]], *inputs: str | Path | None) -> None:
    """Refuse outputs, files or folders, that would replace files that the job reads, under any name or link.

    Files with the mark of DICOM are never replaced (`clrecon.system.files`). This function protects data sets
    without the mark, files of other formats with their voxel files, and files with settings.
    """
    there = [(what, path) for what, path in outputs if path is not None and os.path.exists(path)]
    read = [path for one in inputs if one and there for path in (one, _find_voxels(one)) if path]
    for role, path in there:
        inside = os.path.join(os.path.realpath(path), "")
        for source in read:
            same = os.path.exists(source) and (_identity(path) == _identity(source) or os.path.samefile(path, source))
            if same or os.path.isdir(path) and os.path.realpath(source).startswith(inside):
                raise UsageError(f"{role} would replace a file that is read: {path}")
        if os.path.isfile(path) and _is_bare_data_set(path):
            raise UsageError(f"{role} would replace a DICOM data set: {path}")


def _find_voxels(path: str | Path) -> Path | None:
    """Return the file that a header names for its voxels; None if it is the same file, or there is no header."""
    if not os.path.isfile(path):
        return None
    from clrecon.reading.grids import VOLUME, open_grid, tell_kind  # which a folder of DICOM does not need

    try:
        kind = tell_kind(Path(path))
        return open_grid(Path(path), kind, VOLUME).voxel_bytes.path if kind and kind != "DICOM" else None
    except (ClreconError, OSError):
        return None  # reading reports the error


def _is_bare_data_set(path: str | Path) -> bool:
    from clrecon.reading.dicom.parse.elements import restore_start

    try:
        with open_regular(path) as stream:
            return restore_start(stream.read(256)) is not None
    except OSError:
        return False


def count_leftovers(output: str | Path, paths: Sequence[str | Path]) -> int:
    """Count the numbered files of `output` that an earlier run left: not in `paths`, and not ours to remove."""
    stem, extension = os.path.splitext(os.path.basename(output))
    numbered = re.compile(rf"{re.escape(stem)}(?:_.+)?_[0-9]{{3,}}{re.escape(extension)}")
    written = {_identity(path) for path in paths}
    with os.scandir(os.path.dirname(output) or ".") as entries:
        return sum(bool(numbered.fullmatch(entry.name)) and _identity(entry.path) not in written for entry in entries)


def refuse_files(paths: Sequence[str | Path]) -> None:
    """Raise `OutputError` if one of the files exists."""
    with keep_existing(keep=True):
        for path in paths:
            refuse_existing(path, resolve_target(path))


def refuse_numbered(output: str | Path) -> None:
    """Raise `OutputError` in a block of `keep_existing` if components of an earlier run have names of `output`."""
    if existing_stay() and (count := count_leftovers(output, [])):
        raise OutputError(
            f"{count_of(count, 'numbered file')} of {output} exist{'s' * (count == 1)} already and"
            f" stay{'s' * (count == 1)} ({name_parameter('no_clobber', True)}):"
            " name another"
        )


def _identity(path: str | Path) -> str:
    """Return a key that is equal for two names of one file, also with links and on systems that ignore case."""
    return str(resolve_target(path)).casefold()


def check_outputs(
    output: str | Path, report_path: str | Path | None, names: Sequence[str] = ("",)
) -> list[tuple[str, str | Path]]:
    """Refuse outputs that cannot be written, before any work is done; return description and path of each."""
    check_format(output)
    outputs = [("the mesh", path) for path in name_outputs(output, names, report_path)]
    if report_path is not None:
        outputs.append(("the report", report_path))
    for _, path in outputs:
        check_writable(path)
    return outputs


def commit_all(files: Sequence[Staged]) -> None:
    """Move staged files to their places, one after the other; Ctrl-C waits until all are there."""
    with hold_interrupts():
        for done, file in enumerate(files):
            try:
                file.commit()
            except OutputError as error:
                if done == 0:
                    raise
                raise OutputError(f"{error} ({done} of {len(files)} files of this job are in place already)") from error
