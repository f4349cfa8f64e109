"""The truth of a phantom as functions of a place in the patient: distance from the surface, and level."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import ClreconError, UsageError
from clrecon.phantom.bodies import choose_body
from clrecon.phantom.bone_surface import BoneSurface
from clrecon.phantom.build import LARGEST_TRUTH, TRUTH_NAME, is_phantom_truth
from clrecon.phantom.levels import level_number
from clrecon.phantom.placement import place_slices
from clrecon.phantom.settings import CENTRE_LPS_MM, KINDS, PhantomSettings
from clrecon.phantom.spine import label_levels, plan_spine
from clrecon.system.arguments import explains_arguments
from clrecon.system.paths import read_regular

Float64Array = NDArray[np.float64]

_SAME_MM = 1e-6
"""Centres of vertebrae that are planned again lie where truth.json says."""


class PhantomTruth:
    """What is true at any place of a phantom; made by `phantom_truth`.

    Of a spine the surface is that of the vertebrae which it shows, whole ones even where the slices cut them; ribs,
    discs, calcifications and the marker are no part of it.

    Attributes
    ----------
    settings : PhantomSettings
    affine : ndarray, shape (4, 4)
        Index (i, j, k) to LPS mm; of an uneven or gapped series that of the even one.
    levels : tuple of str
        Vertebrae from top to bottom; empty for an analytic shape.
    names : dict of int to str
        Number of each label and its name: 1 to 24 for C1 to L5, 1 for an analytic shape.
    """

    def __init__(self, settings: PhantomSettings):
        self.settings = settings
        self.affine = place_slices(settings).affine
        self._anatomy = plan_spine(settings, self.affine)[0] if settings.kind == "spine" else None
        self._body = None if self._anatomy is not None else choose_body(self.affine, settings)
        self.levels = tuple(v.name for v in self._anatomy.vertebrae) if self._anatomy is not None else ()
        self.names = {level_number(name): name for name in self.levels} or {1: settings.kind}

    @functools.cached_property
    def _bone(self) -> BoneSurface:
        """The surface of a spine; made when it is first needed, in about a second for each vertebra."""
        assert self._anatomy is not None
        return BoneSurface(self._anatomy.vertebrae)

    def signed_distance(self, points_mm: ArrayLike) -> Float64Array:
        """Return the distance to the nearest point of the outer surface, negative inside.

        Parameters
        ----------
        points_mm : array_like, shape (n, 3)
            LPS mm.

        Returns
        -------
        ndarray, shape (n,), float64
            mm; exact for an analytic shape.  Of a spine it is too large by at most 0.03 mm within 0.5 mm of the
            surface and 0.1 mm elsewhere; beside facets that nearly touch, by up to 0.2 mm at one point in 500.

        Raises
        ------
        UsageError
            The points have another shape, or are not finite.
        """
        points = _checked(points_mm)
        if self._body is not None:
            return -self._body.signed_distance(points)
        planned = points - CENTRE_LPS_MM
        distance = self._bone.distance(planned)
        return np.where(self._bone.holder(planned) >= 0, -distance, distance)

    def label(self, points_mm: ArrayLike) -> NDArray[np.uint8]:
        """Return the number of the vertebra, or 1 for the analytic shape, that holds each point, 0 where none does.

        Parameters
        ----------
        points_mm : array_like, shape (n, 3)
            LPS mm.

        Returns
        -------
        ndarray, shape (n,), uint8
            Keys of ``names``, and 0.

        Raises
        ------
        UsageError
            The points have another shape, or are not finite.
        """
        points = _checked(points_mm)
        if self._body is not None:
            return (self._body.signed_distance(points) >= 0.0).astype(np.uint8)
        numbers = np.array([*self.names, 0], dtype=np.uint8)
        return np.asarray(numbers[self._bone.holder(points - CENTRE_LPS_MM)])

    def label_map(self) -> NDArray[np.uint8]:
        """Return the labels of the voxel centres of the (even) stack, shape (nk, nj, ni)."""
        if self._anatomy is not None:
            return label_levels(self.settings, self.affine)
        nk, nj, ni = self.settings.shape_kji
        k, j, i = (part.ravel() for part in np.indices((nk, nj, ni)))
        points = np.stack((i, j, k), axis=1) @ self.affine[:3, :3].T + self.affine[:3, 3]
        return self.label(points).reshape(nk, nj, ni)


def _checked(points_mm: ArrayLike) -> Float64Array:
    points = np.asarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise UsageError(f"points have shape (n, 3), these have {points.shape}")
    if not np.isfinite(points).all():
        raise UsageError(f"{int((~np.isfinite(points)).any(axis=1).sum())} of {len(points)} points are not finite")
    return points


@explains_arguments
def phantom_truth(source: str | Path | PhantomSettings) -> PhantomTruth:
    """Return the truth of a phantom as functions of mm.

    Parameters
    ----------
    source : path or PhantomSettings
        Folder of a phantom, with its truth.json, or the settings that it was made with.

    Returns
    -------
    PhantomTruth

    Raises
    ------
    UsageError
        The folder holds no phantom, or one that this version makes in another way; or the kind is a scene of
        materials, which has no surface as a function.
    """
    settings, known = (source, None) if isinstance(source, PhantomSettings) else _read_truth(Path(source))
    if KINDS[settings.kind].is_scene:
        raise UsageError(
            f"a {settings.kind} is a scene of materials without a surface as a function: see its materials.nrrd"
        )
    truth = PhantomTruth(settings)
    if known is not None and not _is_same(truth, known):
        raise UsageError(
            f"the phantom was written by version {known.get('version')} of clrecon, which makes it in another way:"
            " write it again"
        )
    return truth


def _read_truth(folder: Path) -> tuple[PhantomSettings, dict[str, Any]]:
    """Return the settings in a truth.json, and all of it."""
    name = f"{folder.name}/{TRUTH_NAME}"
    try:
        known = json.loads(read_regular(folder / TRUTH_NAME, LARGEST_TRUTH))
        if not is_phantom_truth(known):
            raise UsageError(f"{name} is not of a phantom")
        return PhantomSettings(**known["settings"]), known
    except OSError as error:
        raise UsageError(f"{name} cannot be read: {error.strerror or type(error).__name__}") from error
    except ClreconError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{name} is not of a phantom") from error


def _is_same(truth: PhantomTruth, known: dict[str, Any]) -> bool:
    """True where affine and centres of the vertebrae are those of truth.json."""
    try:
        written = np.array(known["affine_ijk_to_lps_mm"], dtype=np.float64)
        centres = {level["name"]: level["center_lps_mm"] for level in (known["spine"] or {}).get("vertebrae", [])}
        planned = truth._anatomy.vertebrae if truth._anatomy is not None else []
        moved = [np.abs(v.center + CENTRE_LPS_MM - np.array(centres[v.name])).max() for v in planned]
    except (KeyError, TypeError, ValueError, AttributeError):
        return False
    near = np.abs(written - truth.affine).max() < _SAME_MM if written.shape == (4, 4) else False
    return bool(near) and len(centres) == len(planned) and max(moved, default=0.0) < _SAME_MM
