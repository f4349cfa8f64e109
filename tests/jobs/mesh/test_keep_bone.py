"""``keep="bone"``: bone by its walls, never a heart in silence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.purposes import settings_for
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.system.records import none_of

AFFINE = np.diag((1.0, 1.0, 1.5, 1.0))
HEART_ML, BONE_ML = 4 / 3 * np.pi * 12**3 / 1000, 4 / 3 * np.pi * 9**3 / 1000


def make_scan(heart: float = 380.0, bone: float = 900.0) -> Volume:
    """A heart larger than a bone with marrow, in tissue, in air."""
    from scipy.ndimage import gaussian_filter

    k, j, i = np.indices((24, 44, 72))
    hu = np.where((j > 3) & (j < 40), 40.0, -1000.0)
    for at_i, radius, value in ((50, 12, heart), (15, 9, bone), (15, 6.5, 120.0)):
        if value:
            hu[(i - at_i) ** 2 + (j - 21) ** 2 + (1.5 * (k - 12)) ** 2 < radius**2] = value
    hu = gaussian_filter(hu, 0.7) + np.random.default_rng(0).normal(0, 10, hu.shape)
    voxels = np.rint(hu).astype(np.int16)
    return Volume(voxels, AFFINE, {"hu_range": [float(voxels.min()), float(voxels.max())], "warnings": []})


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Any:
    def use(volume: Volume) -> None:
        monkeypatch.setattr("clrecon.reading.dicom.reader.read_series", lambda source, selection, progress: volume)

    return use


def run(tmp_path: Path, device: Any, **settings: Any) -> dict[str, Any]:
    return make_mesh("scan", tmp_path / "b.ply", MeshSettings(device=str(device.index), **settings), measure=True)


@pytest.mark.parametrize("level", [{"iso_value": 200.0}, {"preset": "bone"}])
def test_a_heart_is_never_kept_in_silence(level: Any, read: Any, device: Any, tmp_path: Path) -> None:
    read(make_scan())
    largest = run(tmp_path, device, keep_largest=1, **level)
    assert largest["walls"]["looks_like"] == "contrast medium"
    assert largest["volume_ml"] == pytest.approx(HEART_ML, rel=0.15)
    (said,) = [text for text in largest["warnings"] if "what is kept looks like contrast medium" in text]
    assert "reach 600 at 0.0 %; keep='bone'" in said
    bone = run(tmp_path, device, keep="bone", keep_largest=1, **level)
    assert bone["walls"]["looks_like"] == "bone"
    assert BONE_ML < bone["volume_ml"] < 0.6 * HEART_ML  # 200 HU lies outside of half way
    assert not any("what is kept" in text for text in bone["warnings"])
    assert (bone["keep"], bone["components_kept"], largest["keep"]) == ("bone", 1, None)


def test_auto_says_that_there_is_contrast_medium(read: Any, device: Any, tmp_path: Path) -> None:
    read(make_scan())
    report = run(tmp_path, device, half_way="auto")
    share = report["iso_value_choice"]["flat_share"]
    assert share > 0.05
    assert f"{100 * share:.0f} % of the contrast ends in flat plateaus" in report["iso_value_reason"]
    assert any("as heart, vessels and organs with contrast medium do" in text for text in report["warnings"])
    read(make_scan(heart=0.0))
    report = run(tmp_path, device, half_way="auto")
    assert report["iso_value_choice"]["flat_share"] < 0.05
    assert report["warnings"] == []
    assert "flat" not in report["iso_value_reason"]


def test_a_surface_of_contrast_medium_alone_is_warned_of(read: Any, device: Any, tmp_path: Path) -> None:
    read(make_scan(bone=0.0))
    warnings = run(tmp_path, device, half_way="auto")["warnings"]
    assert any("too much to be left out of the choice" in text for text in warnings)
    assert any("the surface looks like contrast medium" in text for text in warnings)


def test_bone_in_a_scan_of_contrast_medium_alone_is_refused_and_an_older_file_stays(
    read: Any, device: Any, tmp_path: Path
) -> None:
    read(make_scan(bone=0.0))
    (tmp_path / "b.ply").write_bytes(b"older")
    with refused(NoSurfaceError, 200, "looks"):
        run(tmp_path, device, iso_value=200.0, keep="bone")
    assert (tmp_path / "b.ply").read_bytes() == b"older"


@pytest.mark.parametrize(
    ("scale", "gates", "said"),
    [
        (255.0 / 2000.0, [], "the values of this scan run from 0 to {:g}: say how HU follow from them"),
        (1.0, [none_of("hu_known", 3, "slices")], "the values of this scan are not known to be HU (hu_known): say how"),
    ],
    ids=["8 bits", "raw"],
)
def test_values_on_another_scale_are_named_where_nothing_looks_like_bone(
    scale: float, gates: list[Any], said: str, read: Any, device: Any, tmp_path: Path
) -> None:
    scan = make_scan(bone=0.0 if gates else 900.0)
    shown = scan if gates else scan.with_voxels(np.clip((scan.voxels + 1000.0) * scale, 0, 255).astype(np.int16))
    read(Volume(shown.voxels, shown.affine, {"gates": gates}))
    with pytest.raises(NoSurfaceError) as caught:
        run(tmp_path, device, iso_value=200.0, keep="bone")
    assert f"; bone is told by walls of 600 HU, and {said.format(shown.voxels.max())}" in str(caught.value)
    assert "rescale=" in str(caught.value) and not list(tmp_path.glob("b.*"))


def test_a_print_of_raw_values_at_a_level_of_their_own_keeps_its_largest_piece(
    read: Any, device: Any, tmp_path: Path
) -> None:
    scan = make_scan()
    voxels = np.rint((scan.voxels + 1000) * 0.3).astype(np.int16)  # no wall reaches 600
    read(Volume(voxels, AFFINE, {"gates": [none_of("hu_known", 3, "slices")], "warnings": []}))
    report = run(tmp_path, device, **settings_for("print", {"iso_value": 365.0}))
    (said,) = [text for text in report["warnings"] if "nothing was left out for that" in text]
    assert "not known to be HU" in said and "rescale=" in said
    assert report["volume_ml"] == pytest.approx(HEART_ML, rel=0.1) and report["closed"]


def test_pieces_say_which_of_them_are_no_bone(read: Any, device: Any, tmp_path: Path) -> None:
    read(make_scan())
    report = run(tmp_path, device, iso_value=200.0, split=True, min_volume_ml=1.0)
    looks = {mesh["name"]: mesh["walls"]["looks_like"] for mesh in report["meshes"]}
    assert looks["001"] == "contrast medium"
    assert "bone" in looks.values()
    (said,) = [text for text in report["warnings"] if text.startswith("not bone but contrast medium")]
    assert ": 001 (" in said
    kept = run(tmp_path, device, iso_value=200.0, split=True, keep="bone")
    assert {mesh["walls"]["looks_like"] for mesh in kept["meshes"]} == {"bone"}


def test_the_component_round_the_spinal_canal_is_kept_where_no_wall_tells(
    read: Any, device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bone without a compact wall, poor in mineral or in thick slices."""
    from clrecon.anatomy import spine_line

    line = spine_line.SpineLine(np.array([[15.0, 21.0, 30.0], [15.0, 21.0, 6.0]]), 1.0, 36.0, (30.0, 6.0))
    monkeypatch.setattr(spine_line, "find_spine_line", lambda volume, sure_only: line)
    read(make_scan(bone=330.0))
    report = run(tmp_path, device, iso_value=200.0, keep="bone")
    assert report["volume_ml"] == pytest.approx(BONE_ML, rel=0.2)
    assert any("the one round the spinal canal was kept" in text for text in report["warnings"])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"keep": "heart"}, "not for 'heart'"),
        ({"keep": "bone", "labels": LabelChoice("a")}, "labels say what is kept"),
        ({"keep": "bone", "below": -400.0}, "neither below nor a range"),
        ({"keep": "bone", "iso_value": ((100.0, 300.0),)}, "neither below nor a range"),
    ],
)
def test_settings_that_exclude_each_other_are_refused(settings: Any, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        MeshSettings(**settings)
