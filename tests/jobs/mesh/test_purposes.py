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


def test_labels_are_printed_solid() -> None:
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
)
def test_bone_is_kept_where_the_level_is_that_of_bone_and_nothing_else_is_chosen(given: Any, keep: str | None) -> None:
    assert MeshSettings(**settings_for("print", given)).keep == keep


def test_impossible_purposes_are_refused() -> None:
    with refused(UsageError, "fun"):
        settings_for("fun", {})
    with refused(UsageError, "closed=False"):
        settings_for("print", {"closed": False})
    with refused(UsageError, "fun"):
        MeshSettings(purpose="fun")


def test_warnings_say_what_can_go_wrong() -> None:
    wall = {"thin_share": 0.01, "thin_mm": 1.0}
    cavities = {"cavities": 0, "cavities_ml": 0.0}
    good = {"wall": wall, "bone_wall": None, "left_out": {"pieces_ml": 1.0}, "pieces_ml": 2.0, **cavities}
    assert warn_of_print(good) == []
    assert "20 % of the surface" in warn_of_print({**good, "wall": {**wall, "thin_share": 0.2}})[0]
    (hidden,) = warn_of_print({**good, "bone_wall": {**wall, "thin_share": 0.25}})
    assert "25 %" in hidden and "bone thinner than 1 mm" in hidden and " 1 %" in hidden
    assert "closed cavities" in warn_of_print({**good, "cavities": 3, "cavities_ml": 0.2})[0]
    assert "is it the right piece" in warn_of_print({**good, "left_out": {"pieces_ml": 2.1}})[0]
    told = {"pieces_ml": 4.1, "not_bone": 1, "not_bone_ml": 3.2}  # bone of 0.9 ml beside 2 ml
    assert warn_of_print({**good, "left_out": told}) == []
    told["not_bone_ml"] = 3.0
    assert "bone that was left out encloses 1.1 ml" in warn_of_print({**good, "left_out": told})[0]
    mouse = {**good, "pieces_ml": 0.0328, "left_out": {"pieces_ml": 0.0808}}
    assert "encloses 80.8 mm3, beside the 32.8 mm3 that were kept" in warn_of_print(mouse)[0]


def test_all_parts_say_how_much_is_left_out_as_no_bone() -> None:
    facts = [{"left_out": {"not_bone": 27, "not_bone_ml": 2.1}, "pieces_ml": 30.0}, {"pieces_ml": 11.9}]
    (text,) = warn_of_other_pieces(facts)
    assert text.startswith("27 pieces of 2.1 ml together were left out, crumbs or with walls that do not reach 600 HU")
    assert "min_volume_ml=0.1 in place of all_parts=True keeps" in text
    assert warn_of_other_pieces([*facts, {"pieces_ml": 0.2}]) == []
    facts[0]["left_out"]["not_bone_ml"] = None  # bone was not told from other things
    assert warn_of_other_pieces(facts) == warn_of_other_pieces([]) == []


@pytest.mark.release
def test_print_of_a_phantom_is_one_closed_piece_of_its_size(
    device: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = PhantomSettings(kind="torus", size=(72, 56), slices=31, spacing=(0.5, 0.7, 1.0), noise=30.0)
    truth = write_phantom(tmp_path / "ct", settings)
    arguments = ["mesh", str(tmp_path / "ct"), "-o", str(tmp_path / "a.stl"), "--hu", f"{truth['iso_value_hu']:g}"]
    arguments += ["--device", str(device.index), "--for", "print", "--report", str(tmp_path / "a.json")]
    assert main(arguments) == 0
    told = capsys.readouterr().out
    report = json.loads((tmp_path / "a.json").read_text())
    facts = report["print"]
    assert (report["purpose"], report["keep_largest"], report["components"]) == ("print", 1, 1)
    size = np.ptp(np.array(report["bounds_mm"]), axis=0)
    np.testing.assert_allclose(facts["size_mm"], size, atol=1e-4)
    assert "print    size " + " x ".join(f"{length:.1f}" for length in size) in told
    assert (facts["pieces"], facts["cavities"]) == (1, 0)
    assert facts["pieces_ml"] == pytest.approx(report["volume_ml"], rel=0.01)
    assert 0.0 < facts["wall"]["p5_mm"] <= facts["wall"]["median_mm"] <= size.max()
    assert main([*arguments, "--open"]) == 3


def test_paper_b_is_the_way_of_the_paper() -> None:
    settings = MeshSettings(**settings_for("paper-b", {"region": ["hu:100,"], "closed": False}))
    assert (settings.preprocess, settings.method_used, settings.vertex_rule) == (
        "bilateral-2d,open:1,region", "i-mc", "golden",
    )  # fmt: skip
    assert not settings.is_for_print
    own = MeshSettings(**settings_for("paper-b", {"vertex_rule": "linear", "preprocess": "fill"}))
    assert (own.preprocess, own.vertex_rule) == ("fill", "linear")
    assert MeshSettings(**settings_for("paper-b", {})).preprocess == "bilateral-2d,open:1"


def test_paper_b_runs_as_a_whole(device: Any, tmp_path: Path, printed: Printer) -> None:
    write_phantom(tmp_path / "ct", PhantomSettings(size=(96, 96), slices=40, spacing=(1.6, 1.6, 2.0), noise=12.0))
    report_path, mesh_path = tmp_path / "r.json", tmp_path / "bone.stl"
    options = ["--for", "paper-b", "--hu", "250", "--region", "tube:60", "--device", str(device.index)]
    assert main(["mesh", str(tmp_path / "ct"), "-o", str(mesh_path), "--report", str(report_path), *options]) == 0
    report = json.loads(report_path.read_text())
    steps = [step["step"] for step in report["volume"]["preprocess"]]
    assert steps == ["bilateral-2d", "open:1", "region"]
    assert (report["method"], report["vertex_rule"]) == ("i-mc", "golden")
    cells = report["meshes"][0]["cells"]
    assert 0 < cells["active"] <= cells["all"]
    said = printed()
    said.assert_output("cells")
    assert any("0.618 of their edges" in warning for warning in report["warnings"])


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


@pytest.mark.release
@pytest.mark.seconds
def test_metal_is_named_and_distances_are_judged_without_it(device: Any, tmp_path: Path) -> None:
    make_hip().save(tmp_path / "hip.nii.gz")
    arguments = ["mesh", str(tmp_path / "hip.nii.gz"), "-o", str(tmp_path / "a.stl"), "--for", "print"]
    arguments += ["--device", str(device.index), "--report", str(tmp_path / "a.json")]
    assert main(arguments) == 0
    report = json.loads((tmp_path / "a.json").read_text())
    found, gates = report["iso_distance"], {gate["name"]: gate for gate in report["gates"]}
    assert 0.3 < found["near_metal"] / found["samples"]["vertices"] < 0.5
    nearer = min((found[of] for of in ("vertices_voxel", "surface_voxel")), key=lambda one: one["mean"])
    for name, bound in (("p95", 0.25), ("mean", 0.1)):
        whole, away, gate = (nearer[name], found["away_from_metal_voxel"][name], gates[f"iso_distance_{name}"])
        assert whole > bound > 1.5 * away
        assert (gate["measured"], gate["ok"]) == (away, True)
        metal = f"{found['near_metal']:,} of {found['samples']['vertices']:,} vertices near metal (above 2000 HU)"
        assert f"(without {metal}, with them {whole:.3g})" in gate["text"]
