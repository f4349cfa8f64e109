"""``keep="bone"``: bone by its walls, never a heart in silence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.anatomy.iso_choice import CONTRAST_SAID
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.purposes import settings_for
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.system.records import none_of

AFFINE = np.diag((1.0, 1.0, 1.5, 1.0))
HEART_RADIUS_MM, BONE_RADIUS_MM = 12, 9
HEART_HU, BONE_HU = 380.0, 900.0
HEART_ML, BONE_ML = 4 / 3 * np.pi * HEART_RADIUS_MM**3 / 1000, 4 / 3 * np.pi * BONE_RADIUS_MM**3 / 1000


def make_scan(*, heart: float = HEART_HU, bone: float = BONE_HU) -> Volume:
    """A heart larger than a bone with marrow, in tissue of 40 HU, in air; 0 HU leaves one out."""
    from scipy.ndimage import gaussian_filter

    k, j, i = np.indices((24, 44, 72))
    hu = np.where((j > 3) & (j < 40), 40.0, -1000.0)
    for at_i, radius, value in ((50, HEART_RADIUS_MM, heart), (15, BONE_RADIUS_MM, bone), (15, 6.5, 120.0)):
        if value:
            hu[(i - at_i) ** 2 + (j - 21) ** 2 + (1.5 * (k - 12)) ** 2 < radius**2] = value
    hu = gaussian_filter(hu, 0.7) + np.random.default_rng(0).normal(0, 10, hu.shape)
    voxels = np.rint(hu).astype(np.int16)
    return Volume(voxels, AFFINE, {"hu_range": [float(voxels.min()), float(voxels.max())], "warnings": []})


@pytest.fixture
def set_scan(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that makes a volume the input of all jobs."""

    def use(volume: Volume) -> None:
        monkeypatch.setattr("clrecon.reading.dicom.reader.read_series", lambda source, selection, progress: volume)

    return use


def mesh_scan(tmp_path: Path, device: Any, **settings: Any) -> dict[str, Any]:
    """Mesh the scan of `set_scan` to b.ply; return the report."""
    return make_mesh("scan", tmp_path / "b.ply", MeshSettings(device=str(device.index), **settings), measure=True)


def warnings_with(words: str, report: dict[str, Any]) -> list[str]:
    return [text for text in report["warnings"] if words in text]


@pytest.mark.parametrize("level", [{"iso_value": 200.0}, {"preset": "bone"}])
def test_largest_component_that_is_a_heart_is_warned_of(level: Any, set_scan: Any, device: Any, tmp_path: Path) -> None:
    set_scan(make_scan())

    report = mesh_scan(tmp_path, device, keep_largest=1, **level)

    assert report["volume_ml"] == pytest.approx(HEART_ML, rel=0.03)  # 200 HU lies near half way from 40 to 380 HU
    assert report["walls"]["looks_like"] == "contrast medium"
    (warning,) = warnings_with("what is kept looks like contrast medium", report)
    assert "reach 600 at 0.0 %; keep='bone'" in warning  # compact bone has 600 HU, the heart 380


@pytest.mark.parametrize("level", [{"iso_value": 200.0}, {"preset": "bone"}])
def test_keep_bone_leaves_a_larger_heart_out_without_a_warning(
    level: Any, set_scan: Any, device: Any, tmp_path: Path
) -> None:
    set_scan(make_scan())

    report = mesh_scan(tmp_path, device, keep="bone", keep_largest=1, **level)

    assert (report["keep"], report["components_kept"], report["walls"]["looks_like"]) == ("bone", 1, "bone")
    assert BONE_ML < report["volume_ml"] < 0.6 * HEART_ML  # 200 HU lies outside of half way to 900 HU
    assert warnings_with("what is kept", report) == []


def test_decimated_surface_whose_bones_were_counted_before_is_measured_as_it_is(
    set_scan: Any, device: Any, tmp_path: Path
) -> None:
    set_scan(make_scan(bone=0.0))

    report = mesh_scan(tmp_path, device, preset="bone", decimate=0.5)

    assert len(warnings_with("nothing here looks like bone", report)) == 1
    assert report["closed"]
    assert report["quality"]["euler_number"] == report["vertices"] - report["triangles"] // 2  # 3 edges for 2 triangles


def test_auto_warns_of_contrast_medium_and_states_its_share(set_scan: Any, device: Any, tmp_path: Path) -> None:
    set_scan(make_scan())

    report = mesh_scan(tmp_path, device, half_way="auto")

    share = report["iso_value_choice"]["flat_share"]
    assert share > CONTRAST_SAID  # of the contrast, from which on a scan is taken to have contrast medium
    assert f"{100 * share:.0f} % of the contrast ends in flat plateaus" in report["iso_value_reason"]
    assert len(warnings_with("as heart, vessels and organs with contrast medium do", report)) == 1


def test_auto_has_no_warning_in_a_scan_without_contrast_medium(set_scan: Any, device: Any, tmp_path: Path) -> None:
    set_scan(make_scan(heart=0.0))

    report = mesh_scan(tmp_path, device, half_way="auto")

    assert report["iso_value_choice"]["flat_share"] < CONTRAST_SAID
    assert "flat" not in report["iso_value_reason"]
    assert report["warnings"] == []


def test_auto_in_a_scan_of_contrast_medium_alone_is_warned_of(set_scan: Any, device: Any, tmp_path: Path) -> None:
    set_scan(make_scan(bone=0.0))

    report = mesh_scan(tmp_path, device, half_way="auto")

    assert len(warnings_with("too much to be left out of the choice", report)) == 1
    assert len(warnings_with("the surface looks like contrast medium", report)) == 1


def test_bone_in_a_scan_of_contrast_medium_alone_is_refused_and_an_older_file_stays(
    set_scan: Any, device: Any, tmp_path: Path
) -> None:
    set_scan(make_scan(bone=0.0))
    (tmp_path / "b.ply").write_bytes(b"older")

    with refused(NoSurfaceError, 200, "looks"):
        mesh_scan(tmp_path, device, iso_value=200.0, keep="bone")

    assert (tmp_path / "b.ply").read_bytes() == b"older"


def test_bone_in_values_of_8_bits_is_refused_with_their_range(set_scan: Any, device: Any, tmp_path: Path) -> None:
    scan = make_scan()
    eight_bits = np.clip((scan.voxels + 1000.0) * 255.0 / 2000.0, 0, 255).astype(np.int16)
    set_scan(Volume(eight_bits, AFFINE, {"gates": []}))

    with refused(NoSurfaceError, 600, 0, int(eight_bits.max()), "rescale"):  # no wall reaches 600 HU
        mesh_scan(tmp_path, device, iso_value=200.0, keep="bone")

    assert list(tmp_path.iterdir()) == []


def test_bone_in_values_that_are_not_known_to_be_hu_is_refused_with_the_gate(
    set_scan: Any, device: Any, tmp_path: Path
) -> None:
    scan = make_scan(bone=0.0)
    set_scan(Volume(scan.voxels, AFFINE, {"gates": [none_of("hu_known", 3, "slices")]}))

    with refused(NoSurfaceError, 600, "hu_known", "rescale"):
        mesh_scan(tmp_path, device, iso_value=200.0, keep="bone")

    assert list(tmp_path.iterdir()) == []


def test_print_of_values_that_are_not_hu_keeps_the_largest_piece_with_a_warning(
    set_scan: Any, device: Any, tmp_path: Path
) -> None:
    scan = make_scan()
    raw = np.rint((scan.voxels + 1000) * 0.3).astype(np.int16)  # 900 HU become 570: no wall reaches 600
    set_scan(Volume(raw, AFFINE, {"gates": [none_of("hu_known", 3, "slices")], "warnings": []}))
    near_half_way_to_the_heart = 365.0  # half way from 40 to 380 HU is 363

    report = mesh_scan(tmp_path, device, **settings_for("print", {"iso_value": near_half_way_to_the_heart}))

    assert report["closed"]
    assert report["volume_ml"] == pytest.approx(HEART_ML, rel=0.08)  # measured 4 % less
    (warning,) = warnings_with("nothing was left out for that", report)
    assert "not known to be HU" in warning
    assert "rescale=" in warning


def test_split_components_that_are_no_bone_are_named_in_a_warning(set_scan: Any, device: Any, tmp_path: Path) -> None:
    set_scan(make_scan())

    report = mesh_scan(tmp_path, device, iso_value=200.0, split=True, min_volume_ml=1.0)

    looks = {mesh["name"]: mesh["walls"]["looks_like"] for mesh in report["meshes"]}
    assert looks["001"] == "contrast medium"  # the heart is the largest
    assert "bone" in looks.values()
    (warning,) = warnings_with("not bone but contrast medium", report)
    assert ": 001 (" in warning


def test_split_components_that_are_kept_as_bone_are_bone(set_scan: Any, device: Any, tmp_path: Path) -> None:
    set_scan(make_scan())

    report = mesh_scan(tmp_path, device, iso_value=200.0, split=True, keep="bone")

    assert {mesh["walls"]["looks_like"] for mesh in report["meshes"]} == {"bone"}


def test_component_about_the_spinal_canal_is_kept_as_bone_where_no_wall_is_dense(
    set_scan: Any, device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bone without a compact wall, poor in mineral or in thick slices."""
    from clrecon.anatomy import spine_line

    through_the_bone = np.array([[15.0, 21.0, 30.0], [15.0, 21.0, 6.0]])  # mm
    line = spine_line.SpineLine(points=through_the_bone, sure_share=1.0, searched_mm=36.0, sure_mm=(30.0, 6.0))
    monkeypatch.setattr(spine_line, "find_spine_line", lambda volume, sure_only: line)
    set_scan(make_scan(bone=330.0))

    report = mesh_scan(tmp_path, device, iso_value=200.0, keep="bone")

    assert report["volume_ml"] == pytest.approx(BONE_ML, rel=0.2)  # measured 11 % less; the heart has 2.4 times as much
    assert len(warnings_with("the one round the spinal canal was kept", report)) == 1


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"keep": "heart"}, "not for 'heart'"),
        ({"keep": "bone", "labels": LabelChoice("a")}, "labels say what is kept"),
        ({"keep": "bone", "below": -400.0}, "neither below nor a range"),
        ({"keep": "bone", "iso_value": ((100.0, 300.0),)}, "neither below nor a range"),
    ],
)
def test_keep_is_refused_for_anything_but_bone_above_an_iso_value(settings: Any, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        MeshSettings(**settings)
