"""``clrecon corridor``: figures against the truth of phantoms, files, given screws, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tolerances
from made_once import make_once

from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.jobs.corridor import parse_screw, read_screws
from clrecon.jobs.corridor_results import GIVEN, cylinder_mesh, draw_corridors
from clrecon.proof.phantom import PhantomSettings, phantom_truth, write_phantom
from clrecon.spine.corridors import Corridor
from clrecon.spine.frame import VertebraFrame
from clrecon.spine.measures import Screw

pytestmark = pytest.mark.untraced
pytest.importorskip("nrrd")

SETTINGS = PhantomSettings(levels="L1-L2", size=(150, 150), spacing=(0.9, 0.9, 1.25), tilt=8.0, scoliosis_deg=20.0)


@pytest.fixture(scope="module")
def ct(shared_folder: Path) -> Path:
    return make_once(shared_folder, "phantom-of-corridors", lambda folder: write_phantom(folder, SETTINGS))


def run(*arguments: object) -> int:
    return main([str(argument) for argument in ("corridor", *arguments)])


def load(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text()))


@pytest.mark.parametrize(("level", "bar"), [("auto", tolerances.CORRIDOR_HALF_MM), ("226", tolerances.CORRIDOR_226_MM)])
def test_the_line_keeps_its_distance_in_the_truth(
    ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], level: str, bar: float
) -> None:
    report_path = tmp_path / "r.json"
    assert run(ct, "--labels", ct / "levels.nrrd", "--label", "L1", "--hu", level, "--report", report_path) == 0
    said = capsys.readouterr().out
    assert "not for planning an operation" in said and "sagittal not determined" in said and "at 226 HU" in said
    report = load(report_path)
    assert report["notice"].startswith("not for planning an operation")
    assert "226 HU" in report["level_bias"] and report["grade_scale"] is None
    truth = phantom_truth(SETTINGS)
    (vertebra,) = report["vertebrae"]
    for side in vertebra["corridors"]:
        line = np.linspace(side["counted_from_mm"], side["tip_mm"], 60)
        true = float(-truth.signed_distance(line).max())
        assert abs(side["radius_mm"] - true) <= bar
        assert 2.5 < side["radius_mm"] < 5.0
        assert 5.0 < side["medial_angle_deg"] < 20.0
        low, high = side["sagittal_angle_range_deg"]
        assert low <= side["sagittal_angle_deg"] <= high and high - low > 5.0
        assert side["level_bias_mm"]["rays"] > 60
        on_surface = truth.signed_distance(np.array([side["entry_mm"]]))[0]
        assert abs(on_surface) < 1.0
        assert side["entry_mm"][1] > side["counted_from_mm"][1] > side["tip_mm"][1]
    left, right = vertebra["corridors"]
    assert left["side"] == "left" and left["entry_mm"][0] > right["entry_mm"][0]


def test_files_are_written_and_screws_graded(
    device: Any, ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = tmp_path / "first.json"
    options = (ct, "--labels", ct / "levels.nrrd", "--label", "L2", "--hu", "400", "--space", "ras")
    assert run(*options, "--report", first) == 0
    left, right = load(first)["vertebrae"][0]["corridors"]
    wide = 2.0 * left["radius_mm"] + 1.5
    screws = tmp_path / "screws.json"
    inner = {"name": "inner", "entry": right["entry_mm"], "tip": right["tip_mm"], "diameter": 3.0, "label": "L2"}
    screws.write_text(json.dumps({"screws": [inner]}))
    given = ",".join(map(str, (*left["entry_mm"], *left["tip_mm"], round(wide, 2))))
    outputs = ("-o", tmp_path / "l2.ply", "--picture", tmp_path / "l2.png", "--report", tmp_path / "l2.json")
    capsys.readouterr()
    assert run(*options, *outputs, "--screw", given, "--screws", screws, "--device", device.index) == 0
    said = capsys.readouterr().out
    assert "grade B" in said and "grade A, no breach" in said and "Gertzbein-Robbins in five grades" in said
    report = load(tmp_path / "l2.json")
    wide_grade, inner_grade = report["vertebrae"][0]["screws"]
    assert wide_grade["grade"] == "B" and 0.4 < wide_grade["breach_mm"] < 1.1
    assert wide_grade["direction"] in ("medial", "lateral", "cranial", "caudal")
    assert (inner_grade["name"], inner_grade["grade"], inner_grade["side"]) == ("inner", "A", "right")
    np.testing.assert_allclose(inner_grade["entry_mm"], right["entry_mm"], atol=2e-3)
    names = ["L2", "L2_left", "L2_right", "L2_screw_1", "L2_screw_2"]
    assert [each["name"] for each in report["outputs"] if each["kind"] == "mesh"] == names
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == sorted([*(f"l2_{name}.ply" for name in names), "l2.png", "l2.json", "first.json", "screws.json"])
    assert run(*options, *outputs, "--no-clobber") == 6
    assert "exists" in capsys.readouterr().err


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
        (("--label", "L1", "--hu", "150,300"), 3, "--hu is one level or auto"),
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
