"""Transfer syntaxes that can be read, and the decoder of each.

All decoders are under permissive licences; they run in a process of their own (see `decoder_pool`). JPEG baseline,
extended and the retired lossy JPEGs are refused: a CT image has 12 bits or more (DICOM PS3.3 C.8.2.1.1), so baseline
JPEG of a CT image is never legal, and data stored under the names of the others often have 8 bits.  A wrong surface is
worse than no surface.
"""

from __future__ import annotations

import importlib.util

from clrecon.dicom.parse.raw import DEFLATED, EXPLICIT_BIG, EXPLICIT_LITTLE, IMPLICIT_LITTLE
from clrecon.errors import RefusedInputError
from clrecon.system.packages import install_command
from clrecon.system.text import escape_text

NATIVE_SYNTAXES = (IMPLICIT_LITTLE, EXPLICIT_LITTLE, DEFLATED, EXPLICIT_BIG)

_JPEG = "1.2.840.10008.1.2.4."
JPEG_LOSSLESS = (_JPEG + "57", _JPEG + "70")
JPEG_LS = (_JPEG + "80", _JPEG + "81")
JPEG_2000 = tuple(_JPEG + part for part in ("90", "91", "201", "202", "203"))  # from 201: High-Throughput
RLE = "1.2.840.10008.1.2.5"

# For each transfer syntax: (name in `decoder_process`, package) in order of preference, and what to install.  The first
# installed decoder is used.  All give the same values; they differ in speed.
_DECODERS = {
    **dict.fromkeys(JPEG_LOSSLESS, ((("imagecodecs jpeg", "imagecodecs"),), "imagecodecs")),
    **dict.fromkeys(JPEG_LS, ((("jpeg_ls", "jpeg_ls"), ("imagecodecs jpeg_ls", "imagecodecs")), "pyjpegls")),
    **dict.fromkeys(
        JPEG_2000, ((("openjpeg", "openjpeg"), ("imagecodecs jpeg_2000", "imagecodecs")), "pylibjpeg-openjpeg")
    ),
    RLE: ((("rle", "rle"),), "pylibjpeg-rle"),
}

SYNTAX_NAMES = {
    IMPLICIT_LITTLE: "Implicit VR Little Endian",
    EXPLICIT_LITTLE: "Explicit VR Little Endian",
    DEFLATED: "Deflated Explicit VR Little Endian",
    EXPLICIT_BIG: "Explicit VR Big Endian",
    _JPEG + "57": "JPEG Lossless, Non-Hierarchical (Process 14)",
    _JPEG + "70": "JPEG Lossless, Non-Hierarchical, First-Order Prediction (Process 14 [Selection Value 1])",
    _JPEG + "80": "JPEG-LS Lossless Image Compression",
    _JPEG + "81": "JPEG-LS Lossy (Near-Lossless) Image Compression",
    _JPEG + "90": "JPEG 2000 Image Compression (Lossless Only)",
    _JPEG + "91": "JPEG 2000 Image Compression",
    _JPEG + "201": "High-Throughput JPEG 2000 Image Compression (Lossless Only)",
    _JPEG + "202": "High-Throughput JPEG 2000 with RPCL Options Image Compression (Lossless Only)",
    _JPEG + "203": "High-Throughput JPEG 2000 Image Compression",
    RLE: "RLE Lossless",
}
"""Names of all transfer syntaxes that can be read.  pydicom knows them too, but takes a quarter of a second to load."""

_OTHER_NAMES = {
    "1.2.840.113619.5.2": "implicit VR big endian, private to GE",
    "1.2.840.10008.1.2.8.1": "Deflated Image Frame Compression",
}
"""Names that pydicom's dictionary lacks."""


def is_encapsulated(transfer_syntax: str) -> bool:
    """True for compressed pixel data."""
    return transfer_syntax not in NATIVE_SYNTAXES


def describe_undecodable(transfer_syntax: str) -> str:
    """Say why pixels of this transfer syntax cannot be read; empty if they can."""
    if transfer_syntax in NATIVE_SYNTAXES or transfer_syntax in _DECODERS:
        return ""
    from pydicom.config import IGNORE
    from pydicom.uid import UID

    uid = UID(transfer_syntax, validation_mode=IGNORE)
    name = uid.name if uid.name != transfer_syntax else _OTHER_NAMES.get(transfer_syntax, "private or unknown")
    shown = escape_text(transfer_syntax)
    return f"transfer syntax {shown} ({escape_text(name)}) cannot be decoded: convert the series to an uncompressed one"


def choose_decoder(transfer_syntax: str) -> str:
    """Return the name of the decoder for a compressed transfer syntax, one of `decoder_process.DECODERS`."""
    reason = describe_undecodable(transfer_syntax)
    if reason:
        raise RefusedInputError(reason)
    decoders, packages = _DECODERS[transfer_syntax]
    for decoder, package in decoders:
        if importlib.util.find_spec(package) is not None:
            return decoder
    raise RefusedInputError(
        f"transfer syntax {transfer_syntax} needs a decoder that is not installed: {install_command(*packages.split())}"
    )
