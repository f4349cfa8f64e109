"""The plan of the spine phantom, in mm about the centre of the volume, and how many slices chosen levels need.

Axes are the patient's: x to the left, y to the posterior, z to the superior."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom import spine_parts
from clrecon.proof.phantom.vertebra import body_extent, bone_extent, centring_shift, close_facets


def slice_directions(
    tilt_deg: float, oblique: tuple[float, float, float], prone: bool, gap_mm: float = 1.0
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the directions of a phantom's axes in the patient: unit vectors along i and j, LPS, and the slice step in
    mm, longer than the gap of the slices along their normal where the gantry is tilted.

    The frame is then rotated by `oblique` degrees (about_x, about_y, about_z); prone, rows and columns turn half round.
    """
    tilt = math.radians(tilt_deg)
    rotation = np.eye(3)
    for axis, angle in enumerate(oblique):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[first, second], [first, second]] = c
        turn[first, second], turn[second, first] = -s, s
        rotation = turn @ rotation
    if prone:
        rotation = rotation @ np.diag((-1.0, -1.0, 1.0))
    row = rotation @ (1.0, 0.0, 0.0)
    column = rotation @ (0.0, math.cos(tilt), -math.sin(tilt))
    return row, column, rotation @ (0.0, 0.0, gap_mm / math.cos(tilt))


_ROOM_MM = {f"T{n}": 3.0 for n in range(1, 7)}
"""Room between the articular processes of chosen levels, see `Vertebra.room`; 2 mm elsewhere."""


def _trabecular_waves(generator: np.random.Generator, steps_mm: Float64Array) -> Float64Array:
    """Plane waves of 2 to 6 mm, mostly across the vertical trabeculae, with unit variance before sampling.

    Each wave is damped as averaging over a voxel would damp it, so that coarse voxels show less texture and no aliases.
    """
    count = 14
    direction = generator.normal(size=(count, 3)) * (1.0, 1.0, 0.5)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    vectors = direction * (2.0 * math.pi / generator.uniform(2.0, 6.0, count))[:, None]
    damping = np.prod(np.sinc(vectors @ steps_mm / (2.0 * math.pi)), axis=1)
    phase = generator.uniform(0.0, 2.0 * math.pi, count)
    return np.column_stack((vectors, phase, math.sqrt(2.0 / count) * damping))


def _plan_rib(vertebra: spine_parts.Vertebra, side: int, half_width: float, half_depth: float) -> spine_parts.Rib:
    """Return the points of a rib from the costovertebral joint round the chest wall, sloping down to the front."""
    number = int(vertebra.name[1:])
    side_name = "left" if side > 0 else "right"
    wall_x, wall_y = half_width - 24.0, half_depth - 21.0
    canal_y = vertebra.depth / 2.0 + vertebra.canal_half_depth
    head = vertebra.to_patient((side * (vertebra.width / 2.0 + 2.0), vertebra.depth * 0.38, vertebra.height * 0.36))
    tubercle = vertebra.to_patient((side * (vertebra.canal_half_width + 23.0), canal_y + 7.0, vertebra.height * 0.30))
    start = math.degrees(math.asin(min(0.85, (abs(tubercle[0]) + 17.0) / wall_x)))
    end = {11: 95.0, 12: 62.0}.get(number, 152.0)
    angles = np.radians(np.linspace(start, max(end, start + 12.0), 26))
    wall = np.stack((side * wall_x * np.sin(angles), wall_y * np.cos(angles), np.zeros_like(angles)), axis=1)
    wall[:, 2] = tubercle[2] - 3.0 - 0.42 * (np.degrees(angles) - start)
    chain = np.vstack((head, tubercle, wall))
    # two passes of corner cutting round the bends at the tubercle and the angle of the rib
    for _ in range(2):
        cut = np.empty((2 * len(chain) - 2, 3))
        cut[0::2] = 0.75 * chain[:-1] + 0.25 * chain[1:]
        cut[1::2] = 0.25 * chain[:-1] + 0.75 * chain[1:]
        chain = np.vstack((chain[:1], cut, chain[-1:]))
    return spine_parts.Rib(f"{side_name} rib {number}", chain[:: 3 if len(chain) > 60 else 2])


def _plan_vertebrae(
    chain: spine_parts.Chain, generator: np.random.Generator, seed: int, steps_mm: Float64Array
) -> list[spine_parts.Vertebra]:
    neck = np.random.default_rng((seed, 19))
    return [
        spine_parts.Vertebra(
            name=name,
            center=chain.centres[n],
            axes=chain.frames[n],
            width=float(chain.sizes["width"][n]),
            depth=float(chain.sizes["depth"][n]),
            height=float(chain.sizes["height"][n]),
            canal_half_width=float(chain.sizes["canal_half_width"][n]),
            canal_half_depth=float(chain.sizes["canal_half_depth"][n]),
            lumbar=float(np.interp(n - (len(chain.names) - 17), (9, 12), (0.0, 1.0))),
            waves=_trabecular_waves(neck if name[0] == "C" else generator, chain.frames[n] @ steps_mm),
        )
        for n, name in enumerate(chain.names)
    ]


def _plan_ribs(
    vertebrae: list[spine_parts.Vertebra], moved: Float64Array, half_width: float, half_depth: float
) -> list[spine_parts.Rib]:
    ribs = []
    for vertebra, away in zip(vertebrae, moved, strict=True):
        for side in (1, -1):
            # the twelfth rib of the left side is absent: an image mirrored by mistake shows it absent on the right
            if vertebra.name[0] == "T" and (vertebra.name, side) != ("T12", 1):
                home = dataclasses.replace(vertebra, center=vertebra.center - away) if away.any() else vertebra
                rib = _plan_rib(home, side, half_width, half_depth)
                ribs.append(spine_parts.Rib(rib.name, rib.points + away) if away.any() else rib)
    return ribs


def plan_anatomy(
    field_of_view_mm: tuple[float, float, float],
    steps_mm: Float64Array,
    seed: int,
    choice: spine_parts.SpineChoice | None = None,
) -> spine_parts.Anatomy:
    """Lay out the phantom for a field of view, (width, depth, length) along columns, rows and slices.

    The body outline follows width and depth between the limits of a slim child and of an adult; bones keep their size.

    steps_mm: ndarray, shape (3, 3). Columns are the voxel steps in LPS mm.
    seed: Small changes of position and the phases of the texture.
    choice: None: T1 to L5, straight, T12 in the middle.
    """
    generator = np.random.default_rng((seed, 11))
    half_width = float(np.clip(min(0.45 * field_of_view_mm[0], 0.60 * field_of_view_mm[1]), 118.0, 160.0))
    half_depth = float(0.73 * half_width)
    chain = spine_parts.lay_chain(generator, seed, half_depth, choice)
    vertebrae = _plan_vertebrae(chain, generator, seed, steps_mm)
    if choice is not None:
        shown = [v for v in vertebrae if v.name in choice.levels]
        shift = centring_shift(shown, choice) if choice.centred else np.zeros(3)
        chain = dataclasses.replace(chain, centres=chain.centres + shift)
        vertebrae = [dataclasses.replace(v, center=v.center + shift, room=_ROOM_MM.get(v.name, 2.0)) for v in vertebrae]
    discs = []
    for upper, lower in zip(vertebrae[:-1], vertebrae[1:], strict=True):
        if upper.name == "C1":
            continue  # a joint without a disc
        gap = upper.center - lower.center
        length = float(np.linalg.norm(gap))
        axes = spine_parts.lean_and_roll(math.asin(gap[1] / length), math.asin(gap[0] / length))
        half = 0.515 * (upper.width + lower.width) / 2.0, 0.515 * (upper.depth + lower.depth) / 2.0
        discs.append(spine_parts.Disc((upper.center + lower.center) / 2.0, axes, half[0], half[1], length / 2.0))
    ribs = _plan_ribs(vertebrae, chain.moved, half_width, half_depth)
    z = chain.centres[:, 2] / 100.0
    outline = spine_parts.plan_outline(chain, half_width, half_depth)
    # On the skin of the left flank, or as far left as a small field of view still shows.
    left = min(half_width + 1.0, 0.42 * field_of_view_mm[0])
    marker = np.array((left, 0.0 if left < half_width else half_depth * 0.1, 0.0))
    if outline is not None:
        middle_x, middle_y, wide, _, _ = outline.at(np.zeros(1))
        marker = np.array((min(middle_x[0] + wide[0] + 1.0, 0.42 * field_of_view_mm[0]), middle_y[0], 0.0))
    anatomy = spine_parts.Anatomy(
        vertebrae=vertebrae,
        discs=discs,
        ribs=ribs,
        half_width=half_width,
        half_depth=half_depth,
        curve_x=np.polyfit(z, chain.centres[:, 0], 6),
        curve_y=np.polyfit(z, chain.centres[:, 1], 6),
        curve_z=(float(chain.centres[-1, 2]), float(chain.centres[0, 2])),
        marker=marker,
        marker_radius=float(max(3.0, 0.9 * np.linalg.norm(steps_mm, axis=0).max())),
        absent=["left rib 12"],
        centres=dict(zip(chain.names, chain.centres, strict=True)),
        outline=outline,
    )
    return anatomy if choice is None else _keep_chosen(anatomy, choice)


def _keep_chosen(anatomy: spine_parts.Anatomy, choice: spine_parts.SpineChoice) -> spine_parts.Anatomy:
    """Leave out what belongs to levels that are not chosen."""
    names = [v.name for v in anatomy.vertebrae]
    vertebrae = [v for v in anatomy.vertebrae if v.name in choice.levels]
    if choice.facet_gap_mm is not None:
        vertebrae = close_facets(vertebrae, choice.facet_gap_mm)
    pairs = [pair for pair in zip(names[:-1], names[1:], strict=True) if pair[0] != "C1"]
    both = [set(pair) <= set(choice.levels) for pair in pairs]
    ribs = [rib for rib in anatomy.ribs if f"T{rib.name.split()[-1]}" in choice.levels]
    return dataclasses.replace(
        anatomy,
        vertebrae=vertebrae,
        discs=[disc for disc, kept in zip(anatomy.discs, both, strict=True) if kept],
        ribs=ribs,
        absent=anatomy.absent if "T12" in choice.levels else [],
    )


MOST_SLICES = 9999


def spine_choice(
    levels: tuple[str, ...], bend: tuple[float, float], facet_gap_mm: float | None, *, centred: bool,
    directions: tuple[float, tuple[float, float, float], bool], length_mm: float | None,
) -> spine_parts.SpineChoice:  # fmt: skip
    """Return a choice, bent by (kyphosis, scoliosis), for slices of directions (tilt, oblique, prone) and a length."""
    row, column, _ = slice_directions(*directions)
    x, y, z = (float(value) for value in np.cross(row, column))
    return spine_parts.SpineChoice(levels, *bend, facet_gap_mm, centred, (x, y, z), length_mm)


def _reach(extent: tuple[float, float]) -> float:
    return 2.0 * max(abs(extent[0]), abs(extent[1]))


def fit_slices(
    choice: spine_parts.SpineChoice, size: tuple[int, int], spacing: tuple[float, float, float], seed: int,
    directions: tuple[float, tuple[float, float, float], bool], slices: int | None,
) -> int:  # fmt: skip
    """Return the number of slices: the given one, if it holds the vertebral bodies, else as many as the bones need."""
    dj, di, dk = spacing
    open_joints = dataclasses.replace(choice, facet_gap_mm=None)
    extent = size[0] * di, size[1] * dj
    anatomy = plan_anatomy((*extent, 0.0), np.diag((di, dj, dk)), seed, open_joints)
    shown: list[spine_parts.Vertebra] = anatomy.vertebrae
    named = f"levels {spine_parts.format_levels(choice.levels)}"
    whole = math.ceil(_reach(bone_extent(shown, choice.normal)) / dk)
    bodies = math.ceil(_reach(body_extent(shown, choice.normal)) / dk)
    row, column, _ = slice_directions(*directions)
    for noun, direction, available in (("columns", row, extent[0]), ("rows", column, extent[1])):
        needed = _reach(body_extent(shown, direction))
        if needed > available:
            raise UsageError(
                f"{named} do not fit: their bodies need {needed:.0f} mm of {noun}, there are {available:.0f} mm;"
                " take more pixels, larger ones or fewer levels"
            )
    if slices is not None:
        if bodies > slices:
            raise UsageError(
                f"{named} do not fit into {slices} slices of {dk:g} mm: their bodies need {bodies} slices, whole"
                f" vertebrae {whole}; name fewer levels, or leave the number of slices out"
            )
        return slices
    if whole > MOST_SLICES:
        raise UsageError(f"{named} need {whole} slices of {dk:g} mm: at most {MOST_SLICES} are possible")
    return whole
