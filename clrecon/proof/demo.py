"""The demonstration: phantom, mesh, picture and report in one folder, and one surface whose size is known exactly."""

from __future__ import annotations

from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import OutputError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import RenderSettings
from clrecon.jobs.run import Laps
from clrecon.proof.phantom import PhantomSettings, make_phantom, write_phantom
from clrecon.system import paths
from clrecon.system.files import hold_interrupts, temporary_folder
from clrecon.system.progress import Progress
from clrecon.system.records import name_schema

if TYPE_CHECKING:
    from clrecon.opencl import Device

DEMO_FOLDER = "clrecon-demo"
_DEMO_FILES = ("ct", "bone.stl", "bone.png", "report.json")

_TILT_DEG, _OBLIQUE_DEG = 12.0, (10.0, -5.0, 30.0)


def make_demo(
    output: str | Path = DEMO_FOLDER,
    device: str | None = None,
    *,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write a phantom CT series, a picture of it, its bone mesh and the report; check a sphere of known volume.

    The folder is new or empty, or one of an earlier demonstration, which is replaced; with `no_clobber` one that holds
    anything stays and is an `OutputError`.

    Return ``folder``, ``files``, ``affine_error_mm`` (largest difference between the affine of the report and that of
    the truth), ``check`` (see `check_sphere`), ``seconds``, ``mesh`` and ``picture`` (the reports of both).
    """
    from clrecon.operators import choose_device

    folder = paths.resolve_target(output)
    with paths.keep_existing(keep=no_clobber):
        _check_replaceable(folder, output)
        chosen = choose_device(device)
        with ExitStack() as stack:
            with paths.system_errors(output):
                staged = stack.enter_context(temporary_folder(folder if folder.exists() else folder.parent))
            try:
                outcome = _fill_folder(staged, chosen, progress)
            except OutputError as error:
                raise OutputError(str(error).replace(str(staged), str(output))) from error
            with hold_interrupts():
                _put_in_place(staged, folder, output)
    return name_schema("demo", {"folder": str(output), **outcome})


def _fill_folder(folder: Path, chosen: Device, progress: Progress | None) -> dict[str, Any]:
    watch = Laps()
    settings = PhantomSettings(kind="spine", size=(256, 192), slices=110, spacing=(1.0, 1.0, 1.25))
    truth = write_phantom(folder / "ct", settings, progress=progress)
    watch.lap("phantom")
    look = RenderSettings.of(
        preset="bone", views=["25,10"], ray_step=0.25, letters=True, scale_bar=True, device=str(chosen.index)
    )
    picture = make_pictures(folder / "ct", PictureFiles(folder / "bone.png"), look, progress=progress)
    watch.lap("picture")
    report = make_mesh(
        folder / "ct",
        folder / "bone.stl",
        MeshSettings(device=str(chosen.index)),
        report_path=folder / "report.json",
        progress=progress,
    )
    watch.lap("mesh")
    check = check_sphere(chosen)
    watch.lap("check")
    entries = zip(*(chain(*found["affine_ijk_to_lps_mm"]) for found in (report, truth)), strict=True)
    errors = [abs(found - true) for found, true in entries]
    seconds = {**watch.seconds, "total": watch.total()}
    return {
        "files": list(_DEMO_FILES),
        "affine_error_mm": max(errors),
        "check": check,
        "seconds": {part: round(value, 4) for part, value in seconds.items()},
        "mesh": report,
        "picture": picture,
    }


def check_sphere(device: Device) -> dict[str, Any]:
    """Mesh a sphere in an anisotropic, tilted, oblique volume; return its largest ``radius_error_max_mm`` too."""
    from clrecon.operators.surface.extract import extract_isosurface

    settings = PhantomSettings(
        kind="sphere",
        size=(72, 56),
        slices=40,
        spacing=(0.7, 0.5, 1.0),
        tilt=_TILT_DEG,
        oblique=_OBLIQUE_DEG,
        noise=0.0,
        point_spread_mm=0.0,
    )
    voxels, affine, truth = make_phantom(settings)
    mesh = extract_isosurface(Volume(voxels, affine), truth["iso_value_hu"], device=device)
    quality = mesh.quality()
    surface = truth["surface"]
    distance = np.linalg.norm(mesh.vertices - np.array(surface["center_lps_mm"]), axis=1)
    return {
        "volume_ml": quality.volume_ml,
        "true_volume_ml": surface["volume_ml"],
        "area_mm2": quality.area_mm2,
        "true_area_mm2": surface["area_mm2"],
        "radius_error_max_mm": float(np.abs(distance - surface["radius_mm"]).max()),
        "spacing_mm": truth["spacing_mm"],
        "tilt_deg": truth["tilt_deg"],
    }


def _check_replaceable(folder: Path, output: str | Path) -> None:
    """Accept a folder that is absent, empty, or that of an earlier demonstration, unless existing files are kept."""
    try:
        if not folder.parent.is_dir():
            raise OutputError(f"cannot make {output}: the folder around it does not exist; make it first")
        names = {entry.name for entry in folder.iterdir() if not entry.name.startswith(".clrecon-")}
    except FileNotFoundError:
        return
    except OSError as error:
        raise OutputError(f"cannot make the folder {output}: {error.strerror or error}") from error
    paths.refuse_existing(output, folder)
    foreign = sorted(names - set(_DEMO_FILES))
    if foreign or (names and not (folder / "ct" / "truth.json").is_file()):
        example = (foreign or sorted(names))[0]
        raise UsageError(f"{output} holds something that is not of a demo ({example}): name a new or empty folder")


def _put_in_place(staged: Path, folder: Path, output: str | Path) -> None:
    """Move a finished demonstration to its place: as a folder, or file by file into a folder that is there."""
    keep = paths.existing_stay()
    if not folder.exists():
        staged.chmod(paths.final_mode(folder, 0o777))
        paths.place_folder(staged, folder, output, keep=keep)
        return
    for name in _DEMO_FILES:
        move = paths.place_folder if (staged / name).is_dir() else paths.place_file
        move(staged / name, folder / name, Path(output) / name, keep=keep)
