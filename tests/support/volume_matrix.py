"""Files of volumes with known places: those that `clrecon export` writes, and what a reader of them gets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from dicom_series import Plan, write_series
from volume_files import LEFT_HANDED, ROTATED, WRITERS, make_ct

from clrecon import read_volume
from clrecon.cli.main import main

EXTENSIONS = (".nii", ".nii.gz", ".nrrd", ".mha")
ZERO_MM = 1e-6
"""Directions and positions of DICOM have 9 decimals here."""
WRONG_MM = 0.01
SHAPE = (7, 5, 6)
RAS = np.diag((-1.0, -1.0, 1.0, 1.0))
Grid = tuple[np.ndarray, np.ndarray]
"""voxels[k, j, i], and an affine, ijk to LPS mm."""
OBLIQUE = (10.0, -20.0, 35.0)


@dataclass(frozen=True)
class Truth:
    """What a file must hold: voxels[k, j, i] and an affine, ijk to LPS mm."""

    voxels: np.ndarray
    affine: np.ndarray


@dataclass(frozen=True)
class Export:
    """A scan, how it is exported, and what must be in the file; `refused` has words of a refusal by extension."""

    name: str
    write: Callable[[Path], Path]
    truth: Callable[[], Truth]
    options: tuple[str, ...] = ()
    refused: Callable[[str], str] = lambda extension: ""


def affine_of(plan: Plan) -> np.ndarray:
    """Return the affine of an even plan, from its directions, in the order of the normal."""
    row, column, _ = plan.directions
    dj, di = plan.pixel_spacing
    affine = np.eye(4)
    affine[:3, 0], affine[:3, 1], affine[:3, 2] = row * di, column * dj, plan.position(1) - plan.position(0)
    affine[:3, 3] = plan.position(0)
    return affine


def of_plan(name: str, plan: Plan, *, options: tuple[str, ...] = (), cut: slice = slice(None), **more: Any) -> Export:
    """An export of a series; `cut` are the slices that the file must have."""

    def truth() -> Truth:
        affine = affine_of(plan)
        affine[:3, 3] += (cut.start or 0) * affine[:3, 2]
        return Truth(plan.hu()[cut], affine)

    def write(folder: Path) -> Path:
        write_series(folder / "ct", plan)
        return folder / "ct"

    return Export(name, write, truth, options, **more)


def of_file(name: str, kind: str, affine: np.ndarray, **more: Any) -> Export:
    """An export of a file of volumes."""

    def write(folder: Path) -> Path:
        return WRITERS[kind](folder / kind, make_ct(), affine)

    return Export(name, write, lambda: Truth(make_ct(), affine), **more)


UNEVEN = Plan(shape=SHAPE, offsets={3: 0.4})


def uneven_resampled() -> Truth:
    """The even grid that clrecon resamples `UNEVEN` to: places and values of the file must be those."""
    with TemporaryDirectory() as folder:
        write_series(Path(folder), UNEVEN)
        again = read_volume(folder).resample(1.0)
    return Truth(again.voxels, again.affine)


def only(words: str, *extensions: str) -> Callable[[str], str]:
    """Words of a refusal for some extensions, and none for the others."""
    return lambda extension: words if extension in extensions else ""


def _list_exports() -> Iterator[Export]:
    sheared, far = only("axes at right angles", ".mha"), only("numbers of single precision", ".nii", ".nii.gz")
    yield of_plan("axial, non-square pixels", Plan(shape=SHAPE))
    yield of_plan("oblique", Plan(shape=SHAPE, angles=OBLIQUE))
    yield of_plan("slice normal towards the feet", Plan(shape=SHAPE, angles=(180, 0, 0)))
    yield of_plan("sagittal", Plan(shape=SHAPE, angles=(-90, 0, 90)))
    yield of_plan("tilt 12 deg", Plan(shape=SHAPE, tilt_deg=12.0), refused=sheared)
    yield of_plan("tilt -20 deg, oblique", Plan(shape=SHAPE, tilt_deg=-20.0, angles=OBLIQUE), refused=sheared)
    yield of_plan("100 m away", Plan(shape=SHAPE, origin=(1e5 + 0.123, -1e5, 1e5)), refused=far)
    yield of_plan("HU with halves", Plan(shape=SHAPE, slope=0.5))  # type: ignore[arg-type]
    yield of_plan("HU beyond 16 bits", Plan(shape=SHAPE, slope=60))
    yield of_plan("cropped", Plan(shape=SHAPE), options=("--between", "-398,"), cut=slice(2, None))
    yield of_plan("uneven", UNEVEN, refused=lambda extension: "slices of this volume are uneven")
    yield Export("uneven, resampled to 1 mm", of_plan("", UNEVEN).write, uneven_resampled, ("--resample", "1"))
    yield of_file("from NIfTI-2, left-handed", "two.nii", ROTATED @ np.diag((1.0, -1.0, 1.0, 1.0)))
    yield of_file("from NRRD in RAS", "gzip.nrrd", ROTATED)
    yield of_file("from MetaImage", "packed.mha", ROTATED)
    yield of_file("from NIfTI-2, sheared", "two.nii", LEFT_HANDED, refused=sheared)


EXPORTS = [(one, extension) for one in _list_exports() for extension in EXTENSIONS]
"""The rows of the table: a scan and the extension of the file that is written of it."""


def write_export(one: Export, extension: str, folder: Path) -> tuple[Path, str]:
    """Export a scan; return the file, and what was said on standard error, with no file if it was refused."""
    path, said = folder / f"out{extension}", StringIO()
    with redirect_stderr(said), redirect_stdout(StringIO()):
        code = main(["export", str(one.write(folder)), "-o", str(path), *one.options])
    assert path.exists() is (code == 0), said.getvalue()
    return path, said.getvalue()


def measure(voxels: np.ndarray, affine: np.ndarray, truth: Truth) -> float | None:
    """Return the largest distance of a corner from its place in mm; None where voxels are others."""
    if voxels.shape != truth.voxels.shape or not np.array_equal(voxels, truth.voxels):
        return None
    nk, nj, ni = voxels.shape[-3:]
    corners = np.array([[i, j, k, 1.0] for i in (0, ni - 1) for j in (0, nj - 1) for k in (0, nk - 1)])
    return float(np.linalg.norm(corners @ (affine - truth.affine).T, axis=1).max())


def read_with_clrecon(path: Path) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return voxels[k, j, i], the affine, and whether anything but that it is not DICOM was said."""
    volume = read_volume(path)
    return volume.voxels, volume.affine, len(volume.report["warnings"]) > 1


def describe(found: tuple[np.ndarray, np.ndarray, bool], truth: Truth) -> str:
    """Return a cell of a table: the largest distance in mm, W where something was said, bold where wrong in silence."""
    voxels, affine, told = found
    voxels = voxels[0] if voxels.ndim == 4 and len(voxels) == 1 else voxels
    if voxels.shape != truth.voxels.shape:
        text, wrong = "another shape", True
    elif (error := measure(voxels, affine, truth)) is None:
        text, wrong = "other values", True
    else:
        wrong = error > WRONG_MM
        text = "0" if error <= ZERO_MM else f"{error:.3g}" if wrong else f"{error:.1g}"
    return f"{text} W" if told else f"**{text}**" if wrong else text


def read_simpleitk(path: Path) -> Grid:
    """Read with SimpleITK, which places voxels in LPS mm."""
    import SimpleITK

    image = SimpleITK.ReadImage(str(path))
    count = image.GetDimension()
    affine = np.eye(count + 1)
    affine[:count, :count] = np.reshape(image.GetDirection(), (count, count)) * image.GetSpacing()
    affine[:count, count] = image.GetOrigin()
    inner = [0, 1, 2, count]
    return SimpleITK.GetArrayFromImage(image), affine[np.ix_(inner, inner)]


def read_nibabel(path: Path) -> Grid:
    """Read with nibabel, which places voxels in RAS mm."""
    import nibabel

    image = nibabel.load(path)
    return np.asanyarray(image.dataobj).T, RAS @ image.affine


def read_pynrrd(path: Path) -> Grid:
    """Read with pynrrd, which returns the numbers of the header: its space is followed here."""
    import nrrd

    voxels, header = nrrd.read(str(path))
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = header["space directions"].T, header["space origin"]
    signs = {"left": 1.0, "posterior": 1.0, "superior": 1.0, "right": -1.0, "anterior": -1.0}
    return voxels.T, np.diag([*(signs[word] for word in header["space"].split("-")), 1.0]) @ affine


def read_vtk(path: Path) -> Grid:
    """Read with VTK, through PyVista; its images lie in the frame of the file."""
    import pyvista

    image = pyvista.read(path)
    affine = np.eye(4)
    affine[:3, :3] = np.asarray(image.direction_matrix) * image.spacing
    affine[:3, 3] = image.origin
    affine = RAS @ affine if ".nii" in path.name else affine
    voxels = np.asarray(image.active_scalars)
    return voxels.reshape(image.dimensions[::-1]) if voxels.size == np.prod(image.dimensions) else voxels, affine


PEERS: dict[str, tuple[str, Callable[[Path], Grid], tuple[str, ...]]] = {
    "SimpleITK": ("SimpleITK", read_simpleitk, (".nii", ".nii.gz", ".hdr", ".nrrd", ".nhdr", ".mha", ".mhd")),
    "nibabel": ("nibabel", read_nibabel, (".nii", ".nii.gz", ".hdr")),
    "pynrrd": ("pynrrd", read_pynrrd, (".nrrd", ".nhdr")),
    "VTK": ("vtk", read_vtk, (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")),
}
