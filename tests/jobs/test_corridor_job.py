"""``clrecon corridor``: figures against the truth of phantoms, files, given screws, and what is refused."""

from __future__ import annotations

import io
import json
import os
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tolerances
from box_vertebra import BoxVertebra, grid_around
from label_files import write_nifti
from made_once import make_once
from printed_text import Printer
from refusals import refused
from surface_volumes import hollow_ball
from variants import daily

from clrecon.cli.main import main
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.corridor import lay_on_lattice, make_corridors, parse_screw, read_screws
from clrecon.jobs.corridor_results import GIVEN, cylinder_mesh, draw_corridors
from clrecon.jobs.settings import CorridorSettings
from clrecon.labels import LabelMap
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cortex_mesh import fit_labels
from clrecon.proof.phantom import PhantomSettings, phantom_truth, write_phantom
from clrecon.spine.corridors import Corridor
from clrecon.spine.frame import VertebraFrame
from clrecon.spine.measures import Screw
from clrecon.spine.solid_bone import fill_vertebra

pytestmark = pytest.mark.untraced
pytest.importorskip("nrrd")

SETTINGS = PhantomSettings(levels="L1-L2", size=(150, 150), spacing=(0.9, 0.9, 1.25), tilt=8.0, scoliosis_deg=20.0)


@pytest.fixture(scope="module")
def ct(shared_folder: Path) -> Path:
    """The folder of a CT of L1 and L2 with their labels, levels.nrrd."""
    return make_once(shared_folder, "phantom-of-corridors", lambda folder: write_phantom(folder, SETTINGS))


@dataclass
class FittedVertebra:
    """The box vertebra of label 3, its solid bone on a lattice, and points of the lattice with their depth in mm."""

    vertebra: BoxVertebra
    bone: Any
    places: np.ndarray
    depth_mm: np.ndarray


@pytest.fixture(scope="module")
def fitted_vertebra(device: Any) -> FittedVertebra:
    vertebra, number, level_hu = BoxVertebra(), 3, 150.0
    affine, shape = grid_around(vertebra, spacing=(1.0, 1.0, 1.0))
    volume, labels = vertebra.scan(affine, shape)
    with DeviceVolume(volume, device=device) as resident:
        mesh = fit_labels(resident, LabelMap(labels, affine), level_hu, number)[number]
    bone = fill_vertebra(volume, labels, number, level_hu, subject="L3", fitted=partial(lay_on_lattice, mesh))
    places = np.random.default_rng(1).integers(0, bone.solid.shape, (20_000, 3))
    return FittedVertebra(vertebra, bone, places, vertebra.depth(bone.lattice.points(places)))


def test_surface_of_the_bone_of_a_vertebra_is_fitted_within_a_fraction_of_a_voxel(
    fitted_vertebra: FittedVertebra,
) -> None:
    off_mm = fitted_vertebra.vertebra.depth(fitted_vertebra.bone.surface)

    # Measured 0.014 inside of it, though all walls of the box are alike and their HU are a range; at 150 HU it is 0.35.
    assert abs(np.median(off_mm)) < 0.05
    assert np.abs(off_mm).mean() < 0.05  # measured 0.019


def test_most_of_the_surface_of_the_bone_is_placed_by_hu(fitted_vertebra: FittedVertebra) -> None:
    assert fitted_vertebra.bone.fitted
    assert fitted_vertebra.bone.by_hu.mean() > 0.99  # measured 1


def test_bone_of_a_vertebra_is_solid_to_half_a_mm_from_its_surface(fitted_vertebra: FittedVertebra) -> None:
    solid = fitted_vertebra.bone.solid[tuple(fitted_vertebra.places.T)]
    inside, outside = fitted_vertebra.depth_mm > 0.5, fitted_vertebra.depth_mm < -0.5

    assert solid[inside].all()
    assert not solid[outside].any()


def test_label_with_too_little_bone_to_be_fitted_is_refused_with_its_name(tmp_path: Path, device: Any) -> None:
    voxels = hollow_ball(thickness=3.0).voxels.copy()
    numbers = (voxels > 190).astype(np.uint8)
    voxels[6:9, 6:9, -4:-1], numbers[6:9, 6:9, -4:-1] = 260, 2  # 27 voxels: 54 vertices
    write_nifti(tmp_path / "ct.nii", voxels, np.eye(4))
    write_nifti(tmp_path / "l.nii", numbers, np.eye(4))
    settings = CorridorSettings(labels=tmp_path / "l.nii", label=(1, 2), surface="cortex", device=str(device.index))

    with refused(NoSurfaceError, "label_2", "surface", 54, 100):  # of which so many are needed
        make_corridors(tmp_path / "ct.nii", settings)


@pytest.mark.release
def test_corridors_of_bone_with_a_fitted_surface_have_the_radius_of_the_truth(
    ct: Path, tmp_path: Path, device: Any
) -> None:
    options = ("--labels", ct / "levels.nrrd", "--label", "L1", "--surface", "cortex", "--device", device.index)

    assert run(ct, *options, "-o", tmp_path / "l1.ply", "--report", tmp_path / "r.json") == 0

    report = load(tmp_path / "r.json")
    assert (report["surface"], report["iso_value_hu"]) == ("cortex", 200.0)
    (vertebra,) = report["vertebrae"]
    for side in vertebra["corridors"]:
        assert side["radius_mm"] == pytest.approx(true_radius_mm(side), abs=0.05)  # measured 0.016
        assert side["level_bias_mm"] is None  # there is no level
        assert side["placed_by_hu_share"] > 0.99  # measured 1


def run(*arguments: object) -> int:
    """Run ``clrecon corridor`` with these arguments; return the exit code."""
    return main([str(argument) for argument in ("corridor", *arguments)])


def load(path: Path) -> dict[str, Any]:
    """Read a report."""
    return dict(json.loads(path.read_text()))


@pytest.fixture(scope="module")
def l1_at_226_hu(ct: Path, shared_folder: Path) -> Path:
    """A folder with the report on L1 at 226 HU, and what was said."""
    options = ("--labels", ct / "levels.nrrd", "--label", "L1", "--hu", "226")
    return make_once(shared_folder, "corridors-l1_at_226_hu", lambda folder: run_in(folder, ct, *options))


@pytest.fixture(scope="module")
def l1_with_screws(ct: Path, l1_at_226_hu: Path, shared_folder: Path) -> Path:
    """The same at the bone's own level in RAS, with meshes, a picture, and two screws along those corridors."""

    def make(folder: Path) -> None:
        left, right = load(l1_at_226_hu / "report.json")["vertebrae"][0]["corridors"]
        entry, tip = ([*(-x for x in left[name][:2]), left[name][2]] for name in ("entry_mm", "tip_mm"))
        given = ",".join(map(str, (*entry, *tip, round(2.0 * true_radius_mm(left) + 1.5, 2))))
        ends = {name: [*(-x for x in right[f"{name}_mm"][:2]), right[f"{name}_mm"][2]] for name in ("entry", "tip")}
        screws = folder.with_name("screws.json")
        screws.write_text(json.dumps({"screws": [{"name": "inner", **ends, "diameter": 3.0, "label": "L1"}]}))
        options = ("--labels", ct / "levels.nrrd", "--label", "L1", "--space", "ras")
        outputs = ("-o", folder / "l1.ply", "--picture", folder / "l1.png")
        device = os.environ.get("CLRECON_TEST_DEVICE", "") or "0"
        run_in(folder, ct, *options, *outputs, "--screw", given, "--screws", screws, "--device", device)

    return make_once(shared_folder, "corridors-whole", make)


def true_radius_mm(side: dict[str, Any], to_lps: Any = (1.0, 1.0, 1.0)) -> float:
    """How far the line of a corridor is from the true surface where it is nearest."""
    start, tip = (np.multiply(to_lps, side[name]) for name in ("counted_from_mm", "tip_mm"))
    line = np.linspace(start, tip, 60)
    return float(-phantom_truth(SETTINGS).signed_distance(line).max())


def run_in(folder: Path, *arguments: object) -> None:
    """Run the command with a report into a new folder, and keep what it says beside it."""
    folder.mkdir()
    said = io.StringIO()
    with redirect_stdout(said):
        assert run(*arguments, "--report", folder / "report.json") == 0
    (folder / "said.txt").write_text(said.getvalue())


@pytest.fixture(
    scope="module",
    params=daily(1, [("l1_with_screws", tolerances.CORRIDOR_HALF_MM), ("l1_at_226_hu", tolerances.CORRIDOR_226_MM)]),
)
def reported(request: pytest.FixtureRequest, device: Any) -> Any:
    """Report and words of a run, the signs from its frame to LPS, and how far its radius may be off."""
    name, bar = request.param
    folder: Path = request.getfixturevalue(name)
    report = load(folder / "report.json")
    (vertebra,) = report["vertebrae"]
    left, right = vertebra["corridors"]
    return SimpleNamespace(
        name=name,
        bar=bar,
        report=report,
        said=(folder / "said.txt").read_text(),
        to_lps=np.array([-1.0, -1.0, 1.0]) if name == "l1_with_screws" else np.ones(3),
        sides=(left, right),
    )


@pytest.mark.slow
def test_radius_of_a_corridor_is_the_distance_of_its_line_from_the_true_surface(reported: Any) -> None:
    for side in reported.sides:
        assert abs(side["radius_mm"] - true_radius_mm(side, reported.to_lps)) <= reported.bar


@pytest.mark.slow
def test_corridor_enters_at_the_true_surface_and_runs_from_back_to_front(reported: Any) -> None:
    truth = phantom_truth(SETTINGS)
    for side in reported.sides:
        entry, counted_from, tip = (reported.to_lps * side[f"{at}_mm"] for at in ("entry", "counted_from", "tip"))
        assert abs(truth.signed_distance(entry[None])[0]) < 1.0  # a voxel
        assert entry[1] > counted_from[1] > tip[1]  # y grows to the back


@pytest.mark.slow
def test_corridor_has_the_radius_and_angles_of_a_lumbar_pedicle(reported: Any) -> None:
    """Bounds that catch a wrong line or unit; the radius is compared with the truth in a test of its own."""
    for side in reported.sides:
        assert 2.5 < side["radius_mm"] < 5.0
        assert 5.0 < side["medial_angle_deg"] < 20.0
        lowest, highest = side["sagittal_angle_range_deg"]
        assert lowest <= side["sagittal_angle_deg"] <= highest
        assert highest - lowest > 5.0  # a line may turn within a pedicle higher than wide


@pytest.mark.slow
def test_bias_of_the_level_is_estimated_from_many_rays(reported: Any) -> None:
    assert min(side["level_bias_mm"]["rays"] for side in reported.sides) > 60  # measured 118


@pytest.mark.slow
def test_left_corridor_lies_at_the_left_of_the_right_one(reported: Any) -> None:
    left, right = reported.sides

    assert (left["side"], right["side"]) == ("left", "right")
    assert reported.to_lps[0] * left["entry_mm"][0] > reported.to_lps[0] * right["entry_mm"][0]  # x of LPS grows so


@pytest.mark.slow
def test_words_and_report_say_that_corridors_are_not_for_planning_an_operation(reported: Any) -> None:
    notice = "not for planning an operation"
    assert notice in reported.said
    assert reported.report["notice"].startswith(notice)


@pytest.mark.slow
def test_words_and_report_name_what_a_corridor_does_not_determine_and_the_bias_at_226_hu(reported: Any) -> None:
    assert "sagittal not determined" in reported.said
    assert "at 226 HU" in reported.said
    assert "226 HU" in reported.report["level_bias"]


@pytest.mark.slow
def test_scale_of_grades_is_reported_where_screws_are_given(l1_with_screws: Path) -> None:
    assert load(l1_with_screws / "report.json")["grade_scale"] is not None


@pytest.mark.slow
def test_scale_of_grades_is_not_reported_without_screws(l1_at_226_hu: Path) -> None:
    assert load(l1_at_226_hu / "report.json")["grade_scale"] is None


@pytest.mark.slow
def test_screw_wider_than_its_corridor_by_one_and_a_half_mm_is_graded_b_with_its_breach(l1_with_screws: Path) -> None:
    wide, _ = load(l1_with_screws / "report.json")["vertebrae"][0]["screws"]

    assert wide["grade"] == "B"
    on_each_side_mm = 1.5 / 2
    assert wide["breach_mm"] == pytest.approx(on_each_side_mm, abs=0.35)  # the reported radius of its line
    assert wide["direction"] in ("medial", "lateral", "cranial", "caudal")


@pytest.mark.slow
def test_screw_within_the_right_corridor_is_graded_a_at_its_given_entry(
    l1_at_226_hu: Path, l1_with_screws: Path
) -> None:
    _, inner = load(l1_with_screws / "report.json")["vertebrae"][0]["screws"]

    assert (inner["name"], inner["grade"], inner["side"]) == ("inner", "A", "right")
    _, right = load(l1_at_226_hu / "report.json")["vertebrae"][0]["corridors"]
    entry_lps = np.multiply(inner["entry_mm"], (-1, -1, 1))  # from RAS
    np.testing.assert_allclose(entry_lps, right["entry_mm"], atol=2e-3)  # reports have 3 decimals


@pytest.mark.slow
def test_grades_of_screws_are_printed_with_their_scale(l1_with_screws: Path) -> None:
    said = (l1_with_screws / "said.txt").read_text()
    assert "grade B" in said
    assert "grade A, no breach" in said
    assert "Gertzbein-Robbins in five grades" in said


@pytest.mark.slow
def test_vertebra_corridors_and_screws_are_written_as_one_mesh_each(l1_with_screws: Path) -> None:
    names = ["L1", "L1_left", "L1_right", "L1_screw_1", "L1_screw_2"]

    outputs = load(l1_with_screws / "report.json")["outputs"]

    assert [output["name"] for output in outputs if output["kind"] == "mesh"] == names
    written = {path.name for path in l1_with_screws.iterdir()}
    assert written == {*(f"l1_{name}.ply" for name in names), "l1.png", "report.json", "said.txt"}


def test_an_older_mesh_of_a_corridor_is_refused_with_no_clobber(ct: Path, tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "l1_L1.ply").write_text("mine")
    options = ("--labels", ct / "levels.nrrd", "--label", "L1", "-o", tmp_path / "l1.ply")
    assert run(ct, *options, "--no-clobber") == 6
    printed().assert_error("l1_L1.ply")


@pytest.mark.parametrize(
    ("above_mm", "fall_mm"),
    [(0.0, 0.0), (1.0, 0.0), (0.0, 1e-12), (3.0, 0.0), (1.0, 5.0)],
    ids=["along the section", "1 mm beside it", "nearly along it", "3 mm beside it", "through it"],
)
def test_screw_across_its_corridor_is_drawn_in_the_section_that_it_meets(above_mm: float, fall_mm: float) -> None:
    """The plane square to the corridor cuts a screw of radius 2 mm in a circle or two lines, or misses it."""
    volume = Volume(np.zeros((100, 100, 100), np.int16), np.eye(4))
    frame = VertebraFrame(
        origin=np.full(3, 50.0), axes=np.eye(3), canal=(0.0, 20.0), canal_lean=(0.0, 0.0), canal_radius=9.0,
        body_y=(-15.0, 15.0), body_height=25.0,
    )  # fmt: skip
    none = Corridor("left", refused="no room")
    found: Any = SimpleNamespace(name="L2", frame=frame, corridors=(none,))
    section_y, radius_mm = 65.0, 2.0
    entry = np.array((56.0, section_y + above_mm, 50.0))
    screw = Screw(entry, tip=entry + (20.0, -fall_mm, 0.0), diameter=2 * radius_mm)

    pixels = draw_corridors(volume, found, [screw], margin=1.0, footer=[]).image.astype(int)

    is_screw = np.asarray((np.abs(pixels[..., :3] - GIVEN) <= 40).all(axis=2))  # of 255: smoothed edges
    third = pixels.shape[1] // 3
    along_the_corridor, section = is_screw[:, :third], is_screw[:, 2 * third :]
    assert along_the_corridor.any()
    assert section.any() == (above_mm < radius_mm)


def test_cylinder_mesh_is_closed_and_outward_with_the_volume_of_a_cylinder() -> None:
    first, last, radius_mm = np.array([1.0, 2.0, 3.0]), np.array([4.0, 6.0, 15.0]), 2.0
    length_mm = 13.0  # of (3, 4, 12)

    mesh = cylinder_mesh(first, last, radius_mm)

    quality = mesh.quality()
    assert quality.closed and quality.manifold
    # A prism of 48 sides has 0.3 % less: sin(2 pi / 48) / (2 pi / 48).
    assert quality.volume_ml == pytest.approx(np.pi * radius_mm**2 * length_mm / 1000.0, rel=4e-3)
    corners = mesh.vertices[mesh.triangles].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    from_middle = corners.mean(axis=1) - (first + last) / 2.0
    assert ((normals * from_middle).sum(axis=1) > 0.0).all()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ((), 3, "name the vertebrae: --label L3"),
        (("--label", "L5"), 3, "label 'L5' is not in the label map; there are: 20 L1, 21 L2"),
        (("--label", "L1", "--margin", "9"), 3, "the margin is a length from 0 to 5 mm, not 9"),
        (("--label", "L1", "--hu", "150,300"), 3, "argument --hu: it is one level or auto"),
        (("--label", "L1", "--hu", "bone"), 3, "'bone' is no number of HU"),
        (("--label", "L1", "--screw", "1,2,3"), 3, "a screw is entry, tip and diameter in mm, X,Y,Z,X,Y,Z,D"),
        (("--label", "L1", "-o", "x.doc"), 3, ".doc"),
        (("--label", "L1", "--picture", "x.gif"), 3, "the picture file has the extension '.gif'"),
        (("--label", "L1", "--space", "xyz"), 3, "unknown space 'xyz'"),
        (("--label", "L1", "--hu", "3000"), 4, "no voxel of L1 has 3000 HU or more"),
    ],
)
def test_wrong_arguments_of_corridor_are_refused_in_one_line_and_write_nothing(
    ct: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
    arguments: tuple[str, ...], code: int, said: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)

    assert run(ct, "--labels", ct / "levels.nrrd", *arguments) == code

    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert said in line
    assert list(tmp_path.iterdir()) == []


def test_screws_of_a_csv_in_ras_are_read_in_lps_with_name_label_and_diameter(tmp_path: Path) -> None:
    table = tmp_path / "s.csv"
    table.write_text(
        "name,label,entry_x,entry_y,entry_z,tip_x,tip_y,tip_z,diameter\n,L3,1,2,3,4,5,16,6.5\nb,,1,2,3,4,5,26,7\n"
    )

    first, second = read_screws(table, "ras")

    assert (first.name, first.label, first.diameter) == ("screw 1", "L3", 6.5)
    assert (second.name, second.label, second.diameter) == ("b", None, 7.0)
    np.testing.assert_allclose(first.entry, (-1.0, -2.0, 3.0))


def test_screw_of_an_option_has_its_entry_tip_and_diameter() -> None:
    screw = parse_screw("1,2,3,4,5,16,6", "lps")

    np.testing.assert_allclose(screw.entry, (1.0, 2.0, 3.0))
    np.testing.assert_allclose(screw.tip, (4.0, 5.0, 16.0))
    assert screw.diameter == 6.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        pytest.param("", "has no column entry_x", id="empty"),
        pytest.param("[", "is no JSON", id="broken JSON"),
        pytest.param("[1]", "is no list of screws", id="a number"),
        pytest.param("[]", "has 0 screws", id="no screw"),
        pytest.param(
            '[{"entry": [1, 2], "tip": [1, 2, 3], "diameter": 5}]',
            "screw 1 of s.json has no three numbers",
            id="two coordinates",
        ),
        pytest.param(
            '[{"entry": [1, 2, "x"], "tip": [1, 2, 3], "diameter": 5}]',
            "screw 1 of s.json has no three numbers",
            id="a letter",
        ),
        pytest.param('[{"entry": [0, 0, 0], "tip": [0, 0, 30], "diameter": null}]', "and a diameter", id="no diameter"),
    ],
)
def test_wrong_file_of_screws_is_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "s.json"
    path.write_text(text)
    with pytest.raises(UsageError, match=said):
        read_screws(path, "lps")


def test_missing_file_of_screws_is_refused(tmp_path: Path) -> None:
    with refused(UsageError, "gone.csv"):
        read_screws(tmp_path / "gone.csv", "lps")


def test_file_of_screws_that_is_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00")
    with refused(UsageError, "b.csv", "text"):
        read_screws(tmp_path / "b.csv", "lps")
