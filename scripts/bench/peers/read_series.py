#!/usr/bin/env python3
"""Read one CT series, or scan a tree, in a process of its own: read_series.py READER FOLDER.

READER is clrecon, pydicom or simpleitk (the whole volume in memory, HU), or scan (headers alone, with clrecon).
Prints one JSON object.  `READERS` are the same functions for runs within one process.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def read_with_clrecon(folder: str) -> Any:
    """Read the volume with all checks and its certificate."""
    import clrecon

    return clrecon.read_volume(folder).voxels


def read_with_pydicom(folder: str) -> Any:
    """Read with the usual loop, which checks nothing: read, sort by position, rescale, stack."""
    import numpy as np
    import pydicom

    slices = [pydicom.dcmread(path) for path in Path(folder).iterdir() if path.suffix == ".dcm"]
    normal = np.cross(slices[0].ImageOrientationPatient[:3], slices[0].ImageOrientationPatient[3:])
    slices.sort(key=lambda ds: np.dot(normal, ds.ImagePositionPatient))
    return np.stack(
        [(ds.pixel_array * int(ds.RescaleSlope) + int(ds.RescaleIntercept)).astype(np.int16) for ds in slices]
    )


def read_with_simpleitk(folder: str) -> Any:
    """Read with GDCM's sorter and ITK's reader; the array is a view, not a copy."""
    import SimpleITK as sitk

    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(folder))
    image = reader.Execute()
    read_with_simpleitk.image = image  # type: ignore[attr-defined]  # the view does not keep it alive
    return sitk.GetArrayViewFromImage(image)


READERS: dict[str, Callable[[str], Any]] = {
    "clrecon": read_with_clrecon,
    "pydicom": read_with_pydicom,
    "simpleitk": read_with_simpleitk,
}


def scan_tree(folder: str) -> dict[str, Any]:
    """Scan and group a tree of headers; returns seconds, and the growth of resident memory up to its peak."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from child import forget_peak, resident_bytes

    from clrecon.reading.dicom.series.scan import scan_path
    from clrecon.reading.dicom.series.series import group_series

    small = next(path for path in sorted(Path(folder).rglob("*")) if path.is_file())
    group_series(scan_path(small))
    forget_peak()
    before = resident_bytes("VmRSS")
    start, processor = time.perf_counter(), time.process_time()
    scan = scan_path(Path(folder))
    scanned = time.perf_counter()
    series = group_series(scan)
    grouped, processor = time.perf_counter(), time.process_time() - processor
    peak = resident_bytes("VmHWM")
    return {
        "files": scan.files,
        "slices": len(scan.slices),
        "series": len(series),
        "seconds": grouped - start,
        "processor": processor,
        "scan": scanned - start,
        "group": grouped - scanned,
        "bytes": None if before is None or peak is None else peak - before,
    }


def main(reader: str, folder: str) -> None:
    if reader == "scan":
        print(json.dumps(scan_tree(folder)))
    else:
        voxels = READERS[reader](folder)
        print(json.dumps({"shape": list(voxels.shape), "type": str(voxels.dtype)}))


if __name__ == "__main__":
    main(*sys.argv[1:])
