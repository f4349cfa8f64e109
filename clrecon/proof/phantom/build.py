"""Make a phantom: voxels, affine and truth, in memory or as a DICOM series beside its truth.json.

A scene also gets a label map of its materials, a spine with chosen levels one of its levels."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, UsageError
from clrecon.geometry import column_spacing, signed_tilt
from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom import sampling, scenes
from clrecon.proof.phantom.scene_plans import plan_scene
from clrecon.proof.phantom.series import RESCALE_INTERCEPT, Placement, place_slices, write_label_map, write_series
from clrecon.proof.phantom.settings import CENTRE_LPS_MM, KINDS, PhantomSettings, draw_ghosts
from clrecon.proof.phantom.shapes import choose_body
from clrecon.proof.phantom.spine import BLOOD_HU, draw_spine, label_levels
from clrecon.proof.phantom.spine_parts import Anatomy, level_number
from clrecon.proof.phantom.vertebra import bone_points
from clrecon.system.files import temporary_folder
from clrecon.system.paths import existing_stay, place_folder, read_regular, refuse_existing, resolve_target, shown_path
from clrecon.system.progress import Progress
from clrecon.system.text import count_of
from clrecon.version import package_version


def facts_of_spine(anatomy: Anatomy, affine: Float64Array, settings: PhantomSettings) -> dict[str, Any]:
    """Describe where the parts are, LPS mm, and which of them lie in the volume."""
    inverse = np.linalg.inv(affine)
    extents = np.array(settings.shape_kji[::-1])

    def inside(points: Float64Array) -> bool:
        ijk = points @ inverse[:3, :3].T + inverse[:3, 3]
        return bool(np.all((ijk > -0.5) & (ijk < extents - 0.5)))

    centre = np.array(CENTRE_LPS_MM)
    described: dict[str, Any] = {
        "vertebrae": [
            {
                "name": vertebra.name,
                "center_lps_mm": (vertebra.center + centre).tolist(),
                "inside": inside(vertebra.center + centre),
            }
            for vertebra in anatomy.vertebrae
        ],
        "left_marker_lps_mm": (anatomy.marker + centre).tolist(),
        "left_marker_radius_mm": anatomy.marker_radius,
        "left_marker_inside": inside(anatomy.marker + centre),
        "absent": anatomy.absent,
    }
    choice = settings.spine_choice
    if choice is not None:
        for vertebra, facts in zip(anatomy.vertebrae, described["vertebrae"], strict=True):
            facts["label"] = level_number(vertebra.name)
            facts["whole"] = inside(bone_points(vertebra) + centre)
        first, last = anatomy.vertebrae[0].axes[2], anatomy.vertebrae[-1].axes[2]
        # the angles between the first and the last level, as they are measured on a lateral and an anterior picture
        described["sagittal_angle_deg"] = _angle(last[1], last[2]) - _angle(first[1], first[2])
        described["coronal_angle_deg"] = _angle(last[0], last[2]) - _angle(first[0], first[2])
        described["facet_gap_mm"] = choice.facet_gap_mm
    return described


def _angle(across: float, up: float) -> float:
    return math.degrees(math.atan2(across, up))


def facts_of_series(settings: PhantomSettings, placement: Placement) -> dict[str, Any] | None:
    """Describe slices that are uneven, missing or of several phases, in plain JSON types; None for an even stack."""
    if not (settings.uneven_mm or settings.missing or settings.phases > 1):
        return None
    written = [k for k in range(settings.slices) if k + 1 not in settings.missing]
    return {
        "uneven_mm": settings.uneven_mm,
        "missing": list(settings.missing),
        "phases": settings.phases,
        "slice_positions_lps_mm": [[float(text) for text in placement.positions[k]] for k in written],
    }


TRUTH_NAME = "truth.json"
LARGEST_TRUTH = 1 << 28
"""Largest truth.json that is read, in bytes; that of a series of thousands of slices has some MiB."""
_MATERIALS_NAME = "materials.nrrd"
_LEVELS_NAME = "levels.nrrd"

_SPINE_ISO_HU = 226.0
"""Suggested iso value for the spine: above discs, organs and noise, below the blurred thin cortex."""

_GENERATOR = "clrecon phantom"
_OURS = re.compile(r"IM\d{4}\.dcm|truth\.json|materials\.nrrd|levels\.nrrd")

_PHASE_HU = 90.0
"""What the contrast medium adds to the vessels from phase to phase."""


def _make_voxels(
    settings: PhantomSettings, placement: Placement, progress: Progress | None, phase: int = 0
) -> tuple[NDArray[np.int16], dict[str, Any], scenes.LabelArray | None]:
    """Make voxels of all slices, truth and, of a scene, materials."""
    affine = placement.affine
    places = placement.places if settings.uneven_mm else None
    surface: dict[str, Any] | None = None
    spine: dict[str, Any] | None = None
    half_maximum: float | None = None
    labels: scenes.LabelArray | None = None
    scanner = KINDS[settings.kind].scanner
    if KINDS[settings.kind].is_scene:
        field, labels = scenes.draw_scene(plan_scene(settings), settings, affine, progress)
        kind = KINDS[settings.kind]
        pair = kind.bone_and_tissue_hu
        half_maximum = None if pair is None else round(kind.scanner.to_values(sum(pair) / 2.0), 1)
    elif settings.kind == "spine":
        blood = BLOOD_HU + _PHASE_HU * phase
        field, anatomy = draw_spine(settings, affine, progress, places=places, blood_hu=blood)
        spine = facts_of_spine(anatomy, affine, settings)
    else:
        body = choose_body(affine, settings)
        field = sampling.sample_occupancy(body, affine, settings.shape_kji)
        field *= np.float32(settings.inside_hu - settings.outside_hu)
        field += np.float32(settings.outside_hu)
        surface = body.describe()
        half_maximum = (settings.inside_hu + settings.outside_hu) / 2.0
    sampling.apply_point_spread(field, affine, settings.point_spread_mm, progress, places)
    if labels is not None and scanner.streaks:
        sampling.add_streaks(
            field, labels == scenes.MATERIALS.index("metal"), scenes.METAL_HU, affine, scanner.streaks, settings.seed
        )
    if scanner.cupping_hu:
        sampling.add_cupping(field, affine, scanner.cupping_hu)
    sampling.add_noise(field, settings.noise, settings.seed if phase == 0 else settings.seed + 1000003 * phase)
    voxels = np.empty(field.shape, dtype=np.int16)
    floor, ceiling = (-32768, 32767 + RESCALE_INTERCEPT) if labels is None else (RESCALE_INTERCEPT, scenes.CEILING_HU)
    for k in range(len(field)):
        voxels[k] = np.rint(scanner.slope * np.clip(field[k], floor, ceiling) + scanner.offset)
    if scanner.padding is not None:
        voxels[:, sampling.outside_disc(field.shape[1:], affine)] = scanner.padding
    ghosts = draw_ghosts(voxels, settings.seed) if settings.ghosts else None
    suggested = _SPINE_ISO_HU if settings.kind == "spine" else scenes.DENSE_HU
    truth: dict[str, Any] = {
        "schema": "clrecon-phantom-1",
        "generator": _GENERATOR,
        "version": package_version(),
        "kind": settings.kind,
        "shape_ijk": list(settings.shape_kji[::-1]),
        "affine_ijk_to_lps_mm": affine.tolist(),
        "spacing_mm": list(column_spacing(affine)),
        "slice_gap_along_normal_mm": float(placement.slice_thickness),
        "tilt_deg": signed_tilt(affine),
        "iso_value_hu": suggested if half_maximum is None else half_maximum,
        "half_maximum_hu": half_maximum,
        "surface": surface,
        "spine": spine,
        "ghosts": ghosts,
        "unit": scanner.unit,
        "parts": None if labels is None else scenes.facts_of_parts(voxels, labels, affine),
        "noise_hu": settings.noise,
        "point_spread_mm": settings.point_spread_mm,
        "seed": settings.seed,
        "settings": settings.as_dict(),
    }
    if (series := facts_of_series(settings, placement)) is not None:
        truth["series"] = series
        truth["shape_ijk"][2] = len(series["slice_positions_lps_mm"])
    return voxels, truth, labels


def make_phantom(
    settings: PhantomSettings, progress: Progress | None = None
) -> tuple[NDArray[np.int16], NDArray[np.float64], dict[str, Any]]:
    """Make a phantom in memory.

    Returns:
    voxels: ndarray, shape (nk, nj, ni), int16. HU; of several phases the first.
    affine: ndarray, shape (4, 4), float64. Index (i, j, k) to LPS mm, as the decimal strings of a written series give
        it; of an uneven or gapped series that of the even one, and the truth has the positions.
    truth: Plain JSON types: ``kind, shape_ijk, affine_ijk_to_lps_mm, spacing_mm (di, dj, dk), tilt_deg, iso_value_hu``,
        ``half_maximum_hu`` and ``surface`` (analytic shapes, else null), ``spine`` (centres of the vertebrae, the
        marker on the patient's left and what is absent, else null), ``ghosts`` (the foreign slices, else null),
        ``parts`` (scenes: each material with its label in `label_materials`, voxels, volume and voxels above 300 HU,
        else null), ``noise_hu, point_spread_mm, seed, version, settings``; and ``series`` of one that is uneven, gapped
        or phased.
    """
    placement = place_slices(settings)
    voxels, truth, _ = _make_voxels(settings, placement, progress)
    if settings.missing:
        voxels = voxels[[k for k in range(len(voxels)) if k + 1 not in settings.missing]]
    return voxels, placement.affine, truth


def label_materials(settings: PhantomSettings) -> scenes.LabelArray:
    """Label each voxel of a scene with its material, an index in `MATERIALS`: the truth of `make_phantom`."""
    if not KINDS[settings.kind].is_scene:
        raise UsageError(f"a {settings.kind} is no scene of materials: its truth is a surface or a list of levels")
    return scenes.draw_scene(plan_scene(settings), settings, place_slices(settings).affine)[1]


def is_phantom_truth(truth: Any) -> bool:
    """True for what a truth.json of this package holds."""
    return isinstance(truth, dict) and truth.get("generator") == _GENERATOR


def _check_replaceable(folder: Path, shown: str) -> None:
    """Accept a folder that is absent, empty, or holds an earlier phantom and nothing else."""
    if not folder.parent.is_dir():
        raise OutputError(f"cannot write {shown}: the folder around it does not exist; make it first")
    if not folder.exists():
        return
    if not folder.is_dir():
        raise OutputError(f"cannot write {shown}: a file of that name exists; give a new folder")
    if folder == Path.cwd():
        raise UsageError("cannot write into the current folder: give a new or empty folder")
    names = sorted(entry.name for entry in folder.iterdir())
    if not names:
        return
    foreign = [name for name in names if not _OURS.fullmatch(name)]
    if foreign or TRUTH_NAME not in names:
        files = count_of(len(names), "file that is no phantom", "files that are no phantom")
        raise UsageError(f"{folder.name} holds {files} ({(foreign or names)[0]}): give a new or empty folder")
    try:
        known = json.loads(read_regular(folder / TRUTH_NAME, LARGEST_TRUTH))
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder.name}/{TRUTH_NAME} is not of a phantom: give a new or empty folder") from error
    if not is_phantom_truth(known):
        raise UsageError(f"{folder.name}/{TRUTH_NAME} is not of a phantom: give a new or empty folder")


def write_phantom(
    out_folder: str | Path, settings: PhantomSettings, progress: Progress | None = None
) -> dict[str, Any]:
    """Write a phantom as a DICOM CT series with a truth.json, which is returned, see `make_phantom`; a scene also with
    the label map materials.nrrd, a spine with chosen levels, bend or facets with the label map levels.nrrd.

    The series is written into a temporary folder beside `out_folder`, read back, and then renamed: `out_folder`, new,
    empty or with an earlier phantom and nothing else (then replaced), is either complete or untouched.
    """
    folder, shown = resolve_target(out_folder), shown_path(out_folder)
    try:
        _check_replaceable(folder, shown)
        refuse_existing(shown, folder)
        placement = place_slices(settings)
        voxels, truth, labels = _make_voxels(settings, placement, progress)
        with temporary_folder(folder.parent) as temporary:
            finished = temporary / "series"
            finished.mkdir()
            write_series(finished, voxels, settings, placement, progress)
            for phase in range(1, settings.phases):
                voxels, _, _ = _make_voxels(settings, placement, progress, phase)
                write_series(finished, voxels, settings, placement, progress, phase)
            (finished / TRUTH_NAME).write_text(json.dumps(truth, indent=2) + "\n", encoding="utf-8")
            if labels is not None:
                write_label_map(finished / _MATERIALS_NAME, labels, placement.affine)
            if settings.spine_choice is not None:
                names = {level_number(name): name for name in settings.spine_choice.levels}
                levels = label_levels(settings, placement.affine)
                write_label_map(finished / _LEVELS_NAME, levels, placement.affine, names)
            place_folder(finished, folder, shown, keep=existing_stay())
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise OutputError(f"the phantom cannot be written to {shown}: {reason}") from error
    return truth
