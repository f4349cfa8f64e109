"""Transfer syntaxes: which ones are read, by which library, and one compressed frame to stored pixel values.

pydicom drives the decoders; all of them are under permissive licences.  imagecodecs is added to it here as a plugin:
for JPEG lossless (57 and 70), which pydicom cannot decode with any of the others, and where another one is missing.
JPEG baseline, extended and the retired 12-bit lossy JPEGs are refused: the decoders at hand give garbage or nothing
for 12-bit CT, and a wrong surface is worse than none.
"""

from __future__ import annotations

import importlib.util
import struct
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.text import escape_text
from clrecon.errors import RefusedInputError

if TYPE_CHECKING:
    from clrecon.dicom.header import SliceHeader

__all__ = ["NATIVE_SYNTAXES", "choose_decoder", "decode_frame", "describe_undecodable", "is_encapsulated"]

NATIVE_SYNTAXES = ("1.2.840.10008.1.2", "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.1.99", "1.2.840.10008.1.2.2")

_JPEG = "1.2.840.10008.1.2.4."
JPEG_LOSSLESS = (_JPEG + "57", _JPEG + "70")
JPEG_LS = (_JPEG + "80", _JPEG + "81")
JPEG_2000 = tuple(_JPEG + part for part in ("90", "91", "201", "202", "203"))  # 201 on: high throughput
RLE = "1.2.840.10008.1.2.5"

# transfer syntax: (pydicom plugins, the first that is installed is taken; what to install where none is).
# All of them give the same values: the choice is one of speed.
_DECODERS = {
    **dict.fromkeys(JPEG_LOSSLESS, (("imagecodecs",), "imagecodecs")),
    **dict.fromkeys(JPEG_LS, (("pyjpegls", "imagecodecs"), "pyjpegls")),
    **dict.fromkeys(JPEG_2000, (("pylibjpeg", "imagecodecs"), "pylibjpeg pylibjpeg-openjpeg")),
    RLE: (("pylibjpeg", "pydicom"), "pylibjpeg pylibjpeg-rle"),
}

# What pydicom asks of a module that it takes a plugin from.
DECODER_DEPENDENCIES = dict.fromkeys((*JPEG_LOSSLESS, *JPEG_LS, *JPEG_2000), ("imagecodecs",))
_registering = threading.Lock()


def is_encapsulated(transfer_syntax: str) -> bool:
    """True for compressed pixel data."""
    return transfer_syntax not in NATIVE_SYNTAXES


def describe_undecodable(transfer_syntax: str) -> str:
    """Say why pixels of this transfer syntax cannot be read; empty where they can."""
    if transfer_syntax in NATIVE_SYNTAXES or transfer_syntax in _DECODERS:
        return ""
    from pydicom.config import IGNORE
    from pydicom.uid import UID

    uid = UID(transfer_syntax, validation_mode=IGNORE)
    name = uid.name if uid.name != transfer_syntax else "private or unknown"
    shown = escape_text(transfer_syntax)
    return f"transfer syntax {shown} ({name}) cannot be decoded: convert the series to an uncompressed one"


def is_available(uid: str) -> bool:
    """Tell pydicom whether `decode_with_imagecodecs` can work."""
    return uid in DECODER_DEPENDENCIES and importlib.util.find_spec("imagecodecs") is not None


def decode_with_imagecodecs(src: bytes, runner: Any) -> bytes:
    """Decode one frame of JPEG lossless, JPEG-LS or JPEG 2000 (a pydicom decoding plugin)."""
    import imagecodecs

    if runner.transfer_syntax in JPEG_LOSSLESS:
        frame = imagecodecs.jpegsof3_decode(src)
    elif runner.transfer_syntax in JPEG_LS:
        frame = imagecodecs.jpegls_decode(src)
    else:
        frame = imagecodecs.jpeg2k_decode(src)
    runner.set_option("bits_allocated", 8 * frame.dtype.itemsize)
    return np.ascontiguousarray(frame).tobytes()


def choose_decoder(transfer_syntax: str) -> str:
    """Name of the pydicom plugin for a compressed transfer syntax; makes ours known to pydicom first.

    Raises
    ------
    RefusedInputError
        None is installed; names the transfer syntax and what to install.
    """
    reason = describe_undecodable(transfer_syntax)
    if reason:
        raise RefusedInputError(reason)
    from pydicom.pixels import get_decoder

    plugins, packages = _DECODERS[transfer_syntax]
    with _registering:  # adding a plugin is not safe between threads
        decoder = get_decoder(transfer_syntax)  # type: ignore[arg-type]
        for plugin in plugins:
            if plugin == "imagecodecs" and plugin not in decoder.available_plugins and is_available(transfer_syntax):
                decoder.add_plugin(plugin, (__name__, "decode_with_imagecodecs"))
            if plugin in decoder.available_plugins:
                return plugin
    raise RefusedInputError(
        f"transfer syntax {transfer_syntax} needs a decoder that is not installed: pip install {packages}"
    )


def decode_frame(header: SliceHeader, encapsulated: bytes) -> NDArray[Any]:
    """Decode the frame of a compressed slice.

    Parameters
    ----------
    header : SliceHeader
    encapsulated : bytes
        The value of the pixel data element from its first item on; may run on to the end of the file.

    Returns
    -------
    ndarray, shape (rows, columns)
        Stored values, in the type that the header declares.

    Raises
    ------
    RefusedInputError
        The frame does not decode, or its own size is not that of the header (checked before decoding).
    """
    from pydicom.encaps import get_frame
    from pydicom.pixels import get_decoder

    plugin = choose_decoder(header.transfer_syntax)
    missing = find_cut_item(encapsulated)
    if missing:
        raise RefusedInputError(f"{header.name}: truncated: {missing}")
    try:
        frame_bytes = get_frame(encapsulated, header.frame, number_of_frames=header.frames)
        size = read_codestream_size(frame_bytes)
        if size is not None and size != (header.rows, header.columns):
            raise RefusedInputError(
                f"{header.name}: the compressed frame is {size[1]} x {size[0]}, "
                f"the header says {header.columns} x {header.rows}"
            )
        frame, _ = get_decoder(header.transfer_syntax).as_array(  # type: ignore[arg-type]
            encapsulated,
            index=header.frame,
            raw=True,
            validate=False,
            decoding_plugin=plugin,
            rows=header.rows,
            columns=header.columns,
            samples_per_pixel=1,
            number_of_frames=header.frames,
            bits_allocated=header.bits_allocated,
            bits_stored=header.bits_stored,
            pixel_representation=int(header.signed),
            photometric_interpretation=header.photometric,
            pixel_keyword="PixelData",
            apply_j2k_sign_correction=True,
            apply_jls_sign_correction=True,
        )
    except RefusedInputError:
        raise
    except Exception as error:
        # Decoders fail in any way on hostile bytes; all of them mean that this frame is not to be had.
        raise RefusedInputError(
            f"{header.name}: the compressed pixels (transfer syntax {header.transfer_syntax}) do not decode "
            f"({type(error).__name__})"
        ) from error
    return frame


def find_cut_item(encapsulated: bytes) -> str:
    """Walk the items of encapsulated pixel data; say what is cut off, empty where they are complete.

    Decoders make an image out of half a codestream without a word, so this has to be known before.
    """
    place = 0
    while place + 8 <= len(encapsulated):
        group, element, length = struct.unpack("<HHL", encapsulated[place : place + 8])
        place += 8
        if (group, element) == (0xFFFE, 0xE0DD):
            return ""
        if (group, element) != (0xFFFE, 0xE000):
            return f"no item of compressed pixels where one is expected ({group:04X},{element:04X})"
        if length > len(encapsulated) - place:
            return f"{length} bytes of compressed pixels expected, {len(encapsulated) - place} found"
        place += length
    return "the compressed pixels have no end mark"


def read_codestream_size(frame: bytes) -> tuple[int, int] | None:
    """Read (rows, columns) off the head of a JPEG, JPEG-LS or JPEG 2000 codestream; None where there is none."""
    if frame[:4] == b"\xff\x4f\xff\x51":  # JPEG 2000: SOC and SIZ; Lsiz, Rsiz, then the sizes
        if len(frame) < 24:
            return None
        width, height, left, top = struct.unpack(">4L", frame[8:24])
        return height - top, width - left
    if frame[:2] != b"\xff\xd8":
        return None
    place = 2
    while place + 9 <= len(frame) and frame[place] == 0xFF:
        marker, length = frame[place + 1], struct.unpack(">H", frame[place + 2 : place + 4])[0]
        if marker == 0xF7 or (0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC)):  # a start of frame
            rows, columns = struct.unpack(">2H", frame[place + 5 : place + 9])
            return rows, columns
        place += 2 + length
    return None
