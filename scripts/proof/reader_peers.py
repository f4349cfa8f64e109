"""Readers of CT series, each behind one function; compare_readers.py runs every call in a child process.

A function takes a folder with one series.  It returns the volumes that the reader makes of it by default, with notes.
Libraries are imported inside the functions, because each function runs in its own process.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

RESAMPLED = re.compile(r"(_Tilt|_Eq)(_\d+)?$")
"""End of the names of images that dcm2niix resampled; the raw image beside them is judged."""
RAS_TO_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass
class Candidate:
    """One volume that a reader made: voxels (i, j, k), its function from indices (n, 3) to LPS mm, notes."""

    voxels: NDArray[Any]
    ijk_to_lps: Callable[[NDArray[Any]], NDArray[np.float64]]
    notes: tuple[str, ...] = ()


def by_affine(affine: NDArray[np.float64]) -> Callable[[NDArray[Any]], NDArray[np.float64]]:
    """Return the function from indices to LPS mm of a 4x4 affine."""
    return lambda ijk: ijk @ affine[:3, :3].T + affine[:3, 3]


@dataclass
class Reading:
    """The volumes of a reader, and its warnings."""

    candidates: list[Candidate]
    warnings: tuple[str, ...] = ()


def read_clrecon(folder: Path, options: dict[str, Any]) -> Reading:
    from clrecon.reading import read_volume

    volume = read_volume(folder, **options)
    made = Candidate(volume.voxels.transpose(2, 1, 0), volume.ijk_to_lps)
    return Reading([made], tuple(volume.report["warnings"]))


def read_simpleitk(folder: Path, options: dict[str, Any]) -> Reading:
    import SimpleITK as sitk

    series = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
    names = max((sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), uid) for uid in series), key=len)
    image = sitk.ReadImage(names if len(names) > 1 else names[0])
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return Reading([Candidate(sitk.GetArrayFromImage(image).transpose(2, 1, 0), by_affine(affine))])


def read_highdicom(folder: Path, options: dict[str, Any]) -> Reading:
    import highdicom
    import pydicom

    files = sorted(file for file in folder.rglob("*") if file.is_file())
    if len(files) == 1:
        volume = highdicom.imread(files[0]).get_volume()
    else:
        volume = highdicom.get_volume_from_series([pydicom.dcmread(file) for file in files])
    order = [2, 1, 0, 3]  # the indices are (slice, row, column)
    return Reading([Candidate(volume.array.transpose(2, 1, 0), by_affine(np.array(volume.affine)[:, order]))])


def read_dicom2nifti(folder: Path, options: dict[str, Any]) -> Reading:
    import dicom2nifti

    with tempfile.TemporaryDirectory() as target:
        path = Path(target) / "volume.nii.gz"
        dicom2nifti.dicom_series_to_nifti(str(folder), str(path), reorient_nifti=True)
        return Reading([_load_nifti(path)])


def read_dicom_numpy(folder: Path, options: dict[str, Any]) -> Reading:
    import dicom_numpy
    import pydicom

    files = sorted(file for file in folder.rglob("*") if file.is_file())
    voxels, affine = dicom_numpy.combine_slices([pydicom.dcmread(file) for file in files])
    return Reading([Candidate(voxels, by_affine(np.asarray(affine, dtype=float)))])


def read_dcm2niix(folder: Path, options: dict[str, Any]) -> Reading:
    import dcm2niix

    with tempfile.TemporaryDirectory() as target:
        done = subprocess.run(
            [dcm2niix.bin, "-b", "n", "-z", "n", "-f", "volume", "-o", target, str(folder)],
            capture_output=True,
            text=True,
        )
        files = sorted(Path(target).glob("*.nii"))
        extra = {file: "+" + match[1] for file in files if (match := RESAMPLED.search(file.stem))}
        made = [_load_nifti(file, tuple(sorted(set(extra.values())))) for file in files if file not in extra]
        if not made:
            raise RuntimeError(f"exit code {done.returncode}")
    told = [line for line in (done.stdout + done.stderr).splitlines() if "warning" in line.lower()]
    return Reading(made, tuple(told))


def _load_nifti(path: Path, notes: tuple[str, ...] = ()) -> Candidate:
    import nibabel

    image = nibabel.load(path)
    voxels = np.asanyarray(image.dataobj)
    if voxels.ndim > 3:
        notes = (f"4D of {voxels.shape[3]}", *notes)
        voxels = voxels[..., 0]
    return Candidate(voxels, by_affine(RAS_TO_LPS @ image.affine), notes)


READERS: dict[str, tuple[str, Callable[[Path, dict[str, Any]], Reading]]] = {
    "clrecon": ("clrecon", read_clrecon),
    "SimpleITK": ("SimpleITK", read_simpleitk),
    "highdicom": ("highdicom", read_highdicom),
    "dicom2nifti": ("dicom2nifti", read_dicom2nifti),
    "dicom-numpy": ("dicom-numpy", read_dicom_numpy),
    "dcm2niix": ("dcm2niix", read_dcm2niix),
}
"""Distribution on PyPI and reading function, by name in the table."""
