"""A closed surface from a cloud with normals; `find_walls` finds where no points support it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.opencl import Device, Stopwatch, check_memory, take_device, with_fallback
from clrecon.operators.points.field import FieldSettings, NodeField, Signs, decide_signs
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.points.cloud import PointCloud
from clrecon.points.spacing import mean_spacing
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_share

_CUBE = 32
"""Nodes along an edge of the cubes in which walls are counted: those of a word."""

_OPEN_SHARE = 1.0 / 3.0
"""Share of its faces above which a cube is open.  A body that has lost its inside has walls for half of its faces."""

Words = NDArray[np.uint32]

_BITS = np.array([bin(number).count("1") for number in range(1 << 16)], np.uint8)


@dataclass(frozen=True, eq=False)
class Walls:
    """Faces between an inner and an outer node, by cube of `_CUBE` nodes; arrays of shape (cubes_z, cubes_y, cubes_x).

    faces: int64. All faces whose lower node is in the cube.
    walls: int64. Those that no points support: the field itself has one sign on both sides, or a side is far from all
        points.
    enclosed: float64. Volume that the walls of the cube enclose, in cubes of the node spacing: ``sum((x - c) . n) / 3``
        over their middles x, with their mean c and normals n towards the inside.  It is near 0 for flat walls.
    """

    faces: NDArray[np.int64]
    walls: NDArray[np.int64]
    enclosed: NDArray[np.float64]

    @property
    def share(self) -> float:
        return float(self.walls.sum() / max(int(self.faces.sum()), 1))

    @property
    def open(self) -> NDArray[np.bool_]:
        """Cubes in which over a third of the faces are walls."""
        return self.walls > _OPEN_SHARE * self.faces

    @property
    def lost(self) -> float:
        """Volume that the walls of open cubes enclose, in cubes of the node spacing; at least 0."""
        return max(float(self.enclosed[self.open].sum()), 0.0)

    def worst(self, count: int) -> list[tuple[int, int, int]]:
        """Return the open cubes (z, y, x) with most walls, at most `count` of them."""
        walls = np.where(self.open, self.walls, 0).ravel()
        order = np.argsort(-walls, kind="stable")[:count]
        return [tuple(map(int, np.unravel_index(at, self.walls.shape))) for at in order if walls[at]]  # type: ignore[misc]


def find_walls(near: Words, negative: Words, inside: Words, nx: int) -> Walls:
    """Count the faces between inner and outer nodes, and those without support.

    A face is supported where both nodes are near and the field has two signs there.  Where it has one, the signs of far
    nodes have come through a hole in the cloud and stopped at the points of the other side: a wall.

    The masks, (nz, ny, words) uint32, bit b of word w being node 32 w + b of `nx` in a row, are of nodes within the
    bridge of a point, of the sign of the field there, and of the decided sign.
    """
    nz, ny, words = near.shape
    shape = (-(-nz // _CUBE), -(-ny // _CUBE), words)
    faces, walls = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    enclosed = np.zeros(shape)
    bits = np.arange(32 * words).reshape(words, 32) < nx
    valid = np.packbits(bits, axis=1, bitorder="little").view(np.uint32).ravel()
    for layer, first in enumerate(range(0, nz, _CUBE)):
        parts = [mask[first : first + _CUBE + 1] for mask in (near, negative, inside)]
        places, normals = [], []
        cubes = []
        for axis, changed, wall, inner in _compare_nodes(parts, min(_CUBE, nz - first), valid):
            faces[layer] += _count_bits(changed, shape[1])
            wall_rows, lower_inside = _list(wall, inner)
            walls[layer] += np.bincount(
                wall_rows[:, 1] // _CUBE * words + wall_rows[:, 2] // _CUBE, minlength=shape[1] * words
            ).reshape(shape[1:])
            cubes.append(wall_rows[:, 1] // _CUBE * words + wall_rows[:, 2] // _CUBE)
            doubled = 2 * wall_rows
            doubled[:, axis] += 1
            normal = np.zeros_like(wall_rows)
            normal[:, axis] = np.where(lower_inside, -1, 1)
            places.append(doubled)
            normals.append(normal)
        enclosed[layer] = _enclose(np.concatenate(places), np.concatenate(normals), np.concatenate(cubes), walls[layer])
    return Walls(faces, walls, enclosed)


def count_bits(words: Words) -> int:
    """Return the number of set bits of a mask, layer by layer."""
    return sum(int(_BITS[layer.view(np.uint16)].sum(dtype=np.int64)) for layer in words)


def _compare_nodes(parts: list[Words], layers: int, valid: Words) -> Iterator[tuple[int, Words, Words, Words]]:
    """Yield for each axis (z, y, x) the faces towards the next node, those without support, and inner lower nodes."""
    for axis in range(3):
        (near, near_next), (negative, negative_next), (inside, inside_next) = (
            _neighbours(mask, axis, layers) for mask in parts
        )
        last = _neighbours(np.broadcast_to(valid, parts[0].shape), 2, layers)[1] if axis == 2 else valid
        changed = (inside ^ inside_next) & valid & last
        supported = near & near_next & (negative ^ negative_next)
        yield axis, changed, changed & ~supported, inside


def _neighbours(mask: Words, axis: int, layers: int) -> tuple[Words, Words]:
    """Return words of nodes, and of their next neighbours along an axis; of z and y without those that have none."""
    if axis == 0:
        return mask[:-1][:layers], mask[1:][:layers]
    mask = mask[:layers]
    if axis == 1:
        return mask[:, :-1], mask[:, 1:]
    after = mask >> np.uint32(1)
    after[:, :, :-1] |= mask[:, :, 1:] << np.uint32(31)
    return mask, after


def _count_bits(words: Words, cubes_y: int) -> NDArray[np.int64]:
    """Return the number of set bits by cube, shape (cubes_y, words)."""
    k, j, word = np.nonzero(words)  # few of them
    bits = _BITS[words[k, j, word].view(np.uint16)].reshape(-1, 2).sum(axis=1)
    count = words.shape[2]
    return np.bincount(j // _CUBE * count + word, bits, cubes_y * count).astype(np.int64).reshape(cubes_y, count)


def _list(wall: Words, inside: Words) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the nodes (z, y, x) of set bits, and whether they are inside."""
    k, j, word = np.nonzero(wall)
    bits = [
        np.unpackbits(mask[k, j, word].view(np.uint8).reshape(-1, 4), axis=1, bitorder="little").astype(bool)
        for mask in (wall, inside)
    ]
    row, bit = np.nonzero(bits[0])
    return np.stack([k[row], j[row], 32 * word[row] + bit], axis=1), bits[1][row, bit]


def _enclose(
    doubled: NDArray[np.int64], normals: NDArray[np.int64], cubes: NDArray[np.int64], walls: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the volume that the walls of each cube enclose; `doubled` are twice their middles."""
    size = walls.size

    def by_cube(values: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.bincount(cubes, values, minlength=size).astype(np.float64)

    heights, moments = by_cube((doubled * normals).sum(axis=1)), np.zeros(size)
    for axis in range(3):
        moments += by_cube(doubled[:, axis]) * by_cube(normals[:, axis])
    enclosed: NDArray[np.float64] = (heights - moments / np.maximum(walls.ravel(), 1)) / 6.0
    return enclosed.reshape(walls.shape)


FEWEST_POINTS = 4
"""Fewest points that can enclose anything."""

_BRIDGE_SHARE = 2.0
"""Default of B / h: with points at random, mean spacing h, holes are 2 to 2.5 h wide."""

CLEAN = {"reach": 1.0, "smoothing": 0.1}
NOISY = {"reach": 3.0, "smoothing": 1000.0}
"""Defaults of R / h, which is B / h at least, and of s / h: the nearest planes decide, or all within R count."""

_MOST_REACH = 32.0
"""Most R / h: a node adds up all points within R."""

_LEAST_SMOOTHING = 1e-3
"""Least s / h: float32 holds the weights."""

_LEAK_SHARE = 0.1
"""Share of votes against the winner from which on the inside is joined to the outside.  0.02 to 0.05 was seen on bone,
0.005 on simple shapes, 0.38 to 0.46 with leaks."""

_DOUBTFUL_SHARE = 0.05
"""Share from which on there is a warning: of several bones one may leak, and the others outvote it.  0.057 was seen
where slices 4.25 mm apart were meshed with nodes 1 mm apart, and 17 % of the volume were lost."""

_WALL_SHARE = 0.1
"""Share of the surface without points from which on there is a warning.  Up to 0.01 was seen on shapes, 0.07 where they
had holes that were bridged, 0.03 to 0.07 on bone, and 0.22 to 0.39 where slices were farther apart than nodes could
bridge and 8 to 23 % of the volume were lost."""

_LOST_SHARE = 0.003
"""Share of the volume from which on there is a warning that walls enclose it.  0.0001 at most was seen on sound clouds,
and 0.006 where the smallest of twenty balls had a hole."""

_MOST_OPEN_CUBES = 8

_NO_SCAN: dict[str, Any] = {"warnings": [], "outside_air": "distances in mm, no HU: level 0 is no skin"}
"""Report of the volume of distances."""

WIDER = 1.25
_MOST_WIDENINGS = 3

_UNIT_ERROR = 1e-3
"""Normals whose length differs more from 1 are made unit vectors."""


@explains_arguments
def reconstruct_surface(
    cloud: PointCloud,
    spacing: float | None = None,
    *,
    noisy: bool = False,
    reach: float | None = None,
    smoothing: float | None = None,
    bridge: float | None = None,
    widenings: int = _MOST_WIDENINGS,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Make a closed surface from points with normals that point outward.

    On nodes of a cubic grid the distances from the planes of all points within ``reach`` are averaged, with the weight
    ``(1 - d^2 / reach^2)^2 / (d^2 + smoothing^2)`` at distance d.  Nodes farther than ``bridge`` from every point form
    regions, each inside or outside as most of the near nodes at its border say.  The surface is the level 0 of that
    field (`extract_isosurface`), so that it is closed always.

    A hole in the cloud that is wider than 2 ``bridge`` joins inside and outside.  The votes are then split: where more
    than a tenth of them is against the winner, ``bridge`` is made 1.25 times as wide, at most ``widenings`` times, and
    then the cloud is refused.

    Parameters
    ----------
    cloud : PointCloud
        At least four points, with normals out of bone; those of `estimate_normals` and of surface points are.
    spacing : float, optional
        h, mm between the nodes; None is the mean spacing of the points, as estimated from the cells that they occupy.
    noisy : bool
        True: points scatter about the surface.  ``reach`` is then 3 h by default, and all points within it count much
        the same.
    reach : float, optional
        R, mm, at least ``bridge`` and at most 32 h.  None is ``bridge``, and at least 3 h where ``noisy``.
    smoothing : float, optional
        s, mm.  None: 0.1 h, with which the surface follows each point, and 1000 h where ``noisy``.
    bridge : float, optional
        B, mm, at least h; None is 2 h.
    widenings : int
        0 to 3: how often ``bridge`` may be widened.
    device, memory, progress
        As in `extract_isosurface`.  Nodes that do not fit are worked on in slabs, with the same mesh bit for bit.

    Returns
    -------
    Mesh
        In LPS mm.  ``Mesh.report`` has ``surface`` ("cloud"), ``points``, ``spacing_mm`` and ``spacing_from``,
        ``reach_mm``, ``smoothing_mm``, ``bridge_mm``, ``tries``, ``votes``, ``votes_against_share``, ``regions``,
        ``wall_share``, ``lost_share`` and ``open_cubes`` (see docs/clouds.md), ``nodes``, ``bricks``, ``slabs``, the
        device, the seconds, and the certificate of the cloud.

    Raises
    ------
    UsageError
        Fewer than four points, no normals, one that is 0, a length that is not as above, or more than 2^31 nodes.
    RefusedInputError
        Inside and outside are joined, or the normals point inward.
    NoSurfaceError, DeviceError
        The cloud encloses nothing at this spacing; no device, no room on it, or it fails.

    References
    ----------
    Hoppe et al. 1992, Surface reconstruction from unorganized points; Shen, O'Brien and Shewchuk 2004, Interpolating
    and approximating implicit surfaces from polygon soup.
    """
    check_memory(memory)
    normals = _check_cloud(cloud)
    _check_numbers(widenings, {"spacing": spacing, "reach": reach, "smoothing": smoothing, "bridge": bridge})
    mean_mm = _own_spacing(cloud) if spacing is None else float(spacing)
    settings = _choose_lengths(mean_mm, noisy, reach, smoothing, bridge)
    for attempt in with_fallback(take_device(device)):
        with attempt as (current, warnings):
            run = _Reconstruction(cloud, normals, settings, current, memory, progress or ignore_progress)
            mesh = run.make(widenings)
    mesh.report["spacing_from"] = "points" if spacing is None else "caller"
    mesh.report["warnings"] = [*warnings, *mesh.report["warnings"]]
    return mesh


def _check_numbers(widenings: object, lengths: Mapping[str, float | None]) -> None:
    if isinstance(widenings, bool) or not isinstance(widenings, int) or not 0 <= widenings <= _MOST_WIDENINGS:
        raise UsageError(f"widenings are a whole number from 0 to {_MOST_WIDENINGS}, not {widenings!r}")
    for name, length in lengths.items():
        if length is not None and not (np.isfinite(length) and length > 0.0):
            raise UsageError(f"{name} is a positive number of mm, not {length!r}")


def _own_spacing(cloud: PointCloud) -> float:
    mean_mm = mean_spacing(cloud.points)
    if mean_mm == 0.0:
        raise UsageError(
            "the points coincide, so that their spacing is not known: name it in mm"
            f" ({name_parameter('spacing', 1)}), or thin the cloud"
        )
    return mean_mm


def _check_cloud(cloud: PointCloud) -> NDArray[np.float32]:
    if len(cloud) < FEWEST_POINTS:
        raise UsageError(f"the cloud has {len(cloud)} points: a closed surface needs at least {FEWEST_POINTS}")
    if cloud.normals is None:
        raise UsageError(
            "the cloud has no normals, so that inside and outside are not known: estimate them first, with the volume"
            " or a viewpoint (clrecon.estimate_normals)"
        )
    squares = np.einsum("ij,ij->i", cloud.normals, cloud.normals, dtype=np.float64)
    missing = int(np.count_nonzero(squares == 0.0))
    if missing:
        raise UsageError(
            f"{missing:,} of {len(cloud):,} normals are 0: estimate them anew, or remove these points first"
        )
    if np.abs(squares - 1.0).max() <= 2.0 * _UNIT_ERROR:
        return cloud.normals
    return (cloud.normals / np.sqrt(squares)[:, None]).astype(np.float32)


def _choose_lengths(
    spacing: float, noisy: bool, reach: float | None, smoothing: float | None, bridge: float | None
) -> FieldSettings:
    shares = NOISY if noisy else CLEAN
    b = _BRIDGE_SHARE * spacing if bridge is None else float(bridge)
    r = max(shares["reach"] * spacing, b) if reach is None else float(reach)
    s = shares["smoothing"] * spacing if smoothing is None else float(smoothing)
    if not spacing <= b:
        raise UsageError(f"a bridge of {b:g} mm is less than the spacing of {spacing:g} mm: take at least that")
    if not b <= r <= _MOST_REACH * spacing:
        raise UsageError(
            f"a reach of {r:g} mm: with a spacing of {spacing:g} mm it is between the bridge, {b:g} mm, and"
            f" {_MOST_REACH * spacing:g} mm"
        )
    if not _LEAST_SMOOTHING * spacing <= s <= 1e6 * spacing:
        raise UsageError(
            f"a smoothing of {s:g} mm: with a spacing of {spacing:g} mm it is between"
            f" {_LEAST_SMOOTHING * spacing:g} and {1e6 * spacing:g} mm"
        )
    return FieldSettings(spacing, r, s, b)


@dataclass(eq=False)
class _Reconstruction:
    cloud: PointCloud
    normals: NDArray[np.float32]
    settings: FieldSettings
    device: Device
    memory: int | None
    progress: Progress
    stopwatch: Stopwatch = field(default_factory=Stopwatch)
    warnings: list[str] = field(default_factory=list)

    def make(self, widenings: int) -> Mesh:
        """Make the mesh, with a wider bridge where inside and outside are joined."""
        with self.stopwatch.running(self.device):
            for tries in range(1, widenings + 2):
                field, signs, negative = self._try()
                if signs.share_against <= _LEAK_SHARE:
                    break
                if tries <= widenings:
                    self._widen(signs)
            else:
                raise self._refuse(signs, tries)
            if signs.outside_is_inside:
                raise RefusedInputError(
                    f"the normals of the cloud point inward: {format_share(1.0 - signs.share_against)} of"
                    f" {signs.votes:,} votes put the surroundings of the cloud inside; turn the normals"
                )
            if signs.share_against > _DOUBTFUL_SHARE:
                self.warnings.append(
                    f"{format_share(signs.share_against, 1)} of {signs.votes:,} votes are against the winner: parts of"
                    " the cloud may be open, and the volume too small; compare with a larger spacing or bridge"
                )
            masks = field.masks
            inside = masks.fetch(signs.inside_d)
            walls = find_walls(masks.fetch(masks.near_d), negative, inside, masks.shape[0])
            del negative
            facts = {**self._describe(field, signs, tries), **self._judge_walls(walls, inside, field)}
            volume = field.fill(signs)
        del signs
        self.progress("field", 2, 3)
        mesh = self._extract(volume, field, facts)
        self.progress("field", 3, 3)
        return mesh

    def _try(self) -> tuple[NodeField, Signs, NDArray[np.uint32]]:
        self.progress("field", 0, 3)
        field = NodeField(self.device, self.cloud, self.normals, self.settings, memory=self.memory)
        field.release_points()
        self.progress("field", 1, 3)
        negative = field.masks.fetch(field.masks.negative_d)  # which the signs use up
        signs = decide_signs(field.masks, field.limits, self.settings.rounds, memory=self.memory, taken=field.nbytes)
        return field, signs, negative

    def _judge_walls(self, walls: Walls, inside: NDArray[np.uint32], field: NodeField) -> dict[str, Any]:
        """Return the report's entries of walls, and warn where they are many or enclose much."""
        h, affine = self.settings.spacing, field.nodes.affine
        volume = count_bits(inside) + walls.lost
        lost = walls.lost / volume if volume else 0.0
        cubes = []
        for z, y, x in walls.worst(_MOST_OPEN_CUBES):
            centre = affine[:3, 3] + h * (_CUBE * np.array((x, y, z)) + _CUBE / 2)
            share = walls.walls[z, y, x] / walls.faces[z, y, x]
            cubes.append(
                {"centre_mm": centre.round(1).tolist(), "edge_mm": _CUBE * h, "wall_share": round(float(share), 4)}
            )
        if walls.share > _WALL_SHARE or lost > _LOST_SHARE:
            middle = ", ".join(f"{at:.0f}" for at in cubes[0]["centre_mm"]) if cubes else ""
            spot = f", most of it within {_CUBE * h / 2:.3g} mm of ({middle}) mm LPS" if middle else ""
            much = (
                f"at least {format_share(lost, 1)} of the volume are lost"
                if lost > _LOST_SHARE
                else "parts of it may be lost"
            )
            self.warnings.append(
                f"{format_share(walls.share, 1)} of the surface are walls that no points support{spot}: the cloud is"
                f" open there, or its points are farther apart than nodes of {h:.4g} mm bridge, and {much}; take a"
                f" larger {name_parameter('spacing')} and compare the volumes"
            )
        return {"wall_share": walls.share, "lost_share": lost, "open_cubes": cubes}

    def _widen(self, signs: Signs) -> None:
        old = self.settings
        bridge = WIDER * old.bridge
        self.settings = FieldSettings(old.spacing, max(old.reach, bridge), old.smoothing, bridge)
        self.warnings.append(
            f"with a bridge of {old.bridge:.4g} mm {format_share(signs.share_against)} of the votes were against the"
            f" winner, so inside and outside were joined: {bridge:.4g} mm were taken"
        )

    def _refuse(self, signs: Signs, tries: int) -> RefusedInputError:
        h, b = self.settings.spacing, self.settings.bridge
        return RefusedInputError(
            f"inside and outside of the cloud are joined: {format_share(signs.share_against)} of {signs.votes:,} votes"
            f" are against the winner, at most {format_share(_LEAK_SHARE)} may be (bridge {b:.4g} mm, spacing {h:.4g}"
            f" mm, tries {tries}): the cloud has holes wider than twice the bridge, ends open, or its normals do not"
            f" agree; take a larger {name_parameter('spacing')} or a wider bridge, or close it first"
        )

    def _describe(self, field: NodeField, signs: Signs, tries: int) -> dict[str, Any]:
        settings = self.settings
        carried = ("certificate", "affine_ijk_to_lps_mm", "iso_value_hu")
        return {
            **{name: self.cloud.report[name] for name in carried if name in self.cloud.report},
            "surface": "cloud",
            "points": len(self.cloud),
            "spacing_mm": settings.spacing,
            "reach_mm": settings.reach,
            "smoothing_mm": settings.smoothing,
            "bridge_mm": settings.bridge,
            "tries": tries,
            "votes": signs.votes,
            "votes_against_share": signs.share_against,
            "regions": signs.regions,
            "nodes": field.nodes.count,
            "bricks": field.bricks,
            "slabs": len(field.slabs),
        }

    def _extract(self, volume: NDArray[np.float32], field: NodeField, facts: dict[str, Any]) -> Mesh:
        far = float(np.float32(self.settings.bridge))
        nodes = Volume(volume, field.nodes.affine, _NO_SCAN, hu_range=(-far, far))
        field.release()
        try:
            mesh = extract_isosurface(nodes, 0.0, device=self.device, memory=self.memory)
        except NoSurfaceError:
            raise NoSurfaceError(
                f"the cloud encloses nothing at a spacing of {self.settings.spacing:.4g} mm: take a smaller one"
            ) from None
        figures = mesh.report
        facts |= {
            "device": figures["device"],
            "driver": figures["driver"],
            "seconds": {part: figures["seconds"][part] + self.stopwatch.seconds[part] for part in figures["seconds"]},
            "kernel_seconds": {**self.stopwatch.by_kernel, **figures["kernel_seconds"]},
            "warnings": [*self.warnings, *figures["warnings"]],
        }
        return Mesh(mesh.vertices, mesh.triangles, mesh.normals, facts)
