"""Solid bodies without labels: what bone encloses joins the bone; its spaces are measured first."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.iso_choice import settle_level
from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.geometry.certificate import amend
from clrecon.geometry.iso_rule import choose_iso_rule, describe_range
from clrecon.geometry.regions import find_open_places, holds_ball
from clrecon.opencl import Device, download, result_pages, upload, wait
from clrecon.operators.masks.mask import Mask
from clrecon.operators.masks.regions import checked_mm
from clrecon.operators.masks.runs import Components, RunList, find_components, mark_with_voxels, write_runs
from clrecon.operators.masks.voxel_mask import mask_bytes, zero_words
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.points.stencil import Lattice
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, Steps
from clrecon.system.records import at_most
from clrecon.system.text import count_of, format_ml

WIDE_ML = 20.0
"""Smaller spaces are not wide: even a disc of 5 mm from the middle of a ball of 35 mm radius has 19 ml."""


@dataclass(frozen=True)
class Spaces:
    """Components, (n,) each, that a mask encloses: ascending `numbers` among all; `at_ends` of the volume."""

    volume: Volume
    numbers: NDArray[np.intp]
    ml: NDArray[np.float64]
    mean_hu: NDArray[np.float64]
    at_ends: NDArray[np.bool_]
    _runs: RunList
    _found: Components
    _mask: Mask

    @property
    def count(self) -> int:
        return len(self.numbers)

    def choose(self, wanted: NDArray[np.bool_]) -> Mask:
        """Return the voxels of some of the spaces; `wanted` has shape (n,)."""
        return _write_components(self._mask, self._found, self.numbers[wanted], f"spaces in ({self._mask.name})")

    def are_wide(self, radius_mm: float) -> NDArray[np.bool_]:
        """Tell of each space whether a ball of this radius fits into it and what lies beyond ends that cut it."""
        wide = np.zeros(self.count, bool)
        for hole in np.flatnonzero(self.ml >= WIDE_ML) if np.isfinite(radius_mm) else ():
            wide[hole] = _hold_ball(self._runs.of(self.numbers[hole]), self.volume, radius_mm)
        return wide

    def describe(self, which: NDArray[np.bool_]) -> dict[str, Any]:
        """Return number, ml and the largest of some of the spaces, with LPS mm of a voxel in the middle of it."""
        facts: dict[str, Any] = {"spaces": int(np.count_nonzero(which)), "ml": float(self.ml[which].sum())}
        if not which.any():
            return {**facts, "largest_ml": 0.0, "at_mm": None}
        largest = int(np.argmax(np.where(which, self.ml, -1.0)))
        middle = _find_middle(self._runs.of(self.numbers[largest]))
        position = self.volume.ijk_to_lps(np.array([middle], np.float64))[0]
        return {**facts, "largest_ml": float(self.ml[largest]), "at_mm": [round(float(x), 1) for x in position]}


def _write_components(mask: Mask, components: Components, numbers: NDArray[np.intp], name: str) -> Mask:
    """Return the voxels of some components of what is in a mask, or of what is not."""
    device, words_d = mask.device, zero_words(mask.device, mask_bytes(mask.shape_ijk)["mask of the voxels"] // 4)
    if len(numbers):
        marks = np.zeros(4 * -(-components.count // 4), np.uint8)
        marks[numbers] = 1
        write_runs(device, components, upload(device, marks), words_d, mask.shape_ijk)
    return Mask(mask.scan, words_d, name, device=device, memory=mask.memory)


def _sum_hu(runs: RunList, volume: Volume, count: int) -> NDArray[np.float64]:
    sums = np.zeros(count)
    nj, ni = volume.voxels.shape[1:]
    bounds = np.searchsorted(runs.k, np.arange(len(volume.voxels) + 1))
    for k in np.flatnonzero(np.diff(bounds)):
        rows = slice(int(bounds[k]), int(bounds[k + 1]))
        totals = np.zeros(nj * ni + 1)
        np.cumsum(volume.voxels[k].ravel(), dtype=np.float64, out=totals[1:])
        row = runs.j[rows] * ni
        hu = totals[row + runs.last[rows] + 1] - totals[row + runs.first[rows]]
        sums += np.bincount(runs.numbers[rows], hu, count)
    return sums


def _find_middle(runs: RunList) -> tuple[int, int, int]:
    runs_in_slice = np.flatnonzero(runs.k == runs.k[len(runs.k) // 2])
    middle = runs_in_slice[len(runs_in_slice) // 2]
    return int(runs.first[middle] + runs.last[middle]) // 2, int(runs.j[middle]), int(runs.k[middle])


def _hold_ball(runs: RunList, volume: Volume, radius_mm: float) -> bool:
    lows = [int(low.min()) for low in (runs.k, runs.j, runs.first)]
    highs = [int(high.max()) + 1 for high in (runs.k, runs.j, runs.last)]
    steps = np.zeros([high - low for low, high in zip(lows, highs, strict=True)] + np.array([0, 0, 1]), np.int8)
    np.add.at(steps, (runs.k - lows[0], runs.j - lows[1], runs.first - lows[2]), 1)
    np.add.at(steps, (runs.k - lows[0], runs.j - lows[1], runs.last + 1 - lows[2]), -1)
    body = np.cumsum(steps, axis=2, dtype=np.int8)[:, :, :-1] > 0
    ends = tuple((low == 0, high == n) for low, high, n in zip(lows, highs, volume.voxels.shape, strict=True))
    di, dj, dk = volume.spacing
    return holds_ball(body, ends, (dk, dj, di), radius_mm)


def find_spaces(mask: Mask) -> Spaces:
    """Find the spaces that a mask encloses.

    A space is a component, by faces of voxels, of what is not in the mask.  It is enclosed if it does not reach the
    border of the volume, or reaches it only within what the mask encloses in that end slice alone: there an end of the
    volume cuts it, as that of a scan cuts the canal of a long bone.
    """
    device, shape = mask.device, mask.shape_ijk
    volume = mask.scan
    rest = (~mask).bits
    components = find_components(device, rest, beside=2 * rest.needs()["mask of the voxels"], memory=mask.memory)
    none = np.empty(0)
    if not components.count:
        empty = np.empty(0, np.int32)
        runs = RunList(empty, empty, empty, empty, empty)
        return Spaces(volume, none.astype(np.intp), none, none, none.astype(bool), runs, components, mask)
    marks_d, _ = mark_with_voxels(device, components, shape, _open_ends(mask))
    outside = download(device, np.empty(components.count, np.uint8), marks_d) != 0
    numbers = np.flatnonzero(~outside)
    runs = RunList.read(device, components, shape)
    runs = runs.where(~outside[runs.numbers])
    voxels = np.bincount(runs.numbers, runs.lengths, components.count)[numbers]
    each_ml = runs.sum_ml(volume, components.count)[numbers]
    hu = _sum_hu(runs, volume, components.count)[numbers] / np.maximum(voxels, 1.0)
    ni, nj, nk = shape
    at_end = np.zeros(components.count, bool)
    ends = (runs.k == 0) | (runs.k == nk - 1) | (runs.j == 0) | (runs.j == nj - 1)
    at_end[runs.numbers[ends | (runs.first == 0) | (runs.last == ni - 1)]] = True
    return Spaces(volume, numbers, each_ml.astype(np.float64), hu, at_end[numbers], runs, components, mask)


def find_joints(mask: Mask, reach_mm: float, least_ml: float) -> Mask:
    """Choose what lies within a distance of two pieces of a mask that are apart and have some volume each."""
    device, shape = mask.device, mask.shape_ijk
    words = mask_bytes(shape)["mask of the voxels"]
    components = find_components(device, mask.bits, beside=3 * words, memory=mask.memory)
    joints = _write_components(mask, components, np.empty(0, np.intp), "joints")
    if components.count < 2:
        return joints
    runs = RunList.read(device, components, shape)
    large = np.flatnonzero(runs.sum_ml(mask.scan, components.count) >= least_ml)
    # Two pieces differ in at least one bit of their places in the list.
    for bit in range(max(len(large) - 1, 0).bit_length()):
        upper = (np.arange(len(large)) >> bit & 1) == 1
        sides = [_write_components(mask, components, large[side], "bones").dilate(reach_mm) for side in (upper, ~upper)]
        joints = joints | (sides[0] & sides[1])
        wait(device)  # the masks of commands that wait in the queue are all in memory
    return joints


def _open_ends(mask: Mask) -> NDArray[np.int32]:
    """Return i, j, k of a voxel of each run in the ends of the volume that a mask does not enclose there, (n, 3)."""
    ni, nj, nk = mask.shape_ijk
    words = download(mask.device, np.empty((nk, nj, -(-ni // 32)), "<u4"), mask._mask_d)
    rows = [(2, k, words[k]) for k in (0, nk - 1)] + [(1, j, np.ascontiguousarray(words[:, j])) for j in (0, nj - 1)]
    faces = [(axis, edge, np.unpackbits(row.view(np.uint8), 1, ni, "little")) for axis, edge, row in rows]
    faces += [(0, i, (words[:, :, i // 32] >> np.uint32(i % 32)) & 1) for i in (0, ni - 1)]
    ends = []
    for axis, edge, face in faces:
        is_open = find_open_places(face)
        if axis:  # the others of a run along i are in the same component
            is_open[:, 1:] &= ~is_open[:, :-1]
        ends.append(np.insert(np.stack(np.nonzero(is_open)[::-1], axis=1), axis, edge, axis=1))
    return np.concatenate(ends).astype(np.int32)


LEAST_SAID_ML = 0.1
"""Spaces that stay open are in a warning from this volume on; smaller ones are only in the report."""

SEAL_MM, LARGEST_SEAL_MM = 2.5, 3.0
"""Radius of the balls that close pores and vessels of the cortex, and the largest radius, for coarse voxels: at levels
of bone the thin cortex of vertebrae has openings of up to 5 mm.  Between centres of voxels the ball closes every pore
up to twice its radius less one step."""

_SEAL_STEPS = 1.25
"""The same radius in largest steps of the voxels: below one it would close nothing along that axis."""

_MOST_SEAL_STEPS, _SEAL_PARTS = 8.0, 7.0
"""Without a given radius the ball reaches at most so many largest steps of the voxels, and at most this part of the
side of a cube as large as the bone: small bones have small pores, and lie close together."""

BONE_ML, BONE_SHARE = 1.0, 0.05
"""Pieces from this volume on, or from this share of all bone, are separate bones: the space between two of them is a
joint."""

_MOST_CLOSED = 0.5
"""Largest share of a solid bone that the ball alone may close; bone with marrow of thin trabeculae has 0.33."""

LARGEST_MARROW_MM = 35.0
"""A ball of this radius fits into no marrow: the head of a femur has a radius of 20 to 29 mm, the skull of a newborn
more than 45 mm."""

SATURATED_HU, METAL_STEPS, METAL_SHARE = 3000.0, 2.0, 0.05
"""Filling up to `METAL_STEPS` radii of the ball away from values above `SATURATED_HU` is beside metal, in its joints or
the canals around it; a warning is given if this filling is more than the share `METAL_SHARE` of the solid body."""

AIR_LIMIT_HU = -200.0
"""A space whose mean is lower contains air: fat has -100 HU, air cells with thin walls have less than -400 HU."""


@explains_arguments
def fill_enclosed(
    volume: Volume | DeviceVolume,
    iso_value: float | Literal["auto"],
    *,
    seal_mm: float | None = None,
    largest_mm: float | None = LARGEST_MARROW_MM,
    keep_air: bool = True,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Any:
    """Return a volume in which what the voxels at a level and above enclose, as marrow, is above the level too.

    The voxels at the level and above are closed by a ball between the centres of voxels: every pore up to twice its
    radius less one step of the voxels is closed.  A space is enclosed where no way over faces of voxels leads from it
    to the border of the volume, or only to places of an end of the volume that are enclosed in that end's own slice:
    the canal of a long bone that the scan cuts.  From outside voxels become free again as deep as the ball's radius:
    grooves and mouths of pores keep their shape.  Between two bones nothing is closed: pieces apart stay so.

    No other voxel changes: where bone borders on what is outside, an iso surface of the result has the same vertices
    as one of ``volume``, bit for bit.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        Not changed.
    iso_value : float or "auto"
        HU; inside is ``>= iso_value``; "auto" is that of `choose_iso_value`, and ``report["solid"]`` says why.
    seal_mm : float, optional
        Radius of the ball, mm.  Below every step of the voxels it closes nothing.  None: 1.25 of the largest step, from
        2.5 to 3 mm, and less where voxels or bones are small: at most 8 steps, and a seventh of the side of a cube as
        large as the bone.
    largest_mm : float, optional
        A space into which a ball of this radius fits, or one smaller by up to a step of the voxels (at least 1 mm),
        stays open: no marrow is so thick, but the skull, the chest and the pelvis are.  None fills all.
    keep_air : bool
        True: a space that holds air stays open (sinuses, airways), unless what surrounds the bone is air too.
    device, memory, progress
        As for `Mask.from_band`; ``progress("solid", steps done, steps)``.

    Returns
    -------
    Volume or DeviceVolume
        As ``volume``. ``report["solid"]``: ``seal_mm``, ``closes_mm`` (width up to which every pore is closed),
        ``closed_ml`` (what the ball closed, of ``filled_ml``), ``metal_ml`` (what lies near metal), ``bone_ml``,
        ``filled_ml``, ``filled_share`` (of both together), ``filled_air_ml`` (cells with air that the ball closed),
        ``filled_hu`` (the value of what was filled: the mean of the bone), ``spaces`` (number of spaces filled that are
        wider than the ball), ``at_ends`` (of these, how many the ends of the volume cut), ``largest_ml``, and ``open``:
        for each kind (``wide``, ``air``) ``spaces``, ``ml``, ``largest_ml`` and ``at_mm``, LPS mm of a place in the
        largest; ``warnings`` say what stays open, and if more was filled than the bone itself has. ``report["gates"]``
        has ``closed_by_seal``: the ball closed at most half of the solid bone.

    Raises
    ------
    UsageError
        These are no Volume and no number, or a length is no number above 0.
    NoSurfaceError
        No voxel is inside, or every one is.
    DeviceError
        The device has no room for the masks, or it fails.
    """
    seal = None if seal_mm is None else checked_mm(seal_mm, "the radius that closes pores")
    largest = np.inf if largest_mm is None else checked_mm(largest_mm, "the radius of the thickest marrow")
    steps = Steps(progress, "solid", 5)
    with open_volume(volume, device, memory, "a solid body") as resident:
        scan = resident.volume
        level, chosen = settle_level(scan, iso_value)
        rule = choose_iso_rule(scan, level, values=resident.values)
        bone = Mask.from_band(resident, (float(rule.lowest_inside), np.inf))
        if not bone.count or bone.count == scan.voxels.size:
            lack = "no voxel has" if not bone.count else "every voxel has"
            low, high = scan.hu_range or (float(scan.voxels.min()), float(scan.voxels.max()))
            raise NoSurfaceError(f"{lack} {level:g} HU or more: {describe_range(scan, low, high)}")
        seal = seal or _default_seal(scan, bone)
        steps.take()
        filled = _fill_spaces(bone, (seal, largest, keep_air), float(rule.lowest_inside), steps)
        filled.report = amend(filled.report, solid=filled.report["solid"] | chosen)
        return resident.follow(filled) if isinstance(volume, DeviceVolume) else filled


def _default_seal(volume: Volume, bone: Mask) -> float:
    """Return the radius of the ball that fits voxels and bone, mm."""
    step, voxel_mm3 = max(volume.spacing), float(np.prod(volume.spacing))
    usual = float(np.clip(_SEAL_STEPS * step, SEAL_MM, LARGEST_SEAL_MM))
    bounds = _MOST_SEAL_STEPS * step, (bone.count * voxel_mm3) ** (1.0 / 3.0) / _SEAL_PARTS
    return max(min(usual, *bounds), min(_SEAL_STEPS * step, usual))


def _fill_spaces(bone: Mask, how: tuple[float, float, bool], lowest_inside: float, steps: Steps) -> Volume:
    """Fill what a mask encloses; `how`: radius of the seal, that of wide spaces, whether air stays."""
    volume = bone.scan
    seal_mm, largest_mm, keep_air = how
    # Near the ends of the volume no ball fits; there discs close what lies in the end slices themselves.
    sealed = bone.dilate(seal_mm).erode(seal_mm) | bone
    sealed = sealed | bone.dilate(seal_mm, by_slice=True).erode(seal_mm, by_slice=True)
    steps.take()
    spaces = find_spaces(sealed)
    steps.take()
    kinds = {"wide": spaces.are_wide(largest_mm), "air": np.zeros(spaces.count, bool)}
    airy = spaces.mean_hu < AIR_LIMIT_HU
    if keep_air and airy.any() and not _lies_in_air(bone, sealed, spaces, seal_mm):
        kinds["air"] = airy & ~kinds["wide"]
    left = kinds["wide"] | kinds["air"]
    body = sealed | spaces.choose(~left)
    room = body - bone
    solid_facts = {
        "spaces": int(np.count_nonzero(~left)),
        "at_ends": int(np.count_nonzero(spaces.at_ends & ~left)),
        "largest_ml": float(spaces.ml[~left].max(initial=0.0)),
        "open": {kind: spaces.describe(which) for kind, which in kinds.items()},
    }
    del spaces  # its runs take as much memory as the volume, where bone is spongy
    ml = slice_voxel_ml(volume)
    bone_ml = _measure_ml(bone, ml)
    joints = find_joints(bone, seal_mm, min(BONE_ML, BONE_SHARE * bone_ml)) & (sealed - bone)
    # what was closed only at the mouth of a pore, in a groove or in a joint is outside again
    filled = room - (~body | joints).dilate_within(room, seal_mm)
    steps.take()
    value = _mean_inside(volume, bone, lowest_inside)
    del room, body, joints
    result_pages.clear()  # of the masks that are gone: the new voxels take as much memory as the volume
    voxels, airy_count = np.empty_like(volume.voxels), np.zeros(len(volume.voxels), np.int64)
    for k, (layer, layer_mask) in enumerate(zip(volume.voxels, filled.layers(), strict=True)):
        voxels[k] = np.where(layer_mask, value, layer)
        airy_count[k] = np.count_nonzero(layer_mask & (layer < AIR_LIMIT_HU))
    steps.take()
    filled_ml, closed_ml = _measure_ml(filled, ml), _measure_ml(filled & sealed, ml)
    lattice = Lattice.of(volume)
    facts = {
        "seal_mm": seal_mm,
        "closes_mm": max(0.0, 2.0 * seal_mm - max(lattice.pixel, lattice.largest_gap)),
        "bone_ml": bone_ml,
        "filled_ml": filled_ml,
        "filled_share": filled_ml / (filled_ml + bone_ml),
        "closed_ml": closed_ml,
        "metal_ml": _filled_at_metal(bone, filled, METAL_STEPS * seal_mm, ml),
        "filled_air_ml": float(airy_count @ ml),
        "filled_hu": float(value),
        **solid_facts,
    }
    filled_volume = volume.with_voxels(voxels)
    report = volume.report
    if report.get("hu_range") is not None:
        report = amend(report, hu_range=filled_volume.report["hu_range"])
    share = closed_ml / (filled_ml + bone_ml)
    gate = at_most(
        "closed_by_seal", share, _MOST_CLOSED, None,
        f"share of the solid bone that the ball of {seal_mm:.3g} mm closed, not marrow that bone encloses"
        f" ({name_parameter('seal_mm', 'MM')}: a smaller ball)",
    )  # fmt: skip
    warnings = [*report.get("warnings", ()), *_warn_of_spaces(facts)]
    filled_volume.report = amend(report, solid=facts, warnings=warnings, gates=[*report.get("gates", ()), gate])
    return filled_volume


def _filled_at_metal(bone: Mask, filled: Mask, reach_mm: float, ml: NDArray[np.float64]) -> float:
    """Return how much of what was filled lies near metal, ml."""
    if float(bone.scan.voxels.max()) < SATURATED_HU:
        return 0.0
    metal = Mask.from_band(bone.scan, (SATURATED_HU, np.inf), device=bone.device, memory=bone.memory)
    return _measure_ml(filled & metal.dilate(reach_mm), ml)


def _measure_ml(mask: Mask, ml: NDArray[np.float64]) -> float:
    """Return the volume of a mask; `ml` is that of a voxel of each slice."""
    return float(np.array([np.count_nonzero(layer) for layer in mask.layers()]) @ ml)


def _lies_in_air(bone: Mask, sealed: Mask, spaces: Spaces, seal_mm: float) -> bool:
    """Tell whether most of what lies beside the bone, outside, is air, as round a specimen."""
    inner = sealed | spaces.choose(np.ones(spaces.count, bool))
    beside = bone.dilate(2.0 * max(seal_mm, float(np.max(bone.scan.spacing)))) - inner
    low = float(np.finfo(np.float32).min)
    air = Mask.from_band(bone.scan, (low, AIR_LIMIT_HU), device=bone.device, memory=bone.memory)
    return bool(2 * (beside & air).count > beside.count)


def _mean_inside(volume: Volume, bone: Mask, lowest_inside: float) -> Any:
    """Return the mean of the voxels inside, as a scalar of the voxels' type that is inside too."""
    pairs = zip(volume.voxels, bone.layers(), strict=True)
    total = sum(float(layer[own].sum(dtype=np.float64)) for layer, own in pairs)
    mean = max(total / bone.count, lowest_inside + 1.0)
    dtype = volume.voxels.dtype
    if dtype.kind == "f":
        return dtype.type(mean)
    return dtype.type(min(round(mean), int(np.iinfo(dtype).max)))


def _warn_of_spaces(facts: dict[str, Any]) -> list[str]:
    """Return what stays open, and whether more was filled than there is bone."""
    warnings = []
    for kind, phrase in (("wide", "too wide for marrow"), ("air", "air, as in sinuses and airways")):
        left = facts["open"][kind]
        if left["ml"] >= LEAST_SAID_ML:
            position = ", ".join(f"{x:.0f}" for x in left["at_mm"])
            several = f", the largest {format_ml(left['largest_ml'])}" if left["spaces"] > 1 else ""
            warnings.append(
                f"solid: {format_ml(left['ml'])} stay open in {count_of(left['spaces'], 'enclosed space')}"
                f" ({phrase}{several}, round {position} mm LPS)"
            )
    if not facts["filled_ml"]:
        warnings.append("solid: nothing is enclosed at this level, and nothing was filled")
    if facts["metal_ml"] > METAL_SHARE * (facts["filled_ml"] + facts["bone_ml"]):
        warnings.append(
            f"solid: {format_ml(facts['metal_ml'])} of the {format_ml(facts['filled_ml'])} that were filled lie beside"
            " metal, where joints and canals are narrow: look whether they should be open"
            f" ({name_parameter('seal_mm', 'MM')}: a smaller ball than {facts['seal_mm']:.3g} mm)"
        )
    if facts["filled_ml"] > facts["bone_ml"]:
        warnings.append(
            f"solid: {format_ml(facts['filled_ml'])} were filled, more than the {format_ml(facts['bone_ml'])}"
            " of the bone itself: see in a picture that it is marrow"
        )
    return warnings
