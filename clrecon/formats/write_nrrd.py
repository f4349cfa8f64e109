"""NRRD (.nrrd), with pynrrd: the affine as space directions and origin, the certificate as fields of its own."""

from __future__ import annotations

import io
from typing import Any, BinaryIO

from clrecon.formats.content import PACKING, VolumeContent
from clrecon.formats.extras import import_extra
from clrecon.formats.grid_file import VOLUME

CHUNK_BYTES = 2**20
"""Bytes of voxels that pynrrd packs at a time, for the progress."""


class _Undated(io.RawIOBase):
    """Passes bytes on to a stream, but not the date that pynrrd writes: the same volume gives the same bytes."""

    def __init__(self, stream: BinaryIO, content: VolumeContent):
        super().__init__()
        self._stream, self._progress = stream, content.progress
        self._chunks = -(-content.voxels.nbytes // CHUNK_BYTES)
        self._in_header, self._done = True, 0

    def writable(self) -> bool:
        """Return that it can be written to."""
        return True

    def write(self, data: Any) -> int:
        """Pass on what pynrrd writes: a line of the header, or a chunk of voxels."""
        if self._in_header:
            self._in_header = data != b"\n"  # an empty line ends the header
            if data.startswith(b"# on "):
                return len(data)
        else:
            self._done += 1
            self._progress("write", min(self._done, self._chunks), self._chunks)
        self._stream.write(data)
        return len(data)


def write_nrrd(stream: BinaryIO, content: VolumeContent) -> None:
    """Write the file, its voxels packed by gzip."""
    nrrd = import_extra("nrrd", VOLUME)
    header = {
        "space": "left-posterior-superior",
        "kinds": ["domain", "domain", "domain"],
        "space directions": content.affine[:3, :3].T,
        "space origin": content.affine[:3, 3],
        "space units": ["mm", "mm", "mm"],
        "endian": "little",
        "encoding": "gzip",
        **{f"clrecon_{n:02}": line for n, line in enumerate(("HU", *content.lines))},
    }
    voxels = content.voxels.astype(content.voxels.dtype.newbyteorder("<"), copy=False)
    content.progress("write", 0, 0)
    nrrd.write(_Undated(stream, content), voxels.transpose(2, 1, 0), header, compression_level=PACKING)
