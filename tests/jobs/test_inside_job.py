"""``clrecon inside`` at work: its files, its report, its words, and what is refused before anything is written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contract_tables import names_in
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
    folder = tmp_path_factory.mktemp("inside") / "spine"
    write_phantom(folder, PhantomSettings(levels="L1-L2", size=(140, 140), spacing=(1.0, 1.0, 1.5)))
    return folder


@pytest.fixture
def inside(device: Any, spine: Path, tmp_path: Path) -> Any:
    """Run the command on the phantom; returns the exit code."""

    def run(*options: str, output: str = "in.stl", labels: str = "levels.nrrd") -> int:
        arguments = ["inside", str(spine), "--labels", str(spine / labels), "-o", str(tmp_path / output)]
        return main([*arguments, "--device", str(device.index), *options])

    return run


@pytest.mark.release
@pytest.mark.seconds
def test_files_report_and_words_agree(inside: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert inside("--label", "L1", "--report", str(tmp_path / "r.json")) == 0
    said = capsys.readouterr()
    report = json.loads((tmp_path / "r.json").read_text(encoding="ascii"))
    assert {path.name for path in tmp_path.iterdir()} == {*(f"in_{part}.stl" for part in PARTS), "r.json"}
    assert set(report) == names_in("clrecon inside INPUT -o OUT --report FILE", "The report") | {"warnings", "volume"}
    (vertebra,) = report["vertebrae"]
    assert set(vertebra) == names_in("clrecon inside INPUT -o OUT --report FILE", "Each object of `vertebrae`")
    assert vertebra["name"] == "L1"
    assert [mesh["part"] for mesh in vertebra["meshes"]] == list(PARTS)
    for mesh in vertebra["meshes"]:
        assert mesh["bytes"] == (tmp_path / f"in_{mesh['part']}.stl").stat().st_size
    volumes = vertebra["volumes_ml"]
    assert f"solid {volumes['solid']:.2f} ml (label), canal {volumes['canal']:.2f} ml" in said.out
    assert f"dense {volumes['dense']:.2f} ml (450 HU and above)" in said.out
    assert "thickness of dense bone" in said.out
    assert "not resolved" in said.out
    assert "wrote    " in said.out and "_canal.stl, " in said.out


@pytest.mark.release
def test_several_vertebrae_have_names_of_their_own(inside: Any, tmp_path: Path, printed: Printer) -> None:
    assert inside("--label", "L1", "--label", "21", "--hu", "300", "--dense", "350:900", "--json", output="a.ply") == 0
    report = printed().report()
    assert {path.name for path in tmp_path.iterdir()} == {f"a_{n}_{part}.ply" for n in ("L1", "L2") for part in PARTS}
    assert [vertebra["label"] for vertebra in report["vertebrae"]] == [20, 21]
    assert {vertebra["iso_value_hu"] for vertebra in report["vertebrae"]} == {300.0}
    assert report["vertebrae"][0]["dense_hu"] == [350.0, 900.0]
    assert inside("--label", "L1", "--label", "L2", "--dense", "0", "--json", output="b.ply") == 0
    warnings = printed().report()["warnings"]  # tissue beside the labels is in that band
    for name in ("L1", "L2"):
        assert [line for line in warnings if line.startswith(f"{name}: ") and "next voxel outside" in line]


def test_solid_bone_ends_at_the_surface_fitted_to_it(inside: Any, printed: Printer) -> None:
    found = {}
    for options in ((), ("--hu", "200"), ("--surface", "cortex")):
        assert inside("--label", "L1", *options, "--json", output=f"{len(options)}{options[-1:]}.stl") == 0
        (found[options],) = printed().report()["vertebrae"]
    true, level, fitted = (one["volumes_ml"]["solid"] for one in found.values())
    assert level > 1.1 * true and fitted == pytest.approx(true, rel=0.03)
    report = found["--surface", "cortex"]
    assert (report["solid_of"], report["iso_value_hu"]) == ("cortex", 200.0) and report["cortex"]["moved"]
    assert "200 HU, " in _describe_vertebra(report)[1] and "error 0." in _describe_vertebra(report)[1]


def test_existing_file_of_inside_stays_with_no_clobber(inside: Any, tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "in_L2_canal.stl").write_text("kept")
    assert inside("--label", "L1", "--label", "L2", "--no-clobber") == 6
    printed().assert_error("in_L2_canal.stl")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["kept"]


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        ((), 3, "--label"),
        (("--label", "L5"), 3, "label 'L5' is not in the label map"),
        (("--label", "L1", "--dense", "900:450"), 3, "the lower one first"),
        (("--label", "L1", "--dense", "bone"), 3, "write A for A and above, or A:B"),
        (("--label", "L1", "--dense", "3000"), 2, "no voxel of label 20 L1 has 3000 HU and above"),
        (("--label", "L1", "--hu", "5000"), 2, "no voxel of label 20 L1 has 5000 HU"),
        (("--label", "L1", "--grow", "2"), 3, "leave --grow out, or give an iso value (--hu N)"),
        (("--label", "L1", "--close", "-1"), 3, "a number of mm above 0 is needed"),
        (("--label", "L1", "--space", "mni"), 3, "unknown space"),
        (("--label", "L1", "--memory", "1kB"), 5, "1,000 bytes"),
    ],
)
def test_wrong_options_are_one_line_and_leave_nothing(
    inside: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], code: int, words: str
) -> None:
    assert inside(*options) == code
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_wrong_files_are_one_line_and_leave_nothing(inside: Any, spine: Path, tmp_path: Path, printed: Printer) -> None:
    assert inside("--label", "L1", labels="none.nrrd") == 3
    assert inside("--label", "L1", output="a.xyz") == 3
    assert inside("--label", "L1", output="none/a.stl") == 6
    assert printed().error_lines == 3
    assert list(tmp_path.iterdir()) == []
    settings = InsideSettings(labels=spine / "levels.nrrd", label=["L1"])
    assert settings.space == "lps"
    with refused(UsageError, "vertebrae", "labels"):
        InsideSettings(labels="x.nrrd", label=())
    with refused(UsageError, 0, "bytes"):
        InsideSettings(labels="x.nrrd", label=["L1"], memory=0)


@pytest.mark.release
@pytest.mark.seconds
def test_pictures_show_each_part(inside: Any, tmp_path: Path, printed: Printer) -> None:
    image = pytest.importorskip("PIL.Image")
    assert inside("--label", "L1", "--picture", str(tmp_path / "p.png"), "--view", "left", "--json") == 0
    (vertebra,) = printed().report()["vertebrae"]
    assert [picture["part"] for picture in vertebra["pictures"]] == list(PARTS)
    assert {path.name for path in tmp_path.glob("*.png")} == {f"p_{part}.png" for part in PARTS}
    shown = {}
    for part in PARTS:
        pixels = np.asarray(image.open(tmp_path / f"p_{part}.png").convert("RGB")).astype(int)
        assert pixels.shape == (1024, 1024, 3)
        assert (pixels[0] == 255).all()
        blue, red = pixels[..., 2] - pixels[..., 0], pixels[..., 0] - pixels[..., 2]
        shown[part] = (blue > 60).mean(), (red > 60).mean()
    assert shown["canal"][0] > 0.01  # blue is opaque here alone
    assert max(shown[part][0] for part in ("solid", "dense", "trabecular")) < 0.1 * shown["canal"][0]
    assert shown["trabecular"][1] > 0.05
    assert shown["canal"][1] < 0.01


def test_wrong_pictures_are_refused_first(inside: Any, tmp_path: Path, printed: Printer) -> None:
    assert inside("--label", "L1", "--picture", str(tmp_path / "p.svg")) == 3
    assert inside("--label", "L1", "--picture", str(tmp_path / "p.png"), "--view", "above") == 3
    assert inside("--label", "L1", "--picture", str(tmp_path / "none" / "p.png")) == 6
    assert printed().error_lines == 3
    (tmp_path / "p_canal.png").write_text("kept")
    assert inside("--label", "L1", "--picture", str(tmp_path / "p.png"), "--no-clobber") == 6
    assert [path.read_text() for path in tmp_path.iterdir()] == ["kept"]


def test_the_meshes_lie_in_the_patient(inside: Any, spine: Path, tmp_path: Path) -> None:
    assert inside("--label", "L1", "--space", "ras", output="a.ply") == 0
    pyvista = pytest.importorskip("pyvista")
    truth = clrecon.phantom_truth(spine)
    points = pyvista.read(tmp_path / "a_solid.ply").points * (-1.0, -1.0, 1.0)
    distance = truth.signed_distance(points)
    assert abs(float(distance.mean())) < 0.3
    assert float(abs(distance).max()) < 2.0


def test_small_volumes_are_said_in_cubic_millimetres() -> None:
    vertebra = {
        "name": "L1",
        "volumes_ml": {"solid": 0.0123, "dense": 0.004, "trabecular": None, "canal": 0.1},
        "dense_hu": (300.0, None),
        "iso_value_hu": None,
        "cortex": None,
        "canal_height_mm": 2.0,
        "dense_thickness": {"limit_mm": 0.1, "median_mm": None},
    }
    assert _describe_vertebra(vertebra)[1:3] == [
        "         solid 12.3 mm3 (label), canal 0.10 ml, 2 mm high",
        "         dense 4 mm3 (300 HU and above), trabecular 0 ml",
    ]
