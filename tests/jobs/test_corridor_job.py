"""``clrecon corridor``: figures against the truth of phantoms, files, given screws, and what is refused."""

from __future__ import annotations

import io
import json
import os
from contextlib import redirect_stdout
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
    return make_once(shared_folder, "phantom-of-corridors", lambda folder: write_phantom(folder, SETTINGS))


def test_the_bone_of_a_vertebra_ends_where_the_fitted_surface_lies(device: Any) -> None:
    vertebra = BoxVertebra()
    affine, shape = grid_around(vertebra, spacing=(1.0, 1.0, 1.0))
    volume, labels = vertebra.scan(affine, shape)
    with DeviceVolume(volume, device=device) as resident:
        mesh = fit_labels(resident, LabelMap(labels, affine), 150.0, 3)[3]
    bone = fill_vertebra(volume, labels, 3, 150.0, "L3", partial(lay_on_lattice, mesh))
    off = vertebra.depth(bone.surface)
    assert abs(np.median(off)) < 0.06 and np.abs(off).mean() < 0.12  # at the level 0.35
    assert bone.fitted and bone.by_hu.mean() > 0.95
    some = np.random.default_rng(1).integers(0, bone.solid.shape, (20_000, 3))
    depth, solid = vertebra.depth(bone.lattice.points(some)), bone.solid[tuple(some.T)]
    assert solid[depth > 0.5].mean() > 0.999 and solid[depth < -0.5].mean() < 0.001


def test_a_label_without_bone_beside_one_with_it_is_refused_in_words(tmp_path: Path, device: Any) -> None:
    voxels = hollow_ball(thickness=3.0).voxels.copy()
    numbers = (voxels > 190).astype(np.uint8)
    voxels[6:9, 6:9, -4:-1], numbers[6:9, 6:9, -4:-1] = 260, 2  # too little to be fitted
    write_nifti(tmp_path / "ct.nii", voxels, np.eye(4))
    write_nifti(tmp_path / "l.nii", numbers, np.eye(4))
    settings = CorridorSettings(labels=tmp_path / "l.nii", label=(1, 2), surface="cortex", device=str(device.index))
    with refused(NoSurfaceError, "label_2", "surface"):
        make_corridors(tmp_path / "ct.nii", settings)


@pytest.mark.release
def test_corridors_of_the_fitted_bone_are_those_of_the_truth(ct: Path, tmp_path: Path, device: Any) -> None:
    options = ("--labels", ct / "levels.nrrd", "--label", "L1", "--surface", "cortex", "--device", device.index)
    assert run(ct, *options, "-o", tmp_path / "l1.ply", "--report", tmp_path / "r.json") == 0
    report = load(tmp_path / "r.json")
    assert (report["surface"], report["iso_value_hu"]) == ("cortex", 200.0)
    for side in report["vertebrae"][0]["corridors"]:
        assert side["radius_mm"] == pytest.approx(true_radius_mm(side), abs=0.2)
        assert side["level_bias_mm"] is None and side["placed_by_hu_share"] > 0.9


def run(*arguments: object) -> int:
    return main([str(argument) for argument in ("corridor", *arguments)])


def load(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text()))


@pytest.fixture(scope="module")
def plain(ct: Path, shared_folder: Path) -> Path:
    """A folder with the report on L1 at 226 HU, and what was said."""
    options = ("--labels", ct / "levels.nrrd", "--label", "L1", "--hu", "226")
    return make_once(shared_folder, "corridors-plain", lambda folder: run_in(folder, ct, *options))


@pytest.fixture(scope="module")
def whole(ct: Path, plain: Path, shared_folder: Path) -> Path:
    """The same at the bone's own level in RAS, with meshes, a picture, and two screws along the plain corridors."""

    def make(folder: Path) -> None:
        left, right = load(plain / "report.json")["vertebrae"][0]["corridors"]
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
    scope="module", params=daily(1, [("whole", tolerances.CORRIDOR_HALF_MM), ("plain", tolerances.CORRIDOR_226_MM)])
)
def reported(request: pytest.FixtureRequest, device: Any) -> Any:
    """Report and words of a run, the signs from its frame to LPS, and how far its radius may be off."""
    name, bar = request.param
    folder: Path = request.getfixturevalue(name)
    report = load(folder / "report.json")
    return SimpleNamespace(
        name=name,
        bar=bar,
        report=report,
        said=(folder / "said.txt").read_text(),
        to_lps=np.array([-1.0, -1.0, 1.0]) if name == "whole" else np.ones(3),
        sides=report["vertebrae"][0]["corridors"],
    )


@pytest.mark.slow
def test_the_line_keeps_its_distance_in_the_truth(reported: Any) -> None:
    for side in reported.sides:
        assert abs(side["radius_mm"] - true_radius_mm(side, reported.to_lps)) <= reported.bar


@pytest.mark.slow
def test_a_corridor_of_a_phantom_enters_at_its_surface_from_behind(reported: Any) -> None:
    truth = phantom_truth(SETTINGS)
    for side in reported.sides:
        entry, counted_from, tip = (reported.to_lps * side[f"{at}_mm"] for at in ("entry", "counted_from", "tip"))
        assert abs(truth.signed_distance(entry[None])[0]) < 1.0
        assert entry[1] > counted_from[1] > tip[1]  # y grows to the back


@pytest.mark.slow
def test_radius_and_angles_of_a_phantom_are_those_of_a_pedicle(reported: Any) -> None:
    """Bounds that catch a wrong line or unit; the test above compares with the truth."""
    for side in reported.sides:
        assert 2.5 < side["radius_mm"] < 5.0
        assert 5.0 < side["medial_angle_deg"] < 20.0
        low, high = side["sagittal_angle_range_deg"]
        assert low <= side["sagittal_angle_deg"] <= high and high - low > 5.0
        assert side["level_bias_mm"]["rays"] > 60


@pytest.mark.slow
def test_the_left_corridor_lies_at_the_left_of_the_right_one(reported: Any) -> None:
    left, right = reported.sides
    assert left["side"] == "left"
    assert reported.to_lps[0] * left["entry_mm"][0] > reported.to_lps[0] * right["entry_mm"][0]


@pytest.mark.slow
def test_corridors_are_told_not_to_be_for_an_operation_and_what_is_not_known(reported: Any) -> None:
    notice = "not for planning an operation"
    assert notice in reported.said and reported.report["notice"].startswith(notice)
    assert "sagittal not determined" in reported.said
    assert "at 226 HU" in reported.said and "226 HU" in reported.report["level_bias"]


@pytest.mark.slow
def test_the_scale_of_grades_is_reported_with_screws_alone(reported: Any) -> None:
    assert (reported.report["grade_scale"] is not None) == (reported.name == "whole")  # `plain` has no screws


@pytest.mark.slow
def test_a_screw_wider_than_its_corridor_is_graded_b(whole: Path) -> None:
    wide, _ = load(whole / "report.json")["vertebrae"][0]["screws"]
    assert wide["grade"] == "B"
    assert 0.4 < wide["breach_mm"] < 1.1  # 1.5 mm wider than the corridor: 0.75 mm on each side
    assert wide["direction"] in ("medial", "lateral", "cranial", "caudal")


@pytest.mark.slow
def test_a_screw_within_the_right_corridor_is_graded_a(plain: Path, whole: Path) -> None:
    _, inner = load(whole / "report.json")["vertebrae"][0]["screws"]
    assert (inner["name"], inner["grade"], inner["side"]) == ("inner", "A", "right")
    right = load(plain / "report.json")["vertebrae"][0]["corridors"][1]
    np.testing.assert_allclose(np.multiply(inner["entry_mm"], (-1, -1, 1)), right["entry_mm"], atol=2e-3)  # from RAS


@pytest.mark.slow
def test_grades_of_screws_are_printed_with_their_scale(whole: Path) -> None:
    said = (whole / "said.txt").read_text()
    assert "grade B" in said and "grade A, no breach" in said and "Gertzbein-Robbins in five grades" in said


@pytest.mark.slow
def test_a_vertebra_its_corridors_and_screws_are_one_mesh_each(whole: Path) -> None:
    names = ["L1", "L1_left", "L1_right", "L1_screw_1", "L1_screw_2"]
    outputs = load(whole / "report.json")["outputs"]
    assert [output["name"] for output in outputs if output["kind"] == "mesh"] == names
    written = {path.name for path in whole.iterdir()}
    assert written == {*(f"l1_{name}.ply" for name in names), "l1.png", "report.json", "said.txt"}


def test_an_older_mesh_of_a_corridor_is_refused_with_no_clobber(ct: Path, tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "l1_L1.ply").write_text("mine")
    options = ("--labels", ct / "levels.nrrd", "--label", "L1", "-o", tmp_path / "l1.ply")
    assert run(ct, *options, "--no-clobber") == 6
    printed().assert_error("l1_L1.ply")


@pytest.mark.parametrize(("height", "rise"), [(0.0, 0.0), (1.0, 0.0), (0.0, 1e-12), (3.0, 0.0), (1.0, 5.0)])
def test_a_screw_across_its_corridor_is_drawn_where_it_meets_the_section(height: float, rise: float) -> None:
    """Its section in the plane square to the corridor is a circle, or two lines; none if the plane misses it."""
    volume = Volume(np.zeros((100, 100, 100), np.int16), np.eye(4))
    frame = VertebraFrame(np.full(3, 50.0), np.eye(3), (0.0, 20.0), (0.0, 0.0), 9.0, (-15.0, 15.0), 25.0)
    none = Corridor("left", "no room")
    found: Any = SimpleNamespace(name="L2", frame=frame, corridors=(none,))
    entry = np.array((56.0, 65.0 + height, 50.0))  # the section lies at y = 65
    screw = Screw(entry, entry + (20.0, -rise, 0.0), 4.0, "given")
    pixels = draw_corridors(volume, found, [screw], 1.0, []).image.astype(int)
    red = np.asarray((np.abs(pixels[..., :3] - GIVEN) <= 40).all(axis=2))
    third = pixels.shape[1] // 3
    assert red[:, :third].any()
    assert red[:, 2 * third :].any() == (height < 2.0)


def test_a_cylinder_is_closed_and_as_large_as_it_should_be() -> None:
    first, last = np.array([1.0, 2.0, 3.0]), np.array([4.0, 6.0, 15.0])
    mesh = cylinder_mesh(first, last, 2.0)
    quality = mesh.quality()
    assert quality.closed and quality.manifold
    assert quality.volume_ml == pytest.approx(np.pi * 4.0 * 13.0 / 1000.0, rel=4e-3)
    with_normals = mesh.vertices[mesh.triangles].astype(float)
    outward = np.cross(with_normals[:, 1] - with_normals[:, 0], with_normals[:, 2] - with_normals[:, 0])
    middle = with_normals.mean(axis=1) - (first + last) / 2.0
    assert ((outward * middle).sum(axis=1) > 0.0).all()


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
def test_wrong_arguments_end_in_one_line(
    ct: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: tuple[str, ...],
    code: int,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(ct, "--labels", ct / "levels.nrrd", *arguments) == code
    lines = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(lines) == 1 and said in lines[0]
    assert list(tmp_path.iterdir()) == []


def test_screws_come_from_json_and_csv(tmp_path: Path) -> None:
    table = tmp_path / "s.csv"
    table.write_text(
        "name,label,entry_x,entry_y,entry_z,tip_x,tip_y,tip_z,diameter\n,L3,1,2,3,4,5,16,6.5\nb,,1,2,3,4,5,26,7\n"
    )
    first, second = read_screws(table, "ras")
    assert (first.name, first.label, first.diameter) == ("screw 1", "L3", 6.5)
    assert (second.name, second.label) == ("b", None)
    np.testing.assert_allclose(first.entry, (-1.0, -2.0, 3.0))
    np.testing.assert_allclose(parse_screw("1,2,3,4,5,16,6", "lps").tip, (4.0, 5.0, 16.0))
    for text, said in (
        ("", "has no column entry_x"),
        ("[", "is no JSON"),
        ("[1]", "is no list of screws"),
        ("[]", "has 0 screws"),
        ('[{"entry": [1, 2], "tip": [1, 2, 3], "diameter": 5}]', "screw 1 of s.json has no three numbers"),
        ('[{"entry": [1, 2, "x"], "tip": [1, 2, 3], "diameter": 5}]', "screw 1 of s.json has no three numbers"),
        ('[{"entry": [0, 0, 0], "tip": [0, 0, 30], "diameter": null}]', "and a diameter"),
    ):
        path = tmp_path / "s.json"
        path.write_text(text)
        with pytest.raises(UsageError, match=said):
            read_screws(path, "lps")
    with pytest.raises(UsageError, match=r"the screws in gone.csv cannot be read"):
        read_screws(tmp_path / "gone.csv", "lps")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match=r"b.csv is no text"):
        read_screws(tmp_path / "b.csv", "lps")
