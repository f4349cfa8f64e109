"""MetaImage (.mha), with SimpleITK: the certificate as fields of its own, the voxels as they are, not packed."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import BinaryIO

from clrecon.errors import OutputError
from clrecon.formats.content import VolumeContent
from clrecon.formats.extras import import_extra
from clrecon.formats.grid_file import VOLUME
from clrecon.geometry.itk import make_sitk
from clrecon.system.log import hush

_NAME = "volume.mha"


def write_metaimage(stream: BinaryIO, content: VolumeContent) -> None:
    """Write the file.  SimpleITK writes to a name alone: a temporary file, whose bytes go to the stream."""
    sitk = import_extra("SimpleITK", VOLUME)
    content.progress("write", 0, 0)
    image = make_sitk(content.voxels, content.affine)
    for n, line in enumerate(("HU", *content.lines)):
        image.SetMetaData(f"clrecon_{n:02}", line)
    with tempfile.TemporaryDirectory(prefix="clrecon-") as folder:
        path = Path(folder, _NAME)
        try:
            with hush():
                sitk.WriteImage(image, str(path), useCompression=False, imageIO="MetaImageIO")
        except RuntimeError as error:
            raise OutputError(f"SimpleITK cannot write a temporary file of {content.voxels.nbytes} bytes") from error
        if path.stat().st_size < content.voxels.nbytes:
            raise OutputError("SimpleITK could not write the whole volume: is the disk of temporary files full?")
        with path.open("rb") as written:
            shutil.copyfileobj(written, stream, 2**20)
