"""``clrecon inside`` at work: its files, its report, its words, and what is refused before anything is written."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer
from refusals import refused

import clrecon
from clrecon.cli.inside import _describe_vertebra
from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.jobs.settings import InsideSettings
from clrecon.proof.phantom import PhantomSettings, write_phantom

pytestmark = pytest.mark.first_device

PARTS = ("dense", "trabecular", "canal", "solid")


@pytest.fixture(scope="module")
def spine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a CT of L1 and L2 in voxels of 1 x 1 x 1.5 mm, with their true labels, levels.nrrd."""
    folder = tmp_path_factory.mktemp("inside") / "spine"
    write_phantom(folder, PhantomSettings(levels="L1-L2", size=(140, 140), spacing=(1.0, 1.0, 1.5)))
    return folder


@pytest.fixture
def run_inside(device: Any, spine: Path, tmp_path: Path) -> Any:
    """A function that runs ``clrecon inside`` on the phantom, with further options, and returns the exit code."""

    def run(*options: str, output: str = "in.stl", labels: str = "levels.nrrd") -> int:
        arguments = ["inside", str(spine), "--labels", str(spine / labels), "-o", str(tmp_path / output)]
        return main([*arguments, "--device", str(device.index), *options])

    return run


@dataclass
class InsideRun:
    """What one run of the command for L1 left: its folder, its report, and its words."""

    folder: Path
    report: dict[str, Any]
    output: str


@pytest.fixture(scope="module")
def inside_of_l1(device: Any, spine: Path, tmp_path_factory: pytest.TempPathFactory) -> InsideRun:
    folder = tmp_path_factory.mktemp("l1")
    command = ["inside", str(spine), "--labels", str(spine / "levels.nrrd"), "--label", "L1"]
    command += ["-o", str(folder / "in.stl"), "--report", str(folder / "r.json"), "--device", str(device.index)]
    with redirect_stdout(StringIO()) as words:
        assert main(command) == 0
    return InsideRun(folder, json.loads((folder / "r.json").read_text(encoding="ascii")), words.getvalue())


@pytest.mark.release
@pytest.mark.seconds
def test_inside_writes_a_mesh_of_each_part_and_the_report(inside_of_l1: InsideRun) -> None:
    meshes = {"in_dense.stl", "in_trabecular.stl", "in_canal.stl", "in_solid.stl"}
    assert {path.name for path in inside_of_l1.folder.iterdir()} == {*meshes, "r.json"}


@pytest.mark.release
def test_report_of_inside_has_the_size_of_each_mesh_file(inside_of_l1: InsideRun) -> None:
    (vertebra,) = inside_of_l1.report["vertebrae"]

    sizes = {mesh["part"]: mesh["bytes"] for mesh in vertebra["meshes"]}

    assert vertebra["name"] == "L1"
    assert sizes == {part: (inside_of_l1.folder / f"in_{part}.stl").stat().st_size for part in PARTS}


@pytest.mark.release
def test_inside_prints_the_volumes_of_its_report_and_the_files(inside_of_l1: InsideRun) -> None:
    (vertebra,) = inside_of_l1.report["vertebrae"]
    volumes = vertebra["volumes_ml"]
    lines = inside_of_l1.output

    assert f"solid {volumes['solid']:.2f} ml (label), canal {volumes['canal']:.2f} ml" in lines
    assert f"dense {volumes['dense']:.2f} ml (450 HU and above)" in lines
    (written,) = (line for line in lines.splitlines() if line.startswith("wrote    "))
    assert "_canal.stl, " in written


@pytest.mark.release
def test_inside_prints_that_thin_dense_bone_is_not_resolved(inside_of_l1: InsideRun) -> None:
    (line,) = (line for line in inside_of_l1.output.splitlines() if "thickness of dense bone" in line)
    assert "not resolved" in line


@pytest.mark.release
def test_several_vertebrae_are_written_with_their_names_at_the_given_hu(
    run_inside: Any, tmp_path: Path, printed: Printer
) -> None:
    number_of_l2 = "21"
    labels = ["--label", "L1", "--label", number_of_l2]

    assert run_inside(*labels, "--hu", "300", "--dense", "350:900", "--json", output="a.ply") == 0

    assert {path.name for path in tmp_path.iterdir()} == {f"a_{n}_{part}.ply" for n in ("L1", "L2") for part in PARTS}
    first, second = printed().report()["vertebrae"]
    assert (first["label"], second["label"]) == (20, 21)
    assert first["iso_value_hu"] == second["iso_value_hu"] == 300.0
    assert first["dense_hu"] == second["dense_hu"] == [350.0, 900.0]


@pytest.mark.release
def test_dense_band_that_goes_on_outside_of_the_label_is_warned_of_for_each_vertebra(
    run_inside: Any, printed: Printer
) -> None:
    of_soft_tissue_too = ["--dense", "0"]

    assert run_inside("--label", "L1", "--label", "L2", *of_soft_tissue_too, "--json") == 0

    warnings = [line for line in printed().report()["warnings"] if "next voxel outside" in line]
    assert [line.split(": ")[0] for line in warnings] == ["L1", "L2"]


def test_solid_bone_within_the_fitted_surface_has_the_volume_of_the_true_label(
    run_inside: Any, printed: Printer
) -> None:
    volume_ml = {}
    for solid, options in {"label": (), "200 HU": ("--hu", "200"), "cortex": ("--surface", "cortex")}.items():
        assert run_inside("--label", "L1", *options, "--json", output=f"{solid}.stl") == 0
        (vertebra,) = printed().report()["vertebrae"]
        volume_ml[solid] = vertebra["volumes_ml"]["solid"]

    assert volume_ml["cortex"] == pytest.approx(volume_ml["label"], rel=0.015)  # measured 0.006
    assert volume_ml["200 HU"] > 1.1 * volume_ml["label"]  # blur puts 200 HU outside of the bone: measured 1.14


@pytest.mark.release
def test_report_and_words_name_the_surface_fitted_to_the_solid_bone(run_inside: Any, printed: Printer) -> None:
    assert run_inside("--label", "L1", "--surface", "cortex", "--json") == 0

    (vertebra,) = printed().report()["vertebrae"]
    assert (vertebra["solid_of"], vertebra["iso_value_hu"]) == ("cortex", 200.0)
    assert vertebra["cortex"]["moved"] > 0
    _, solid_line, *_ = _describe_vertebra(vertebra)
    assert "200 HU, " in solid_line
    assert "error 0." in solid_line


def test_existing_file_of_inside_stays_with_no_clobber(run_inside: Any, tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "in_L2_canal.stl").write_text("kept")

    assert run_inside("--label", "L1", "--label", "L2", "--no-clobber") == 6

    printed().assert_error("in_L2_canal.stl")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["kept"]


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        pytest.param((), 3, "--label", id="no label"),
        pytest.param(("--label", "L5"), 3, "label 'L5' is not in the label map", id="label not in the map"),
        pytest.param(("--label", "L1", "--dense", "900:450"), 3, "the lower one first", id="band upside down"),
        pytest.param(("--label", "L1", "--dense", "bone"), 3, "write A for A and above, or A:B", id="band of a word"),
        pytest.param(
            ("--label", "L1", "--dense", "3000"), 2, "no voxel of label 20 L1 has 3000 HU and above", id="empty band"
        ),
        pytest.param(("--label", "L1", "--hu", "5000"), 2, "no voxel of label 20 L1 has 5000 HU", id="too high HU"),
        pytest.param(
            ("--label", "L1", "--grow", "2"), 3, "leave --grow out, or give an iso value (--hu N)", id="grow without HU"
        ),
        pytest.param(("--label", "L1", "--close", "-1"), 3, "a number of mm above 0 is needed", id="closing below 0"),
        pytest.param(("--label", "L1", "--space", "mni"), 3, "unknown space", id="unknown space"),
        pytest.param(("--label", "L1", "--memory", "1kB"), 5, "1,000 bytes", id="little memory"),
    ],
)
def test_wrong_options_of_inside_are_refused_in_one_line_and_leave_nothing(
    run_inside: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], code: int, words: str
) -> None:
    assert run_inside(*options) == code

    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("files", "code", "fact"),
    [
        pytest.param({"labels": "none.nrrd"}, 3, "none.nrrd", id="missing label map"),
        pytest.param({"output": "a.xyz"}, 3, ".xyz", id="format of clouds"),
        pytest.param({"output": "none/a.stl"}, 6, "none", id="missing folder"),
    ],
)
def test_wrong_files_of_inside_are_refused_in_one_line_and_leave_nothing(
    files: dict[str, str], code: int, fact: str, run_inside: Any, tmp_path: Path, printed: Printer
) -> None:
    assert run_inside("--label", "L1", **files) == code

    said = printed()
    assert said.error_lines == 1
    said.assert_error(fact)
    assert list(tmp_path.iterdir()) == []


def test_settings_of_inside_write_lps_by_default() -> None:
    assert InsideSettings(labels="levels.nrrd", label=["L1"]).space == "lps"


@pytest.mark.parametrize(
    ("settings", "facts"),
    [
        pytest.param({"label": ()}, ("vertebrae", "labels"), id="no label"),
        pytest.param({"label": ["L1"], "memory": 0}, (0, "bytes"), id="no memory"),
    ],
)
def test_impossible_settings_of_inside_are_refused(settings: dict[str, Any], facts: tuple[str | int, ...]) -> None:
    with refused(UsageError, *facts):
        InsideSettings(labels="x.nrrd", **settings)


@pytest.mark.release
@pytest.mark.seconds
def test_each_part_has_a_picture_on_white_with_the_canal_in_blue_and_trabecular_bone_in_red(
    run_inside: Any, tmp_path: Path, printed: Printer
) -> None:
    image = pytest.importorskip("PIL.Image")

    assert run_inside("--label", "L1", "--picture", str(tmp_path / "p.png"), "--view", "left", "--json") == 0

    (vertebra,) = printed().report()["vertebrae"]
    assert [picture["part"] for picture in vertebra["pictures"]] == list(PARTS)
    assert {path.name for path in tmp_path.glob("*.png")} == {f"p_{part}.png" for part in PARTS}
    blue, red = {}, {}  # shares of pixels
    for part in PARTS:
        pixels = np.asarray(image.open(tmp_path / f"p_{part}.png").convert("RGB")).astype(int)
        assert (pixels[0] == 255).all()  # the top row shows the background
        blue[part] = (pixels[..., 2] - pixels[..., 0] > 60).mean()
        red[part] = (pixels[..., 0] - pixels[..., 2] > 60).mean()
    assert blue["canal"] > 0.01 > red["canal"]  # measured 0.035 and 0
    assert max(blue["solid"], blue["dense"], blue["trabecular"]) < 0.1 * blue["canal"]  # measured 0
    assert red["trabecular"] > 0.05  # measured 0.14


@pytest.mark.parametrize(
    ("picture", "code", "fact"),
    [
        pytest.param(["p.svg"], 3, ".svg", id="no format of pictures"),
        pytest.param(["p.png", "--view", "above"], 3, "above", id="unknown view"),
        pytest.param(["none/p.png"], 6, "none", id="missing folder"),
    ],
)
def test_wrong_pictures_of_inside_are_refused_before_a_mesh_is_written(
    picture: list[str], code: int, fact: str, run_inside: Any, tmp_path: Path, printed: Printer
) -> None:
    name, *view = picture

    assert run_inside("--label", "L1", "--picture", str(tmp_path / name), *view) == code

    said = printed()
    assert said.error_lines == 1
    said.assert_error(fact)
    assert list(tmp_path.iterdir()) == []


def test_existing_picture_of_inside_stays_with_no_clobber(run_inside: Any, tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "p_canal.png").write_text("kept")

    assert run_inside("--label", "L1", "--picture", str(tmp_path / "p.png"), "--no-clobber") == 6

    printed().assert_error("p_canal.png")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["kept"]


def test_solid_mesh_of_inside_in_ras_lies_on_the_true_surface_of_the_vertebra(
    run_inside: Any, spine: Path, tmp_path: Path
) -> None:
    pyvista = pytest.importorskip("pyvista")

    assert run_inside("--label", "L1", "--space", "ras", output="a.ply") == 0

    points_lps = pyvista.read(tmp_path / "a_solid.ply").points * (-1.0, -1.0, 1.0)
    distance_mm = clrecon.phantom_truth(spine).signed_distance(points_lps)
    assert abs(float(distance_mm.mean())) < 0.02  # measured 0.006
    assert float(abs(distance_mm).max()) < np.linalg.norm((1.0, 1.0, 1.5))  # the diagonal of a voxel


def test_volumes_below_a_tenth_of_a_ml_are_printed_in_cubic_millimetres() -> None:
    vertebra = {
        "name": "L1",
        "volumes_ml": {"solid": 0.0123, "dense": 0.004, "trabecular": None, "canal": 0.1},
        "dense_hu": (300.0, None),
        "iso_value_hu": None,
        "cortex": None,
        "canal_height_mm": 2.0,
        "dense_thickness": {"limit_mm": 0.1, "median_mm": None},
    }

    _, solid, dense, _ = _describe_vertebra(vertebra)

    assert solid == "         solid 12.3 mm3 (label), canal 0.10 ml, 2 mm high"
    assert dense == "         dense 4 mm3 (300 HU and above), trabecular 0 ml"
