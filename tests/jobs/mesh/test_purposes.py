"""--for print: the settings it stands for, and what it says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer
from refusals import refused
from scipy.ndimage import gaussian_filter

from clrecon import Volume
from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.jobs.mesh.purposes import settings_for, warn_of_other_pieces, warn_of_print
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.proof.phantom import PhantomSettings, write_phantom


def test_without_a_purpose_settings_stay_as_given() -> None:
    assert settings_for(None, {"smooth": None}) == {"smooth": None}


def test_defaults_give_way_to_the_settings_of_a_print() -> None:
    defaults = {"smooth": None, "strict": False, "closed": True, "seeds": []}
    assert MeshSettings(**settings_for("print", defaults)) == MeshSettings(
        keep="bone", keep_largest=1, solid=True, smooth=20, decimate=0.9, strict=True, purpose="print", seeds=[]
    )


def test_given_settings_win_over_those_of_a_print() -> None:
    given = {"keep_largest": 2, "smooth": 5, "decimate": 0.5}
    assert given.items() <= settings_for("print", given).items()


@pytest.mark.parametrize(
    "given", [{"solid": False}, {"iso_value": (200, 300)}, {"iso_value": -300}, {"below": -400}], ids=str
)
def test_a_print_of_what_is_no_solid_bone_stays_hollow(given: dict[str, Any]) -> None:
    assert not settings_for("print", given).get("solid")


@pytest.mark.parametrize("given", [{"seeds": [(0, 0, 0)]}, {"min_volume_ml": 1.0}, {"split": True}], ids=str)
def test_a_print_keeps_all_parts_where_these_are_chosen_otherwise(given: dict[str, Any]) -> None:
    assert settings_for("print", {**given, "keep_largest": None})["keep_largest"] is None


def test_print_of_labels_makes_them_solid() -> None:
    assert settings_for("print", {"labels": LabelChoice("a")})["labels"] == LabelChoice("a", solid=True)


@pytest.mark.parametrize(
    "labels", [LabelChoice("a", surface="mask"), LabelChoice("a", solid=True)], ids=["mask", "solid"]
)
def test_labels_that_are_solid_by_themselves_are_printed_as_given(labels: LabelChoice) -> None:
    assert settings_for("print", {"labels": labels})["labels"] == labels


def test_labels_are_printed_hollow_on_request() -> None:
    settings = settings_for("print", {"labels": LabelChoice("a"), "solid": False})
    assert not settings["labels"].solid
    assert not MeshSettings(**settings).solid


def test_labels_that_are_seeds_alone_are_not_made_solid() -> None:
    settings = settings_for("print", {"labels": LabelChoice("a"), "grow_from": ("label:L1",)})
    assert not settings["labels"].solid


@pytest.mark.parametrize(
    ("given", "keep"),
    [
        ({}, "bone"),
        ({"preset": "spongy-bone"}, "bone"),
        ({"iso_value": 300.0}, "bone"),
        ({"iso_value": (200.0, 700.0)}, "bone"),
        ({"half_way": "auto"}, "bone"),
        ({"half_way": (1000.0, 40.0)}, "bone"),
        ({"split": True}, "bone"),
        ({"preset": "skin"}, None),
        ({"preset": "metal"}, None),
        ({"iso_value": 2600.0}, None),
        ({"iso_value": (200.0, -500.0)}, None),
        ({"iso_value": ((100.0, 300.0),)}, None),
        ({"below": -400.0}, None),
        ({"labels": LabelChoice("a")}, None),
        ({"labels": LabelChoice("a", surface="mask")}, None),
        ({"keep_largest": 2}, None),
        ({"min_volume_ml": 1.0}, None),
        ({"seeds": [(0.0, 0.0, 0.0)]}, None),
        ({"seeds": [(0.0, 0.0, 0.0)], "keep": "bone"}, "bone"),
    ],
    ids=str,
)
def test_bone_is_kept_where_the_level_is_that_of_bone_and_nothing_else_is_chosen(given: Any, keep: str | None) -> None:
    assert MeshSettings(**settings_for("print", given)).keep == keep


def test_unknown_purpose_is_refused() -> None:
    with refused(UsageError, "fun"):
        settings_for("fun", {})
    with refused(UsageError, "fun"):
        MeshSettings(purpose="fun")


def test_print_of_an_open_mesh_is_refused() -> None:
    with refused(UsageError, "closed=False"):
        settings_for("print", {"closed": False})


GOOD_PRINT = {
    "wall": {"thin_share": 0.01, "thin_mm": 1.0},
    "bone_wall": None,
    "left_out": {"pieces_ml": 1.0},
    "pieces_ml": 2.0,
    "cavities": 0,
    "cavities_ml": 0.0,
}
"""What a job knows of a print without faults: half as much is left out as is kept."""


def test_print_without_faults_has_no_warning() -> None:
    assert warn_of_print(GOOD_PRINT) == []


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        pytest.param({"wall": {"thin_share": 0.2, "thin_mm": 1.0}}, "20 % of the surface", id="thin walls"),
        pytest.param({"cavities": 3, "cavities_ml": 0.2}, "closed cavities", id="cavities"),
        pytest.param({"left_out": {"pieces_ml": 2.1}}, "is it the right piece", id="more left out than kept"),
        pytest.param(
            {"pieces_ml": 0.0328, "left_out": {"pieces_ml": 0.0808}},
            "encloses 80.8 mm3, beside the 32.8 mm3 that were kept",
            id="more left out of a small animal",
        ),
    ],
)
def test_fault_of_a_print_is_warned_of(fault: dict[str, Any], said: str) -> None:
    (warning,) = warn_of_print({**GOOD_PRINT, **fault})
    assert said in warning


def test_walls_that_are_thicker_than_their_bone_are_warned_of_with_both_shares() -> None:
    bone_wall = {"thin_share": 0.25, "thin_mm": 1.0}

    (warning,) = warn_of_print({**GOOD_PRINT, "bone_wall": bone_wall})

    assert "25 %" in warning
    assert "bone thinner than 1 mm" in warning
    assert " 1 %" in warning  # of the walls of the print


def test_bone_left_out_of_a_print_is_warned_of_where_it_is_more_than_half_of_what_is_kept() -> None:
    assert GOOD_PRINT["pieces_ml"] == 2.0
    bone_of_0_9_ml = {"pieces_ml": 4.1, "not_bone": 1, "not_bone_ml": 3.2}
    bone_of_1_1_ml = {"pieces_ml": 4.1, "not_bone": 1, "not_bone_ml": 3.0}

    assert warn_of_print({**GOOD_PRINT, "left_out": bone_of_0_9_ml}) == []
    (warning,) = warn_of_print({**GOOD_PRINT, "left_out": bone_of_1_1_ml})
    assert "bone that was left out encloses 1.1 ml" in warning


def test_print_of_all_parts_warns_where_more_than_a_twentieth_is_left_out_as_no_bone() -> None:
    left_out = {"not_bone": 27, "not_bone_ml": 2.1}
    kept_41_9_ml = [{"left_out": left_out, "pieces_ml": 30.0}, {"pieces_ml": 11.9}]
    kept_42_1_ml = [*kept_41_9_ml, {"pieces_ml": 0.2}]

    (warning,) = warn_of_other_pieces(kept_41_9_ml)
    assert warning.startswith(
        "27 pieces of 2.1 ml together were left out, crumbs or with walls that do not reach 600 HU"
    )
    assert "min_volume_ml=0.1 in place of all_parts=True keeps" in warning
    assert warn_of_other_pieces(kept_42_1_ml) == []


@pytest.mark.parametrize(
    "facts",
    [[], [{"left_out": {"not_bone": 27, "not_bone_ml": None}, "pieces_ml": 30.0}]],
    ids=["no part", "bone not told from other things"],
)
def test_print_of_all_parts_has_no_warning_where_nothing_is_known_as_no_bone(facts: list[dict[str, Any]]) -> None:
    assert warn_of_other_pieces(facts) == []


@pytest.fixture(scope="module")
def torus(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """The folder of a noisy CT of a torus, and the iso value of its surface."""
    folder = tmp_path_factory.mktemp("torus") / "ct"
    settings = PhantomSettings(kind="torus", size=(72, 56), slices=31, spacing=(0.5, 0.7, 1.0), noise=30.0)
    return folder, write_phantom(folder, settings)["iso_value_hu"]


@pytest.mark.release
def test_print_of_a_torus_is_one_closed_piece_with_its_size_volume_and_walls(
    device: Any, torus: tuple[Path, float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, level = torus
    command = ["mesh", str(folder), "-o", str(tmp_path / "a.stl"), "--hu", f"{level:g}", "--for", "print"]

    assert main([*command, "--device", str(device.index), "--report", str(tmp_path / "a.json")]) == 0

    report = json.loads((tmp_path / "a.json").read_text())
    assert (report["purpose"], report["keep_largest"], report["components"]) == ("print", 1, 1)
    facts = report["print"]
    assert (facts["pieces"], facts["cavities"]) == (1, 0)
    size = np.ptp(np.array(report["bounds_mm"]), axis=0)
    np.testing.assert_allclose(facts["size_mm"], size, atol=1e-4)  # float32 coordinates of some 100 mm
    assert "print    size " + " x ".join(f"{length:.1f}" for length in size) in capsys.readouterr().out
    assert facts["pieces_ml"] == pytest.approx(report["volume_ml"], rel=1e-5)  # float32
    assert 0.0 < facts["wall"]["p5_mm"] <= facts["wall"]["median_mm"] <= size.max()


def test_print_with_the_option_open_is_refused(torus: tuple[Path, float], tmp_path: Path, printed: Printer) -> None:
    assert main(["mesh", str(torus[0]), "-o", str(tmp_path / "a.stl"), "--for", "print", "--open"]) == 3
    printed().assert_error("--open")


def test_purpose_paper_b_sets_the_steps_method_and_vertex_rule_of_the_paper() -> None:
    settings = MeshSettings(**settings_for("paper-b", {"region": ["hu:100,"], "closed": False}))

    assert settings.preprocess == "bilateral-2d,open:1,region"
    assert (settings.method_used, settings.vertex_rule) == ("i-mc", "golden")
    assert not settings.is_for_print


def test_purpose_paper_b_without_a_region_has_no_step_for_it() -> None:
    assert MeshSettings(**settings_for("paper-b", {})).preprocess == "bilateral-2d,open:1"


def test_given_settings_win_over_those_of_paper_b() -> None:
    settings = MeshSettings(**settings_for("paper-b", {"vertex_rule": "linear", "preprocess": "fill"}))
    assert (settings.preprocess, settings.vertex_rule) == ("fill", "linear")


def test_command_for_paper_b_reports_its_steps_method_and_cells(device: Any, tmp_path: Path, printed: Printer) -> None:
    write_phantom(tmp_path / "ct", PhantomSettings(size=(96, 96), slices=40, spacing=(1.6, 1.6, 2.0), noise=12.0))
    report_path, mesh_path = tmp_path / "r.json", tmp_path / "bone.stl"
    options = ["--for", "paper-b", "--hu", "250", "--region", "tube:60", "--device", str(device.index)]

    assert main(["mesh", str(tmp_path / "ct"), "-o", str(mesh_path), "--report", str(report_path), *options]) == 0

    report = json.loads(report_path.read_text())
    steps = [step["step"] for step in report["volume"]["preprocess"]]
    assert steps == ["bilateral-2d", "open:1", "region"]
    assert (report["method"], report["vertex_rule"]) == ("i-mc", "golden")
    (mesh,) = report["meshes"]
    cells = mesh["cells"]
    assert 0 < cells["active"] <= cells["all"]
    printed().assert_output("cells")
    assert any("0.618 of their edges" in warning for warning in report["warnings"])  # where the rule puts vertices


def make_hip() -> Volume:
    """A femur in a thigh with the head and stem of a prosthesis: metal has sharp edges and is cut off at 3071 HU."""
    size = 72
    k, j, i = np.mgrid[:size, :size, :size] - 35.5
    radius = np.hypot(i, j)
    shaft = (k > -29) & (k < 6)
    hu = np.where(radius < 32, 40.0, -1000.0)
    hu[shaft & (radius < 20)] = 250
    hu[shaft & (radius < 20) & (radius > 15)] = 1100
    head = np.sqrt(i**2 + j**2 + (k - 16.5) ** 2) < 14
    stem = (np.hypot(i - 0.3 * k, j) < 5) & (k > -25) & (k < 24)
    hu = gaussian_filter(hu, 0.9) + 8000 * gaussian_filter((head | stem).astype(float), 0.3)
    hu += np.random.default_rng(3).normal(0, 12, hu.shape)
    return Volume(np.rint(np.minimum(hu, 3071)).astype(np.int16), np.diag([1.0, 1.0, 1.5, 1.0]))


GATE_FAILED = 8
"""The exit code, see docs/contract.md."""


def print_phantom(device: Any, scan: Path, folder: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """The exit code and the report of a print."""
    command = ["mesh", str(scan), "-o", str(folder / "a.stl"), "--for", "print", "-q", *options]
    code = main([*command, "--device", str(device.index), "--report", str(folder / "a.json")])
    return code, json.loads((folder / "a.json").read_text())


@pytest.mark.release
@pytest.mark.seconds
def test_gate_of_the_iso_distance_is_judged_without_what_is_near_metal_and_says_its_share(
    device: Any, tmp_path: Path
) -> None:
    """Half of the vertices of the hip's print lie near metal, but a quarter of its area."""
    make_hip().save(tmp_path / "hip.nii.gz")
    code, report = print_phantom(device, tmp_path / "hip.nii.gz", tmp_path)
    found = report["iso_distance"]
    (gate,) = (gate for gate in report["gates"] if gate["name"] == "iso_distance_p95")

    assert code == 0
    assert 0.24 < found["near_metal_share"] < 0.3  # measured 0.268
    whole, away = found["vertices_voxel"]["p95"], found["away_from_metal_voxel"]["p95"]
    assert whole > gate["bound"] > 1.5 * away
    assert gate["measured"] == away
    metal = f"{100 * found['near_metal_share']:.2g} % of the surface near metal (above 2000 HU)"
    assert f"(without {metal}, with it {whole:.3g})" in gate["text"]


VOXEL_MM = 3.0


@pytest.fixture(scope="module")
def coarse_hip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hip in voxels so large that smoothing leaves little of what its gates allow for the distance."""
    scan = tmp_path_factory.mktemp("coarse") / "ct"
    write_phantom(scan, PhantomSettings(kind="hip", size=(72, 72), slices=40, spacing=(VOXEL_MM,) * 3))
    return scan


@pytest.mark.seconds
def test_print_that_lies_too_far_is_decimated_again_within_a_tighter_bound(
    device: Any, coarse_hip: Path, tmp_path: Path
) -> None:
    bound_mm = 0.25 * VOXEL_MM  # that of smoothing, and the first of decimation

    code, report = print_phantom(device, coarse_hip, tmp_path)

    assert code == 0
    assert report["refinement"]["decimate"]["max_deviation_mm"] == pytest.approx(bound_mm / 2)


@pytest.mark.seconds
def test_print_with_a_bound_of_its_own_that_lies_too_far_fails_its_gates(
    device: Any, coarse_hip: Path, tmp_path: Path
) -> None:
    bound_mm = 0.25 * VOXEL_MM  # that of smoothing alone
    code, report = print_phantom(device, coarse_hip, tmp_path, "--max-deviation", f"{bound_mm}")
    assert code == GATE_FAILED
    assert report["refinement"]["decimate"]["max_deviation_mm"] == bound_mm
    failed = {gate["name"] for gate in report["gates"] if gate["ok"] is False}
    assert failed and failed <= {"iso_distance_p95", "iso_distance_mean"}
