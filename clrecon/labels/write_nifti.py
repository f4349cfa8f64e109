"""Label maps as NIfTI-1 (.nii, .nii.gz), with the names of the labels in the header.

nibabel writes the header.  The names are a label table as Caret and Connectome Workbench write it, which `read_labels`
and other programs read.
"""

from __future__ import annotations

import gzip
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from clrecon.geometry.images import place_in_header
from clrecon.labels.label_map import LabelMap
from clrecon.reading.grids.grid_file import LABEL_MAP, import_extra

CARET_CODE = 30
"""Code of the extension that holds Caret's XML."""


def load_nibabel() -> Any:
    """Import nibabel."""
    return import_extra("nibabel", LABEL_MAP)


def encode_nifti(labels: LabelMap, *, packed: bool) -> bytes:
    """Return the bytes of the file; the same labels give the same bytes.

    packed: Gzip, as in .nii.gz.
    """
    nibabel = load_nibabel()
    image = nibabel.Nifti1Image(np.asarray(labels.voxels).transpose(2, 1, 0), None)
    place_in_header(image.header, labels.affine)
    table = "".join(
        f'<Label Key="{number}" Red="1" Green="1" Blue="1" Alpha="1">{escape(name)}</Label>'
        for number, name in labels.names.items()
    )
    text = f'<?xml version="1.0" encoding="UTF-8"?><CaretExtension><VolumeInformation Index="0"><LabelTable>{table}'
    text += "</LabelTable></VolumeInformation></CaretExtension>"
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(CARET_CODE, text.encode("utf-8")))
    content = bytes(image.to_bytes())
    return gzip.compress(content, compresslevel=6, mtime=0) if packed else content
