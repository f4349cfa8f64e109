"""Pictures that jobs write beside other files."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from clrecon.rendering import Rendering
    from clrecon.system.files import StagedFile


def stage_picture(stack: ExitStack, picture: Rendering, path: str | Path) -> StagedFile:
    """Write a picture under a temporary name that `stack` removes unless it is committed."""
    from clrecon.rendering.pictures.image_files import encode_image
    from clrecon.system.files import stage_file

    content = encode_image(picture, os.path.splitext(os.fspath(path))[1].lower())

    def write(stream: BinaryIO) -> None:
        stream.write(content)

    return stack.enter_context(stage_file(path, write, expected_bytes=len(content)))
