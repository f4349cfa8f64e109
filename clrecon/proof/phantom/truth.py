"""The truth of a phantom as functions of a place in the patient: distance from the surface, and level.

The outer surface of vertebrae is known by points.  The shapes are functions that are zero on the surface, but no
distances.  So the surface is covered with points (about 1 mm apart, and closer on the rims of what is cut out), the
nearest one of a point asked for is looked up, and from there the foot of the perpendicular is found by two steps of
Newton's method in the plane that touches the surface."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import ClreconError, UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom.build import LARGEST_TRUTH, TRUTH_NAME, is_phantom_truth
from clrecon.proof.phantom.fields import Function, gradient_of
from clrecon.proof.phantom.series import place_slices
from clrecon.proof.phantom.settings import CENTRE_LPS_MM, KINDS, PhantomSettings
from clrecon.proof.phantom.shapes import checked_points, choose_body
from clrecon.proof.phantom.spine import label_levels, plan_spine
from clrecon.proof.phantom.spine_parts import Vertebra, level_number
from clrecon.proof.phantom.vertebra import local_bounds, vertebra_distance, vertebra_shape
from clrecon.system.arguments import explains_arguments
from clrecon.system.paths import read_regular
from clrecon.system.text import escape_text

_STEP_MM = 1.0
_RIM_PARTS = 5
"""Points of the cover on a rim are this many times closer."""
_COARSE = 3
"""Steps of the fine lattice in one of the coarse one, on which the neighbourhood of the surface is looked for."""
_STEEPEST = 1.8
"""Largest slope of the functions: flat rods are compressed by up to 1.6 along z."""
_AT_ONCE_MM = 2.0
"""Points nearer than this look for the foot from where they are too: the nearest point of the cover may lie beyond a
rim."""
_NEAR_MM = 60.0
"""Farther away the nearest point of the cover is good enough: its error is below 0.01 mm."""
_PROBE_MM = 0.5
"""Way over which the curvature is measured."""
_CHUNK = 50_000


def _workers() -> int:
    return max(1, min(os.cpu_count() or 1, 8))


class _Shape:
    """The functions of one vertebra at points (n, 3) in its own frame."""

    def __init__(self, vertebra: Vertebra):
        self.vertebra = vertebra

    def __call__(self, local: Float64Array) -> Float64Array:
        return np.asarray(vertebra_distance(self.vertebra, *np.ascontiguousarray(local.T)), dtype=np.float64)

    def parts(self, local: Float64Array) -> list[Float64Array]:
        """Return the functions of the bone and of what is left by each cut: the shape is the least of them."""
        bone, cuts = vertebra_shape(self.vertebra, *np.ascontiguousarray(local.T))
        return [np.asarray(bone, dtype=np.float64), *(np.asarray(-cut, dtype=np.float64) for cut in cuts)]

    def part(self, number: int, local: Float64Array) -> Float64Array:
        return self.parts(local)[number]

    def cover(self) -> Float64Array:
        """Return points of the surface and of the rims where cuts leave it, shape (n, 3)."""
        low, high = (np.array(corner) for corner in local_bounds(self.vertebra))
        step = _COARSE * _STEP_MM
        axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        coarse = np.stack([part.ravel() for part in np.meshgrid(*axes, indexing="ij")], axis=1)
        reach = _STEEPEST * np.sqrt(3.0) / 2.0
        near = coarse[np.abs(self(coarse)) < reach * _COARSE * _STEP_MM]
        # a cube of finer points around each
        offsets = (np.arange(_COARSE) - (_COARSE - 1) / 2.0) * _STEP_MM
        cube = np.stack(np.meshgrid(offsets, offsets, offsets, indexing="ij"), axis=-1).reshape(-1, 3)
        fine = (near[:, None] + cube).reshape(-1, 3)
        value, *cuts = self.parts(fine)
        rims = [self._rim(n, fine[(np.abs(value) < _STEP_MM) & (np.abs(cut) < _STEP_MM)]) for n, cut in enumerate(cuts)]
        for cut in cuts:
            np.minimum(value, cut, out=value)
        points = fine[np.abs(value) < reach * _STEP_MM / 1.5]
        for _ in range(3):
            value, gradient = gradient_of(self, points)
            square = np.maximum(np.einsum("ij,ij->i", gradient, gradient), 1e-4)
            points = points - np.clip(value / square, -_STEP_MM, _STEP_MM)[:, None] * gradient
        points = points[np.abs(self(points)) < 1e-4]
        return np.concatenate((points, *rims))

    def _rim(self, cut: int, near: Float64Array) -> Float64Array:
        """Return points where the bone and a cut are both zero and nothing else is cut away."""

        def move(points: Float64Array, rounds: int) -> tuple[Float64Array, Float64Array]:
            """Return points moved onto the rim, and its directions there."""
            along = np.zeros_like(points)
            for _ in range(rounds):
                bone, first = gradient_of(functools.partial(self.part, 0), points)
                hole, second = gradient_of(functools.partial(self.part, cut + 1), points)
                a, b, c = ((u * v).sum(axis=1) for u, v in ((first, first), (first, second), (second, second)))
                det = np.maximum(a * c - b * b, 1e-3)
                step = ((c * bone - b * hole) / det)[:, None] * first + ((a * hole - b * bone) / det)[:, None] * second
                points = points - np.clip(step, -_STEP_MM, _STEP_MM)
                along = np.cross(first, second) / np.sqrt(det)[:, None]
            return points, along

        points, along = move(near, 5)
        offsets = (np.arange(_RIM_PARTS) - (_RIM_PARTS - 1) / 2.0) * _STEP_MM / _RIM_PARTS
        points = move((points[:, None] + along[:, None] * offsets[:, None]).reshape(-1, 3), 3)[0]
        bone, hole = self.part(0, points), self.part(cut + 1, points)
        return points[(np.abs(bone) < 1e-4) & (np.abs(hole) < 1e-4) & (np.abs(self(points)) < 1e-4)]


class BoneSurface:
    """The surface of some vertebrae, in mm of their plan."""

    def __init__(self, vertebrae: Sequence[Vertebra]):
        from scipy.spatial import cKDTree

        self.vertebrae = list(vertebrae)
        self._shapes = [_Shape(vertebra) for vertebra in self.vertebrae]
        with ThreadPoolExecutor(_workers()) as pool:
            covers = list(pool.map(_Shape.cover, self._shapes))
        self._local = np.concatenate(covers)
        self._owner = np.repeat(np.arange(len(covers)), [len(cover) for cover in covers])
        placed = [v.center + cover @ v.axes for v, cover in zip(self.vertebrae, covers, strict=True)]
        # a tree of compact nodes takes five times as long to ask
        self._tree = cKDTree(np.concatenate(placed), compact_nodes=False, balanced_tree=False)

    def holder(self, points: Float64Array) -> NDArray[np.intp]:
        """Return the place in `vertebrae` of the one that holds each point (n, 3), -1 where none does."""
        holders = np.full(len(points), -1, dtype=np.intp)
        for n, vertebra in enumerate(self.vertebrae):
            local = (points - vertebra.center) @ vertebra.axes.T
            low, high = local_bounds(vertebra)
            boxed = np.flatnonzero(((local > low) & (local < high)).all(axis=1))
            for start in range(0, len(boxed), _CHUNK):
                part = boxed[start : start + _CHUNK]
                holders[part[self._shapes[n](local[part]) >= 0.0]] = n
        return holders

    def distance(self, points: Float64Array) -> Float64Array:
        """Return the distance of points (n, 3) to the nearest point of the surface, mm, without a sign."""
        distance, nearest = self._tree.query(points, workers=-1)
        owner = np.where(distance < _NEAR_MM, self._owner[nearest], -1)
        work = []
        for n in range(len(self.vertebrae)):
            chosen = np.flatnonzero(owner == n)
            work += [(n, chosen[start : start + _CHUNK]) for start in range(0, len(chosen), _CHUNK)]

        def refine(task: tuple[int, NDArray[np.intp]]) -> None:
            n, part = task
            local = (points[part] - self.vertebrae[n].center) @ self.vertebrae[n].axes.T
            close = np.flatnonzero(distance[part] < _AT_ONCE_MM)
            at_once = self._foot(n, local[close], local[close])
            foot = self._foot(n, local, self._local[nearest[part]])
            foot[close] = np.minimum(foot[close], at_once)
            distance[part] = np.minimum(distance[part], foot)

        with ThreadPoolExecutor(_workers()) as pool:
            list(pool.map(refine, work))
        return np.asarray(distance, dtype=np.float64)

    def _foot(self, n: int, points: Float64Array, starts: Float64Array) -> Float64Array:
        """Return distances to the feet of perpendiculars on the parts nearest at `starts`; infinite where cut away."""
        shape = self._shapes[n]
        distances = np.full(len(points), np.inf)
        values = np.abs(shape.parts(starts))
        # the functions are steeper than a distance by different factors: parts that may be the nearest one are tried
        near = values <= 2.0 * values.min(axis=0) + 0.2
        for part, tried in enumerate(near):
            chosen = np.flatnonzero(tried)
            if len(chosen):
                feet, slope = _walk(functools.partial(shape.part, part), points[chosen], starts[chosen])
                off = np.abs(shape(feet)) / slope
                reached = np.where(off < 1e-3, np.linalg.norm(points[chosen] - feet, axis=1) + off, np.inf)
                distances[chosen] = np.minimum(distances[chosen], reached)
        return distances


def _walk(function: Function, points: Float64Array, foot: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the feet of the perpendiculars of points on a smooth surface, and the slopes of the function there.

    A step goes along the touching plane by the part of the way that the curvature of the surface in this direction
    leaves: way / (1 + curvature * height), with the height over the surface.
    """
    for _ in range(2):
        value, gradient = gradient_of(function, foot)
        slope = np.sqrt(np.maximum(np.einsum("ij,ij->i", gradient, gradient), 1e-6))
        normal = -gradient / slope[:, None]  # outwards
        foot = foot + (value / slope)[:, None] * normal
        offset = points - foot
        height = np.einsum("ij,ij->i", offset, normal)
        tangent = offset - height[:, None] * normal
        length = np.sqrt(np.maximum(np.einsum("ij,ij->i", tangent, tangent), 1e-12))
        probe = np.minimum(length, _PROBE_MM)
        # how far the surface falls back from the plane a little on the way
        drop = -function(foot + (probe / length)[:, None] * tangent) / slope
        share = 1.0 / np.clip(1.0 + 2.0 * drop / probe**2 * height, 0.5, 100.0)
        foot = foot + share[:, None] * tangent
    value, gradient = gradient_of(function, foot)
    square = np.maximum(np.einsum("ij,ij->i", gradient, gradient), 1e-6)
    foot = foot - (value / square)[:, None] * gradient
    return foot, np.sqrt(square)


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
    points = checked_points(points_mm)
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
    name = f"{folder.name}/{TRUTH_NAME}"
    try:
        known = json.loads(read_regular(folder / TRUTH_NAME, LARGEST_TRUTH))
        if not is_phantom_truth(known):
            raise UsageError(f"{name} is not of a phantom")
        return PhantomSettings(**known["settings"]), known
    except FileNotFoundError:
        missing = folder / TRUTH_NAME if folder.is_dir() else folder
        raise UsageError(f"there is no truth of a phantom {escape_text(str(missing), 200)}") from None
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
