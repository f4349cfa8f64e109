"""What bone encloses is filled: known bodies, twins on any grid, and what must stay open."""

from __future__ import annotations

import enclosed_twin as twin
import numpy as np
import pytest
from refusals import refused
from surface_volumes import MIRRORED, OBLIQUE
from uneven_volume import uneven

import clrecon
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.operators.masks import enclosed
from clrecon.proof.phantom import PhantomSettings, make_phantom

TILTED = np.array([[0.6, 0.0, 0.0, -20.0], [0.0, 0.6, 0.4, 5.0], [0.0, 0.0, 1.4, 100.0], [0, 0, 0, 1.0]])


def distances(shape, centre=None):
    """Distance of each voxel from the centre, in voxels, shape (nk, nj, ni)."""
    centre = [(n - 1) / 2 for n in shape] if centre is None else centre
    return np.sqrt(sum((axis - middle) ** 2 for axis, middle in zip(np.indices(shape), centre, strict=True)))


def ball_ml(radius):
    """Of a radius in mm."""
    return 4 / 3 * np.pi * radius**3 / 1000


def shell_hu(distance, *, outer, inner, around=0, bone=800, within=50):
    """A shell with partial volume: its field is linear in the distance, over a voxel and a half at each wall."""
    wall = np.clip((outer - distance) / 1.5 + 0.5, 0, 1) * np.clip((distance - inner) / 1.5 + 0.5, 0, 1)
    return np.where(distance < (outer + inner) / 2, within + (bone - within) * wall, around + (bone - around) * wall)


def volume_of(values, spacing=(1.0, 1.0, 1.0)):
    return Volume(np.rint(values).astype(np.int16), np.diag([*spacing, 1.0]))


def added_voxels(volume, filled, level):
    """Voxels below the level that filling has raised to it."""
    return (filled.voxels >= level) & (volume.voxels < level)


@pytest.fixture(scope="module")
def pierced_sphere():
    """A shell about (24, 24, 24), from 15 to 20 mm, with a pore of one voxel right through its wall along x."""
    values = shell_hu(distances((49, 49, 49)), outer=20.0, inner=15.0)
    values[24, 24, 24:] = np.minimum(values[24, 24, 24:], 50)
    return volume_of(values)


@pytest.fixture(scope="module")
def filled_sphere(device, pierced_sphere):
    """The pierced sphere, filled by the default ball of 2.5 mm."""
    return clrecon.fill_enclosed(pierced_sphere, 400, device=device)


def inner_voxels(volume):
    """Voxels below the level within the middle of the shell."""
    return (distances(volume.voxels.shape) < 17) & (volume.voxels < 400)


def test_inside_of_a_hollow_sphere_with_a_pore_is_filled(pierced_sphere, filled_sphere):
    added = added_voxels(pierced_sphere, filled_sphere, 400)
    assert added[inner_voxels(pierced_sphere)].all()


def test_pore_of_a_hollow_sphere_is_filled_except_for_its_mouth(pierced_sphere, filled_sphere):
    is_open = (pierced_sphere.voxels < 400) & ~added_voxels(pierced_sphere, filled_sphere, 400)
    centre, outer_wall = 24, 24 + 20
    columns_of_the_mouth = centre + np.flatnonzero(is_open[centre, centre, centre:])  # k, j, i: the pore runs along i
    assert columns_of_the_mouth[0] == outer_wall - 3  # as deep as the ball of 2.5 mm that seals comes into it


def test_report_of_a_filled_sphere_tells_its_space_and_volume(pierced_sphere, filled_sphere):
    facts = filled_sphere.report["solid"]
    inside_ml = np.count_nonzero(inner_voxels(pierced_sphere)) / 1000  # voxels of 1 mm
    # What is filled of the pore beyond the middle of the wall is a voxel or two of 13,951; measured: none.
    assert facts["filled_ml"] == pytest.approx(inside_ml, rel=2e-4)
    assert (facts["spaces"], facts["at_ends"], facts["filled_air_ml"]) == (1, 0, 0)
    assert filled_sphere.report["warnings"] == []


def test_filling_leaves_all_other_voxels(pierced_sphere, filled_sphere):
    others = ~added_voxels(pierced_sphere, filled_sphere, 400)
    assert np.array_equal(filled_sphere.voxels[others], pierced_sphere.voxels[others])


@pytest.fixture(scope="module")
def solid_mesh(device, pierced_sphere):
    """The solid surface of the pierced sphere."""
    return clrecon.extract_isosurface(pierced_sphere, 400, solid=True, device=device)


def test_solid_surface_of_a_hollow_sphere_is_closed_and_has_the_volume_of_a_ball(solid_mesh):
    quality = solid_mesh.quality()
    assert (quality["closed"], quality["manifold"], quality["components"]) == (True, True, 1)
    assert quality["volume_ml"] == pytest.approx(ball_ml(20), rel=0.005)  # measured 0.0014


def test_solid_surface_of_a_hollow_sphere_keeps_the_vertices_of_its_outer_wall(device, pierced_sphere, solid_mesh):
    plain = clrecon.extract_isosurface(pierced_sphere, 400, device=device)
    beside_the_pore = np.hypot(*(solid_mesh.vertices[:, 1:] - 24).T) <= 3
    outer = (np.linalg.norm(solid_mesh.vertices - 24, axis=1) > 18.5) & ~beside_the_pore
    assert outer.mean() > 0.95  # measured 0.99
    assert set(map(tuple, solid_mesh.vertices[outer].tolist())) <= set(map(tuple, plain.vertices.tolist()))


def test_certificate_of_a_solid_surface_counts_the_spaces(solid_mesh):
    assert solid_mesh.report["certificate"]["solid"]["spaces"] == 1


@pytest.mark.parametrize("spacing", [(1.3, 1.3, 1.3), (0.9, 0.9, 1.4)])
@pytest.mark.parametrize("shift", np.random.default_rng(3).random((4, 3)).round(3).tolist())
def test_a_pore_of_the_reported_width_is_closed_at_each_of_four_shifts_by_a_part_of_a_voxel(device, spacing, shift):
    """A shell from 15 to 20 mm, shifted by a part of a voxel, with a pore as wide as twice the seal less a voxel."""
    shape, closes = [int(46 / step) for step in spacing[::-1]], 2 * 2.5 - max(spacing)
    z, y, x = (
        (axis - n / 2 + part) * step
        for axis, n, part, step in zip(np.indices(shape), shape, shift, spacing[::-1], strict=True)
    )
    away = np.sqrt(x**2 + y**2 + z**2)
    values = np.where((away < 20) & (away > 15), 800, 0)
    values[(np.hypot(y, z) <= closes / 2) & (x > 0)] = 0

    facts = clrecon.fill_enclosed(volume_of(values, spacing), 400, seal_mm=2.5, device=device).report["solid"]

    assert facts["closes_mm"] == pytest.approx(closes)
    assert facts["filled_ml"] == pytest.approx(ball_ml(15), rel=0.05)  # voxels of 1.3 mm


@pytest.mark.parametrize("beyond", [0.0, 1.0, 2.0])
def test_a_space_of_35_mm_and_more_stays_open(device, beyond):
    """As in a skull: marrow has no such space."""
    assert enclosed.LARGEST_MARROW_MM == 35.0
    inner = enclosed.LARGEST_MARROW_MM + beyond
    volume = volume_of(np.where(abs(distances((85, 85, 85)) - inner - 2) < 2, 800, 50))
    assert clrecon.fill_enclosed(volume, 400, device=device).report["solid"]["filled_ml"] == 0.0


FROM_AXIS = np.hypot(*(np.indices((24, 41, 41))[1:] - 20))  # mm
TUBE_HU = shell_hu(FROM_AXIS, outer=14.0, inner=10.0)
"""A tube through all 24 slices of a scan, with a canal of 10 mm."""


def test_a_canal_that_both_ends_of_the_scan_cut_is_filled(device):
    tube = volume_of(TUBE_HU)
    filled = clrecon.fill_enclosed(tube, 400, device=device)
    assert added_voxels(tube, filled, 400)[FROM_AXIS <= 9.5].all()  # 10 mm less half a voxel
    facts = filled.report["solid"]
    assert facts["at_ends"] == facts["spaces"] == 1
    assert facts["filled_ml"] == pytest.approx(np.pi * 10.0**2 * 24 / 1000, rel=0.03)  # whole voxels of 1 mm


@pytest.mark.parametrize("empty", [[0, 1, 2], [0, 1, 2, -3, -2, -1]], ids=["one end", "both ends"])
def test_a_canal_that_ends_in_the_scan_is_not_filled_and_warned_of(device, empty):
    short = TUBE_HU.copy()
    short[empty] = 0
    report = clrecon.fill_enclosed(volume_of(short), 400, device=device).report
    assert report["solid"]["filled_ml"] == 0.0
    assert report["warnings"] == ["solid: nothing is enclosed at this level, and nothing was filled"]


@pytest.mark.parametrize("axis", [0, 1, 2], ids="kji")
@pytest.mark.parametrize("end", ["first", "last"])
def test_a_space_that_one_end_of_the_scan_cuts_is_counted_at_an_end(device, axis, end):
    half = np.moveaxis(shell_hu(distances((31, 31, 31)), outer=11.0, inner=8.0)[15:], 0, axis)
    cut = np.flip(half, axis) if end == "last" else half
    facts = clrecon.fill_enclosed(volume_of(cut), 400, device=device).report["solid"]
    assert facts["at_ends"] == facts["spaces"] == 1


@pytest.fixture(scope="module")
def skull():
    """A shell of bone from 40 to 44 mm around voxel 46."""
    return volume_of(shell_hu(distances((93, 93, 93)), outer=44.0, inner=40.0))


SKULL_ML = ball_ml(40)


def test_a_space_too_wide_for_marrow_stays_open_and_is_warned_of(device, skull):
    report = clrecon.fill_enclosed(skull, 400, device=device).report
    assert report["solid"]["filled_ml"] == 0.0
    wide = report["solid"]["open"]["wide"]
    assert wide["spaces"] == 1
    assert wide["ml"] == pytest.approx(SKULL_ML, rel=0.01)  # measured 0.003
    first, _ = report["warnings"]  # the other: nothing was filled
    assert first.startswith(f"solid: {wide['ml']:.3g} ml stay open in 1 enclosed space (too wide for marrow, round ")


def test_place_of_a_space_too_wide_for_marrow_lies_within_it(device, skull):
    wide = clrecon.fill_enclosed(skull, 400, device=device).report["solid"]["open"]["wide"]
    assert np.linalg.norm(np.array(wide["at_mm"]) - 46) < 40  # mm, its radius, from the middle


def test_a_wide_space_is_filled_without_a_limit_with_a_warning(device, skull):
    report = clrecon.fill_enclosed(skull, 400, largest_mm=None, device=device).report
    assert report["solid"]["filled_ml"] == pytest.approx(SKULL_ML, rel=0.01)  # measured 0.003
    (warning,) = report["warnings"]
    assert "more than the" in warning and "of the bone itself" in warning


def test_a_wide_space_stays_open_where_the_end_of_the_scan_is_its_lid(device):
    cap = volume_of(shell_hu(distances((93, 93, 93)), outer=44.0, inner=40.0)[:30])  # cut 17 mm from the middle
    assert clrecon.fill_enclosed(cap, 400, device=device).report["solid"]["open"]["wide"]["spaces"] == 1


def test_a_space_of_29_mm_as_in_the_head_of_a_femur_is_not_too_wide(device):
    """Up to 35 mm: `LARGEST_MARROW_MM`."""
    head = volume_of(shell_hu(distances((69, 69, 69)), outer=32.0, inner=29.0))
    facts = clrecon.fill_enclosed(head, 400, device=device).report["solid"]
    assert facts["open"]["wide"]["spaces"] == 0
    assert facts["filled_ml"] == pytest.approx(ball_ml(29), rel=0.01)  # measured 0.005


def shell_with_air_inside(around: int) -> Volume:
    """A shell of 800 HU between 11 and 15 mm, with air in it, in surroundings of so many HU."""
    return volume_of(shell_hu(distances((41, 41, 41)), outer=15.0, inner=11.0, around=around, within=-950))


def test_air_in_bone_of_a_patient_stays_open_and_is_warned_of(device):
    soft_tissue = 40
    report = clrecon.fill_enclosed(shell_with_air_inside(soft_tissue), 400, device=device).report
    assert report["solid"]["filled_ml"] == 0.0
    air = report["solid"]["open"]["air"]
    assert air["spaces"] == 1
    assert np.linalg.norm(np.array(air["at_mm"]) - 20) < 11  # within the shell around voxel 20
    assert any("air, as in sinuses and airways" in text for text in report["warnings"])


@pytest.mark.parametrize(
    ("around", "options"), [(40, {"keep_air": False}), (-1000, {})], ids=["patient, on request", "dry bone"]
)
def test_air_in_bone_is_filled_on_request_and_in_a_dry_bone(device, around, options):
    facts = clrecon.fill_enclosed(shell_with_air_inside(around), 400, **options, device=device).report["solid"]
    assert facts["filled_ml"] == pytest.approx(ball_ml(11), rel=0.2)  # without the half voxels of partial volume
    assert facts["filled_ml"] > facts["filled_air_ml"] > 0.8 * facts["filled_ml"]  # measured 0.87 of it


def tubes(step, *bones):
    """Tubes along z, cut at both ends of the volume: the place of each axis and the radii of each wall, mm."""
    y, x = np.mgrid[:130, :230] * step
    layer = np.zeros(y.shape)
    for bone in bones:
        away = np.hypot(y - bone["y"], x - bone["x"])
        layer[away < bone["outer"]] = 50
        layer[(away < bone["outer"]) & (away >= bone["inner"])] = 800
    return volume_of(np.repeat(layer[None], 30, axis=0), (step,) * 3)


@pytest.fixture(scope="module")
def radius_and_ulna():
    """Canals of 50 HU in tubes at 0.1 mm; the bones are 1 mm apart, below 1 ml each."""
    radius = {"y": 6.5, "x": 7.0, "outer": 6.0, "inner": 5.0}
    ulna = {"y": 6.5, "x": 18.0, "outer": 4.0, "inner": 3.2}
    return tubes(0.1, radius, ulna)


def test_small_bones_are_filled_and_not_joined_by_default(device, radius_and_ulna):
    filled = clrecon.fill_enclosed(radius_and_ulna, 400, device=device)
    assert np.array_equal(added_voxels(radius_and_ulna, filled, 400), radius_and_ulna.voxels == 50)


def test_seal_of_small_bones_is_a_seventh_of_the_side_of_a_cube_of_their_volume(device, radius_and_ulna):
    facts = clrecon.fill_enclosed(radius_and_ulna, 400, device=device).report["solid"]
    assert facts["seal_mm"] == pytest.approx((1000 * facts["bone_ml"]) ** (1 / 3) / 7)


def test_small_bones_are_not_joined_by_a_ball_wider_than_their_gap(device, radius_and_ulna):
    coarser = clrecon.fill_enclosed(radius_and_ulna, 400, seal_mm=2.5, device=device)
    gap = slice(131, 139)  # columns, between 13.0 mm, where the first bone ends, and 14.0 mm
    assert not added_voxels(radius_and_ulna, coarser, 400)[..., gap].any()


@pytest.mark.parametrize(
    ("step", "radius", "seal_mm"),
    [
        (1.0, 20.0, 2.5),  # as for adults in a body scanner
        (2.2, 20.0, 2.75),  # 1.25 steps
        (0.1, 3.0, 0.545),  # a seventh of the side of a cube as large as the bone, 55 mm3
        (0.05, 3.0, 0.4),  # 8 steps
    ],
)
def test_the_default_seal_follows_voxels_and_bone(device, step, radius, seal_mm):
    size = int(2.4 * radius / step)
    volume = volume_of(np.where(abs(distances((size,) * 3) * step - 0.9 * radius) < 0.1 * radius, 800, 50), (step,) * 3)
    facts = clrecon.fill_enclosed(volume, 400, device=device).report["solid"]
    assert facts["seal_mm"] == pytest.approx(seal_mm, rel=0.002)  # bone in voxels of 0.1 mm; measured 0.001


@pytest.fixture(scope="module")
def lattice_of_rods():
    """Rods of one voxel, four apart, along all three axes."""
    k, j, i = np.indices((24, 24, 24))
    rods = sum((a % 4 < 1).astype(int) & (b % 4 < 1) for a, b in ((k, j), (j, i), (k, i))) > 0
    return volume_of(np.where(rods, 800, 50))


def seal_gate(report):
    (gate,) = [gate for gate in report["gates"] if gate["name"] == "closed_by_seal"]
    return gate


def test_a_ball_that_closes_more_than_half_of_the_bone_fails_a_gate(device, lattice_of_rods):
    report = clrecon.fill_enclosed(lattice_of_rods, 400, seal_mm=3.0, device=device).report
    gate, facts = seal_gate(report), report["solid"]
    assert gate["ok"] is False
    assert gate["measured"] > gate["bound"] == 0.5
    assert gate["measured"] == pytest.approx(facts["closed_ml"] / (facts["filled_ml"] + facts["bone_ml"]))
    assert "the ball of 3 mm closed" in gate["text"] and "seal_mm=MM: a smaller ball" in gate["text"]


def test_a_ball_smaller_than_the_gaps_passes_the_gate(device, lattice_of_rods):
    assert seal_gate(clrecon.fill_enclosed(lattice_of_rods, 400, seal_mm=0.5, device=device).report)["ok"] is True


def canal_with_a_stem(hardest):
    """A canal of 9 mm in bone of 12 mm, and in it a stem of 5 mm of so many HU."""
    k, j, i = np.indices((24, 30, 30))
    radius = np.hypot(j - 14.5, i - 14.5)
    hu = np.where(radius < 12, 800, 50)
    hu[(radius < 9) & (k > 3) & (k < 20)] = 50
    hu[(radius < 5) & (k < 18)] = hardest
    return volume_of(hu)


@pytest.mark.parametrize(("hardest", "is_metal"), [(3071, True), (1900, False)], ids=["metal", "bone"])
def test_filling_beside_metal_is_warned_of(device, hardest, is_metal):
    report = clrecon.fill_enclosed(canal_with_a_stem(hardest), 400, device=device).report
    facts = report["solid"]
    assert facts["filled_ml"] > 0.0
    assert (facts["metal_ml"] > 0.9 * facts["filled_ml"]) == is_metal  # measured all of it, and none
    warned = [text for text in report["warnings"] if "lie beside metal" in text]
    assert ["seal_mm=MM: a smaller ball than" in text for text in warned] == [True] * is_metal


def two_blocks():
    """Blocks of bone in rows and slices 5 to 24, columns 4 to 17 and 21 to 34: a joint of 3 mm."""
    k, j, i = np.indices((30, 30, 40))
    block = (k >= 5) & (k < 25) & (j >= 5) & (j < 25)
    return np.where(block & (((i >= 4) & (i < 18)) | ((i >= 21) & (i < 35))), 800, 0)


def test_two_bones_with_a_joint_between_them_are_not_joined(device):
    facts = clrecon.fill_enclosed(volume_of(two_blocks()), 400, device=device).report["solid"]
    assert facts["filled_ml"] == 0.0


def test_a_groove_of_one_bone_is_filled_at_its_bottom_alone(device):
    joined = two_blocks()
    joined[5:7, 5:25, 4:35] = 800  # one bone with a slit that is open on three sides
    volume = volume_of(joined)
    added = added_voxels(volume, clrecon.fill_enclosed(volume, 400, device=device), 400)
    assert added.any()
    reach = 3  # voxels of 1 mm that the ball of 2.5 mm reaches into the slit
    mouths = added[:, : 5 + reach], added[:, 25 - reach :], added[25 - reach :]
    assert not any(mouth.any() for mouth in mouths)


GRIDS = ["straight", "oblique", "mirrored", "tilted", "uneven", "one slice"]


def pieces_with_holes(grid: str) -> Volume:
    """Two thick pieces of bone above 75 HU with holes at random."""
    hu = np.random.default_rng(GRIDS.index(grid)).integers(0, 100, (6, 13, 34)).astype(np.int16)
    hu[1:5, 2:11, 3:16] += 60
    hu[1:5, 2:11, 19:31] += 45
    match grid:
        case "uneven":
            return uneven(hu)
        case "one slice":
            return Volume(hu[:1], OBLIQUE)
    return Volume(hu, {"straight": np.eye(4), "oblique": OBLIQUE, "mirrored": MIRRORED, "tilted": TILTED}[grid])


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("seal_mm", [0.3, 0.7, 1.5])
def test_filled_voxels_equal_the_twin(device, grid, seal_mm):
    volume = pieces_with_holes(grid)
    bone = volume.voxels >= 75
    filled = clrecon.fill_enclosed(volume, 75, seal_mm=seal_mm, largest_mm=None, keep_air=False, device=device)
    bone_ml = float(np.count_nonzero(bone, axis=(1, 2)) @ slice_voxel_ml(volume))
    least_ml = min(enclosed.BONE_ML, enclosed.BONE_SHARE * bone_ml)  # smaller pieces enclose nothing
    expected = twin.find_filled(volume, bone, seal_mm, bone_ml=least_ml)
    np.testing.assert_array_equal(added_voxels(volume, filled, 75), expected)


@pytest.mark.parametrize("grid", [grid for grid in GRIDS if grid != "one slice"])
def test_the_twin_fills_some_voxels_of_each_grid_of_several_slices(grid):
    volume = pieces_with_holes(grid)
    bone = volume.voxels >= 75
    bone_ml = float(np.count_nonzero(bone, axis=(1, 2)) @ slice_voxel_ml(volume))
    least_ml = min(enclosed.BONE_ML, enclosed.BONE_SHARE * bone_ml)
    assert twin.find_filled(volume, bone, seal_mm=0.3, bone_ml=least_ml).any()


def start_and_room(device, affine) -> tuple[clrecon.Mask, clrecon.Mask]:
    """Random masks of 2 and 60 % of a volume."""
    volume = Volume(np.zeros((6, 9, 40), np.int16), affine)
    start, room = np.random.default_rng(5).random((2, 6, 9, 40)) < [[[[0.02]]], [[[0.6]]]]
    start_mask, room_mask = (clrecon.Mask.from_array(volume, bits, device=device) for bits in (start, room))
    return start_mask, room_mask


@pytest.mark.parametrize("mm", [0.1, 0.7, 1.5, 4.0])
@pytest.mark.parametrize("affine", [np.eye(4), TILTED, OBLIQUE], ids=["straight", "tilted", "oblique"])
def test_masks_dilated_within_another_equal_the_twin(device, affine, mm):
    start, room = start_and_room(device, affine)
    expected = twin.dilate_within(start.scan, start.to_numpy(), room.to_numpy(), mm)
    np.testing.assert_array_equal(start.dilate_within(room, mm).to_numpy(), expected)


def test_masks_dilated_within_another_by_no_length_are_refused(device):
    start, room = start_and_room(device, np.eye(4))
    with refused(UsageError, "length", 0):
        start.dilate_within(room, 0)


@pytest.fixture(scope="module")
def vertebra():
    """A vertebra of the phantom, and its true volume in ml."""
    settings = PhantomSettings(levels="L2", size=(128, 128), spacing=(0.7, 0.7, 0.8))
    voxels, affine, _ = make_phantom(settings)
    true_ml = np.count_nonzero(clrecon.phantom_truth(settings).label_map()) * 0.7 * 0.7 * 0.8 / 1000
    return Volume(voxels, affine), float(true_ml)


@pytest.mark.release
@pytest.mark.parametrize(("level", "share_added"), [(226, 0.12), (300, 0.08), (350, 0.05)])
def test_a_solid_vertebra_is_as_large_as_its_truth_and_what_the_level_adds(device, vertebra, level, share_added):
    """Levels below 450 HU, half way to the cortex, lie farther out: by the shares that docs/inside.md has."""
    volume, true_ml = vertebra
    quality = clrecon.extract_isosurface(volume, level, solid=True, device=device).quality()
    assert quality["volume_ml"] == pytest.approx((1 + share_added) * true_ml, rel=0.02)
    assert (quality["closed"], quality["manifold"]) == (True, True)


@pytest.mark.release
@pytest.mark.parametrize("level", [226, 300, 350])
def test_a_vertebra_that_is_not_solid_lacks_more_than_a_quarter_of_its_volume(device, vertebra, level):
    volume, true_ml = vertebra
    assert clrecon.extract_isosurface(volume, level, device=device).quality()["volume_ml"] < 0.75 * true_ml


SHELL_HU = shell_hu(distances((41, 41, 41)), outer=15.0, inner=10.0)


@pytest.fixture(scope="module")
def shell_of_int16(device):
    """A shell of bone from 10 to 15 mm, and the voxels that are filled at 400 HU."""
    volume = volume_of(SHELL_HU)
    return volume, added_voxels(volume, clrecon.fill_enclosed(volume, 400, device=device), 400)


def test_voxels_of_float32_are_filled_as_those_of_int16(device, shell_of_int16):
    _, expected = shell_of_int16
    volume = Volume(SHELL_HU.astype(np.float32), np.eye(4))
    level = 399.5  # whole numbers of 400 and more are rounded from it
    assert np.array_equal(added_voxels(volume, clrecon.fill_enclosed(volume, level, device=device), level), expected)


def test_spaces_in_bone_of_the_highest_value_of_uint8_are_filled_with_that_value(device):
    highest = 255  # one more, as in spaces at other levels, would be 0
    volume = Volume(np.where(SHELL_HU >= 400, highest, 0).astype(np.uint8), np.eye(4))
    filled = clrecon.fill_enclosed(volume, highest, device=device)
    assert filled.report["solid"]["filled_hu"] == highest
    assert added_voxels(volume, filled, highest)[distances((41, 41, 41)) < 10].all()


def test_a_resident_volume_is_filled_as_one_of_the_host(device, shell_of_int16):
    volume, expected = shell_of_int16
    with clrecon.DeviceVolume(volume, device=device) as resident, clrecon.fill_enclosed(resident, 400) as filled:
        assert np.array_equal(added_voxels(volume, filled.volume, 400), expected)


def test_solid_surface_of_a_resident_volume_is_its_outer_wall_alone(device, shell_of_int16):
    volume, _ = shell_of_int16
    with clrecon.DeviceVolume(volume, device=device) as resident:
        mesh = clrecon.extract_isosurface(resident, 400, solid=True)
    assert mesh.quality()["components"] == 1


def test_progress_of_filling_is_told_from_0_to_5_steps(device, shell_of_int16):
    volume, _ = shell_of_int16
    told = []
    clrecon.fill_enclosed(volume, 400, device=device, progress=lambda *step: told.append(step))
    assert [step for step in told if step[0] == "solid"] == [("solid", done, 5) for done in range(6)]


SMALL_SHELL = volume_of(shell_hu(distances((21, 21, 21)), outer=8.0, inner=5.0))


@pytest.mark.parametrize(
    ("level", "facts"), [(2000, (2000, 0)), (-10, (-10,))], ids=["no voxel is bone", "all voxels are bone"]
)
def test_filling_at_a_level_without_a_surface_is_refused(device, level, facts):
    with refused(NoSurfaceError, *facts):
        clrecon.fill_enclosed(SMALL_SHELL, level, device=device)


@pytest.mark.parametrize("radius", [{"seal_mm": 0}, {"largest_mm": -1}])
def test_filling_by_a_radius_that_is_not_positive_is_refused(device, radius):
    (value,) = radius.values()
    with refused(UsageError, value, "radius"):
        clrecon.fill_enclosed(SMALL_SHELL, 400, **radius, device=device)


def test_filling_an_array_is_refused(device):
    with refused(UsageError, "Volume"):
        clrecon.fill_enclosed(SMALL_SHELL.voxels, 400, device=device)


@pytest.mark.parametrize(
    ("level", "options"), [(400, {"below": True}), ((100, 300), {})], ids=["below a level", "of a band"]
)
def test_solid_surfaces_below_a_level_or_of_a_band_are_refused(device, level, options):
    with refused(UsageError, "solid=True"):
        clrecon.extract_isosurface(SMALL_SHELL, level, solid=True, **options, device=device)


@pytest.mark.parametrize(
    ("bone", "level", "filled_hu"), [(800, 400, 800.0), (400, 400, 401.0)], ids=["mean", "at the level"]
)
def test_spaces_are_filled_with_the_mean_of_the_bone_or_just_over_the_level(device, bone, level, filled_hu):
    distance, outer, inner = distances((25, 25, 25)), 10, 6
    volume = volume_of(np.where((distance < outer) & (distance > inner), bone, 0))
    filled = clrecon.fill_enclosed(volume, level, device=device)
    assert filled.report["solid"]["filled_hu"] == filled_hu
    assert set(np.unique(filled.voxels[distance <= inner])) == {filled_hu}
