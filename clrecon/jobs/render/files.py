"""The files of a picture job: their names, early checks of the outputs, and writing under temporary names."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from clrecon.errors import UsageError
from clrecon.jobs.render.settings import RenderSettings
from clrecon.jobs.shared.outputs import check_distinct
from clrecon.rendering.pictures.modes import check_known
from clrecon.system.arguments import name_parameter

if TYPE_CHECKING:
    from clrecon.rendering import Rendering
    from clrecon.system.files import StagedFile

OPAQUE_ONLY = (".jpg", ".jpeg", ".mp4", ".gif")


@dataclass(frozen=True)
class PictureFiles:
    """Paths of the outputs of a job; with several views each picture gets its own file names.

    picture: .png, .jpg or .tif.
    depth, values: .npy or .tif, with the distances to the first hit in mm, and with HU.
    turntable: See `clrecon.rendering.movies.movie.check_animation`.
    report: JSON.
    """

    picture: str | Path | None = None
    depth: str | Path | None = None
    values: str | Path | None = None
    turntable: str | Path | None = None
    report: str | Path | None = None

    def __post_init__(self) -> None:
        if self.picture is None and self.turntable is None:
            raise UsageError(
                f"there is nothing to write: name a picture ({name_parameter('picture', 'out.png')}) or a turntable"
                f" ({name_parameter('turntable')})"
            )
        if self.picture is None and (self.depth is not None or self.values is not None):
            raise UsageError(
                f"depths and values belong to a picture: name it too ({name_parameter('picture', 'out.png')})"
            )


def name_view(view: str, views: Sequence[str]) -> str:
    """Name of a view between the stem of a file and its extension; empty for a single view.

    Returns: The view's own name, or ``az30_el-15`` for angles.
    """
    if len(views) == 1:
        return ""
    azimuth, comma, elevation = view.strip().lower().partition(",")
    return f"az{float(azimuth):g}_el{float(elevation):g}" if comma else azimuth


def path_of(path: str | Path, name: str) -> str | Path:
    """Insert a name into a path: ``out.png`` and ``left`` give ``out_left.png``; an empty name changes nothing."""
    stem, extension = os.path.splitext(os.fspath(path))
    return f"{stem}_{name}{extension}" if name else path


def format_of(path: str | Path) -> str:
    """Return the extension of a file in lower case, without the dot; empty for a folder."""
    return os.path.splitext(os.fspath(path))[1].lower().lstrip(".")


def check_pictures(files: PictureFiles, settings: RenderSettings) -> list[tuple[str, str | Path]]:
    """Refuse outputs that cannot be written, before any work is done.

    Returns: list of (str, path). A description of each output, and its path.
    """
    from clrecon.rendering.movies.movie import animation_kind, check_animation
    from clrecon.rendering.pictures.annotations import check_caption
    from clrecon.rendering.pictures.image_files import check_float_path, check_image_path
    from clrecon.rendering.pictures.pillow import load_pillow
    from clrecon.system.files import check_writable

    load_pillow()
    check_caption(settings.caption)
    for name in ("depth", "values"):
        if getattr(files, name) is not None:
            check_known(settings.mode, name)
    if files.depth is not None and settings.is_sheet:
        raise UsageError("a contact sheet has no depths: its slices lie in planes of their own")
    if settings.background == "transparent":
        picture = "" if files.picture is None else format_of(files.picture)
        turntable = "" if files.turntable is None else animation_kind(files.turntable)[1:]
        for kind in (picture, turntable):
            if f".{kind}" in OPAQUE_ONLY:
                raise UsageError(
                    f"{kind.upper()} cannot hold a transparent background:"
                    f" choose PNG, TIFF or APNG, or a colour ({name_parameter('background')})"
                )
    of_views = {"the picture": files.picture, "the depths": files.depth, "the values": files.values}
    owned: list[tuple[str, str | Path]] = [] if files.report is None else [("the report", files.report)]
    for what, path in of_views.items():
        if path is not None:
            (check_image_path if what == "the picture" else check_float_path)(path)
            names = [name_view(view, settings.views_used) for view in settings.views_used]
            owned += [(f"{what} {name}".rstrip(), path_of(path, name)) for name in names]
    moving = [] if files.turntable is None else [("the turntable", files.turntable)]
    check_distinct(owned, moving)
    for _, path in owned:
        check_writable(path)
    if files.turntable is not None and settings.turntable is not None:
        if check_animation(files.turntable, settings.turntable.fps) == "":
            _check_outside(files.turntable, owned)
    return [*owned, *moving]


def _check_outside(folder: str | Path, owned: Sequence[tuple[str, str | Path]]) -> None:
    """Refuse files in the folder of frames, because that folder is replaced as a whole."""
    frames = Path(os.path.realpath(folder))
    for what, path in owned:
        if frames in Path(os.path.realpath(path)).parents:
            raise UsageError(f"{what} cannot lie in {folder}, which holds frames and nothing else: name another folder")


def stage_picture(
    stack: ExitStack, picture: Rendering, files: PictureFiles, name: str
) -> dict[str, tuple[str | Path, StagedFile]]:
    """Write a picture, and its depths and values if asked for, under temporary names.

    Returns: ``output`` and, if asked for, ``depth_output`` and ``values_output``: each with its path and its staged
        file.
    """
    from clrecon.rendering.pictures.image_files import encode_floats, encode_image
    from clrecon.system.files import stage_file

    def stage(path: str | Path, content: bytes) -> tuple[str | Path, StagedFile]:
        def write(stream: BinaryIO) -> None:
            stream.write(content)

        named = path_of(path, name)
        return named, stack.enter_context(stage_file(named, write, expected_bytes=len(content)))

    assert files.picture is not None
    staged = {"output": stage(files.picture, encode_image(picture, f".{format_of(files.picture)}"))}
    if files.depth is not None:
        staged["depth_output"] = stage(
            files.depth, encode_floats(picture.depth, f".{format_of(files.depth)}", picture.pixel_mm)
        )
    if files.values is not None and picture.values is not None:
        staged["values_output"] = stage(
            files.values, encode_floats(picture.values, f".{format_of(files.values)}", picture.pixel_mm)
        )
    return staged
