"""The picture job: order of work, what is left when a step fails, what the report says."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from refusals import refused
from variants import daily, daily_rows

from clrecon.errors import DeviceError, OutputError, RefusedInputError, UsageError
from clrecon.jobs.render.job import PictureFiles, make_pictures, name_view, path_of
from clrecon.jobs.render.picture_taker import read_function
from clrecon.jobs.render.settings import LabelLook, RenderSettings, Turntable
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.rendering.pictures.styles import Projection, VolumeLook

SIZE = (48, 40)


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A tilted, oblique, anisotropic sphere."""
    folder = tmp_path_factory.mktemp("render") / "ct"
    settings = PhantomSettings(
        kind="sphere", size=(44, 60), slices=31, spacing=(0.5, 0.7, 1.0), tilt=15.0, oblique=(20.0, 5.0, -40.0), noise=0
    )
    return folder, write_phantom(folder, settings)


def test_a_sphere_is_a_disc_of_its_size_from_every_side(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    folder, truth = sphere
    surface = truth["surface"]
    files = PictureFiles(tmp_path / "a.png", depth=tmp_path / "d.npy", report=tmp_path / "r.json")
    settings = RenderSettings.of(views=("anterior", "left", "40,-25"), size=SIZE, device=str(device.index))
    report = make_pictures(folder, files, settings)
    assert json.loads((tmp_path / "r.json").read_text()) == json.loads(json.dumps(report))
    for picture in report["pictures"]:
        depth = np.load(tmp_path / f"d_{picture['name']}.npy")
        hit = np.isfinite(depth)
        area = hit.sum() * picture["pixel_mm"] ** 2
        assert area == pytest.approx(np.pi * surface["radius_mm"] ** 2, rel=0.08)
        position, focal = (np.array(picture["camera"][f"{what}_lps_mm"]) for what in ("position", "focal_point"))
        forward = (focal - position) / np.linalg.norm(focal - position)
        nearest = (np.array(surface["center_lps_mm"]) - position) @ forward - surface["radius_mm"]
        assert float(np.nanmin(depth)) == pytest.approx(nearest, abs=0.7)


@pytest.mark.parametrize("mode", daily(1, ["dvr", "slice"]))
def test_views_have_scales_of_their_own_until_zoom_makes_them_one(
    mode: str, device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    files = PictureFiles(tmp_path / "a.png")
    settings = RenderSettings.of(mode, views=("anterior", "left", "superior"), size=SIZE, device=str(device.index))
    fitted = {made["view"]: made["pixel_mm"] for made in make_pictures(sphere[0], files, settings)["pictures"]}
    largest = max(fitted.values())
    assert min(fitted.values()) < 0.95 * largest
    for view, pixel_mm in fitted.items():
        alone = make_pictures(sphere[0], files, replace(settings, views=(view,), zoom=pixel_mm / largest))
        assert alone["pictures"][0]["pixel_mm"] == pytest.approx(largest, rel=1e-4)


def test_report_of_pictures_has_mode_device_volume_seconds_and_sizes(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    files = PictureFiles(tmp_path / "a.png", turntable=tmp_path / "frames", depth=tmp_path / "a.npy")
    settings = RenderSettings.of(
        "mip", window=(-100, 100), size=SIZE, turntable=Turntable(2), device=str(device.index), memory=10**9
    )
    report = make_pictures(sphere[0], files, settings)
    assert (report["mode"], report["device"], report["memory_allowed_bytes"]) == ("mip", device.label, 10**9)
    assert report["volume"]["tilt_deg"] == pytest.approx(15.0, abs=1e-3)
    seconds = dict(report["seconds"])
    assert seconds.pop("total") == pytest.approx(sum(seconds.values()), abs=0.01)
    assert report["turntable"]["output"]["bytes"] == sum(
        path.stat().st_size for path in (tmp_path / "frames").iterdir()
    )


def test_progress_tells_the_stages_of_pictures_in_order(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    stages: list[tuple[str, int, int]] = []
    files = PictureFiles(tmp_path / "a.png", turntable=tmp_path / "a.gif")
    settings = RenderSettings.of(size=SIZE, turntable=Turntable(3, 10.0, 90.0), device=str(device.index))
    make_pictures(sphere[0], files, settings, progress=lambda *step: stages.append(step))
    assert list(dict.fromkeys(stage for stage, _, _ in stages)) == ["device", "scan", "read", "render", "frames"]
    assert [step for step in stages if step[0] == "frames"] == [("frames", done, 3) for done in range(4)]


def test_pictures_refuse_outputs_then_files_then_device_before_the_input(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    bad = RenderSettings.of(device="abacus", transfer_function=str(tmp_path / "none.json"))
    with refused(OutputError, "nowhere"):
        make_pictures(nowhere, PictureFiles(nowhere / "a.png"), bad)
    with refused(UsageError, "none.json"):
        make_pictures(nowhere, PictureFiles(tmp_path / "a.png"), bad)
    with refused(DeviceError, "abacus"):
        make_pictures(nowhere, PictureFiles(tmp_path / "a.png"), RenderSettings.of(device="abacus"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("fails", ["encode_floats", "stage_report", "stage_animation", "second view", "commit"])
def test_a_step_that_fails_leaves_the_old_files(
    fails: str, device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {"picture": "a_left.png", "depth": "a_left.npy", "report": "a.json", "turntable": "a.gif"}
    for name in names.values():
        (tmp_path / name).write_bytes(b"old")
    views = ("left", "right") if fails == "second view" else ("left",)
    moving = None if fails == "second view" else tmp_path / "a.gif"
    stem = "a" if fails == "second view" else "a_left"
    files = PictureFiles(tmp_path / f"{stem}.png", tmp_path / f"{stem}.npy", None, moving, tmp_path / "a.json")
    settings = RenderSettings.of(
        views=views, size=SIZE, turntable=Turntable(2) if moving else None, device=str(device.index)
    )

    def fail(*_: Any, **__: Any) -> Any:
        raise OutputError("the disk is full")

    if fails == "second view":
        from clrecon.jobs.render.picture_taker import PictureTaker

        real = PictureTaker.take_view
        monkeypatch.setattr(
            PictureTaker, "take_view", lambda taker, view: fail() if view == "right" else real(taker, view)
        )
    else:
        home = {
            "encode_floats": "clrecon.jobs.render.job.encode_floats",
            "stage_report": "clrecon.jobs.run.stage_report",
            "stage_animation": "clrecon.jobs.render.job.stage_animation",
            "commit": "clrecon.system.files.StagedFile.commit",
        }[fails]
        monkeypatch.setattr(home, fail)
    with refused(OutputError, "full"):
        make_pictures(sphere[0], files, settings)
    kept = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert kept == dict.fromkeys(names.values(), b"old")


def test_a_folder_of_frames_waits_for_the_report(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = tmp_path / "frames"
    settings = RenderSettings.of(size=SIZE, turntable=Turntable(2), device=str(device.index))
    make_pictures(sphere[0], PictureFiles(turntable=frames), settings)
    older = {path.name: path.read_bytes() for path in frames.iterdir()}

    def fail(*_: Any) -> Any:
        raise OutputError("the disk is full")

    other = replace(settings, turntable=Turntable(3), views=("left",))
    with monkeypatch.context() as patch, refused(OutputError, "full"):
        patch.setattr("clrecon.jobs.run.stage_report", fail)
        make_pictures(sphere[0], PictureFiles(turntable=frames, report=tmp_path / "a.json"), other)
    assert {path.name: path.read_bytes() for path in frames.iterdir()} == older
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
    make_pictures(sphere[0], PictureFiles(turntable=frames, report=tmp_path / "a.json"), other)
    assert sorted(path.name for path in frames.iterdir()) == [f"frame_000{number}.png" for number in range(3)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "frames"]


def test_the_report_calls_a_folder_a_folder(device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    settings = RenderSettings.of(size=SIZE, turntable=Turntable(2), background="transparent", device=str(device.index))
    made = make_pictures(sphere[0], PictureFiles(turntable=f"{tmp_path}/v1.2/"), settings)
    again = make_pictures(sphere[0], PictureFiles(turntable=tmp_path / "v1.2"), settings)
    assert [report["turntable"]["output"]["format"] for report in (made, again)] == ["folder", "folder"]
    (tmp_path / "v1.2").rename(tmp_path / "v1.gif")
    assert make_pictures(sphere[0], PictureFiles(turntable=tmp_path / "v1.gif"), settings)["turntable"]["frames"] == 2


@pytest.mark.skipif(os.name != "posix", reason="the limit of open files is that of POSIX systems")
def test_many_views_raise_the_limit_of_open_files(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    import resource

    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    settings = RenderSettings.of(views=[f"{angle},0" for angle in range(60)], size=(8, 8), device=str(device.index))
    with open(os.devnull) as file:
        resource.setrlimit(resource.RLIMIT_NOFILE, (file.fileno() + 30, limits[1]))
    try:
        report = make_pictures(sphere[0], PictureFiles(tmp_path / "a.png", tmp_path / "a.npy"), settings)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert len(report["pictures"]) == 60 and len(list(tmp_path.iterdir())) == 120


def test_nothing_else_goes_into_the_folder_of_frames(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    files = PictureFiles(turntable=tmp_path / "frames", report=tmp_path / "frames" / "a.json")
    with refused(UsageError, "frames", "report"):
        make_pictures(tmp_path / "nowhere", files, RenderSettings.of(turntable=Turntable(2)))
    assert list((tmp_path / "frames").iterdir()) == []


def test_a_volume_in_slabs_is_the_same_picture(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    found = []
    for memory in (None, 130_000):
        settings = RenderSettings.of(size=SIZE, views=("30,20",), device=str(device.index), memory=memory)
        report = make_pictures(sphere[0], PictureFiles(tmp_path / "a.png"), settings)
        found.append((report["pictures"][0]["slabs"], np.asarray(Image.open(tmp_path / "a.png")).astype(int)))
    assert found[0][0] == 1 < found[1][0]
    assert np.abs(found[0][1] - found[1][1]).max() <= 2


def test_an_x_ray_is_a_sum_in_mm_of_water(device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    """The window runs over the rays that meet the body, and is in mm of water where it is given too."""
    files = PictureFiles(tmp_path / "a.png", values=tmp_path / "v.npy")
    settings = RenderSettings.of(preset="x-ray", size=SIZE, device=str(device.index))
    report = make_pictures(sphere[0], files, settings)
    picture, values = report["pictures"][0], np.load(tmp_path / "v.npy")
    most = float(values.max())
    assert report["mode"] == "drr" and picture["values_hu"] is None and picture["window_hu"] is None
    assert picture["values_mm_water"] == [0.0, pytest.approx(most)]
    low, high = picture["window_mm_water"]
    assert 0.05 * most < low < high <= most
    windowed = replace(settings, style=Projection("drr", window=(0.0, 2.0 * most)))
    told = make_pictures(sphere[0], files, windowed)["pictures"][0]
    assert told["window_mm_water"] == [0.0, pytest.approx(2.0 * most)]
    assert np.asarray(Image.open(tmp_path / "a.png").convert("L")).max() in (127, 128)


FAR = (5000, 0, 0, 1, 0, 0)
"""A clip plane that leaves nothing of the scan."""


@pytest.mark.parametrize(
    ("settings", "words"),
    daily_rows(
        4,
        [
            ({"preset": "x-ray", "clip_planes": [FAR]}, "black.*mm of water"),
            ({"iso_value": 30000.0}, "mode surface"),
            ({"clip_planes": [FAR]}, "mode dvr"),
            ({"clip_planes": [FAR], "mode": "mip"}, "mode mip"),
            ({"preset": "minip", "keep_air": True}, "picture is black.*do not keep it"),
            ({"mode": "slice", "window": (20000, 30000)}, "picture is black"),
            ({"mode": "slice", "window": (-30000, -20000)}, "picture is white"),
        ],
    ),
)
def test_a_picture_of_nothing_says_so(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path, settings: dict[str, Any], words: str
) -> None:
    looks = RenderSettings.of(size=SIZE, device=str(device.index), **settings)
    report = make_pictures(sphere[0], PictureFiles(tmp_path / "a.png"), looks)
    assert [text for text in report["warnings"] if re.search(words, text)]
    if looks.mode != "slice":
        turning = replace(looks, turntable=Turntable(2))
        report = make_pictures(sphere[0], PictureFiles(turntable=tmp_path / "b.gif"), turning)
        assert [text for text in report["warnings"] if re.search(words, text)]
    fine = make_pictures(
        sphere[0], PictureFiles(tmp_path / "a.png"), RenderSettings.of(size=SIZE, device=str(device.index))
    )
    assert not [text for text in fine["warnings"] if "picture is" in text or "nothing" in text]


def test_views_name_their_files() -> None:
    assert [name_view(view, ("left", "30,-5.50")) for view in ("left", "30,-5.50")] == ["left", "az30_el-5.5"]
    assert name_view("left", ("left",)) == ""
    assert (path_of("x/a.png", "left"), path_of("x/a.png", "")) == ("x/a_left.png", "x/a.png")


def test_render_settings_choose_mode_preset_and_view() -> None:
    assert [settings.mode for settings in (
        RenderSettings.of(), RenderSettings.of(preset="x-ray"), RenderSettings.of(iso_value=0.0),
        RenderSettings.of(curve="auto"), RenderSettings.of(preset="x-ray", mode="dvr"),
    )] == ["dvr", "drr", "surface", "cpr", "dvr"]  # fmt: skip
    assert (RenderSettings.of().preset_used, RenderSettings.of("mip").preset_used) == ("bone", None)
    assert (RenderSettings.of("slice").views_used, RenderSettings.of().views_used) == (("axial",), ("anterior",))
    style = RenderSettings.of(clip_box=(-1, 1, -2, 2, 0, float("inf"))).style
    assert isinstance(style, VolumeLook) and style.clip is not None


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"turntable": Turntable(), "views": ("left", "right")}, "one view"),
        ({"thickness": -1.0, "mode": "slice"}, "thickness"),
        ({"combine": "sum", "mode": "slice"}, "mean, max, min"),
        ({"offset_mm": float("nan"), "mode": "slice"}, "offset"),
        ({"curve": "auto", "cpr": "bent"}, "straightened or stretched"),
        ({"curve": "auto", "views": ("left", "right")}, "one view"),
        ({"memory": 0}, "memory"),
        ({"field_of_view": -3.0}, "field of view"),
        ({"iso_value": float("inf")}, "iso value"),
        ({"ray_step": float("nan")}, "ray step"),
        ({"light": (0, 0, 0)}, "direction of a light"),
        ({"clip_planes": [(0, 0, 0, 1)]}, "six numbers"),
        ({"clip_box": (0, 1)}, "six numbers"),
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        RenderSettings.of(**wrong)


def test_impossible_labels_are_refused() -> None:
    with refused(UsageError, "octarine"):
        LabelLook("a.nii", {"L1": "octarine"})
    with refused(UsageError, "L1", 1.5):
        LabelLook("a.nii", {}, {"L1": 1.5})


def test_functions_are_named_by_file_and_name(tmp_path: Path) -> None:
    points = [{"hu": hu, "color": [1, 1, 1], "opacity": opacity} for hu, opacity in ((0, 0), (9, 1))]
    content = {"format": "clrecon transfer function", "version": 1, "name": "glass", "points": points}
    path = tmp_path / "a:b.json"
    path.write_text(json.dumps(content))
    for named in (str(path), f"{path}:glass"):
        function = read_function(named)
        assert function is not None and function.points[1, 0] == 9
    with refused(UsageError, "glass"):
        read_function(f"{path}:stone")
    (tmp_path / "bad.json").write_text("{}")
    with refused(RefusedInputError, "bad.json"):
        read_function(str(tmp_path / "bad.json"))
    assert read_function(None) is None


def test_slices_show_by_default_and_the_report_names_their_view(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    settings = RenderSettings.of("slices", size=SIZE, device=str(device.index))
    report = make_pictures(sphere[0], PictureFiles(tmp_path / "a.png"), settings)
    assert report["pictures"][0]["hit_share"] > 0.1 and not [text for text in report["warnings"] if "edge-on" in text]
    assert report["pictures"][0]["view"] == "30,30"


def test_a_sheet_is_reported_with_its_slices_and_labels(
    device: Any, sphere: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    from clrecon.labels import LabelMap
    from clrecon.labels.label_map import encode_nifti
    from clrecon.reading import read_volume

    volume = read_volume(sphere[0])
    numbers = (volume.voxels > 100).astype(np.uint8)
    ball = encode_nifti(LabelMap(numbers, volume.affine, {1: "ball"}), packed=True)
    (tmp_path / "ball.nii.gz").write_bytes(ball)
    labels = LabelLook(str(tmp_path / "ball.nii.gz"), {"1": "#ff0000"})
    settings = RenderSettings.of(sheet=6, labels=labels, letters=True, scale_bar=True, device=str(device.index))
    assert settings.mode == "slice" and settings.size_used == (1600, 1200) and settings.is_sheet
    report = make_pictures(sphere[0], PictureFiles(tmp_path / "a.png", values=tmp_path / "v.npy"), settings)
    picture = report["pictures"][0]
    assert picture["size"] == [1600, 1200] and len(picture["tiles"]) == 6 and picture["camera"] is None
    assert [entry["color"] for entry in picture["labels"]] == ["#ff0000"]
    image, values = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int), np.load(tmp_path / "v.npy")
    assert ((image[..., 0] - image[..., 1]) > 30).sum() == pytest.approx((values > 100).sum(), rel=0.15)
    with refused(UsageError, "sheet", "depths"):
        make_pictures(sphere[0], PictureFiles(tmp_path / "a.png", depth=tmp_path / "d.npy"), settings)


def test_a_minimum_says_what_it_leaves_out_and_regions_go_too(device: Any, tmp_path: Path) -> None:
    """A ball of tissue in air; a region leaves a part of it, and no air round that."""
    folder = tmp_path / "ct"
    truth = write_phantom(
        folder, PhantomSettings(kind="sphere", size=(60, 60), slices=40, spacing=(2.0, 2.0, 2.0), noise=0, seed=1)
    )
    x, y, z = truth["surface"]["center_lps_mm"]
    box = f"box:{x - 20},{x + 20},{y - 20},{y + 20},{z - 20},{z + 20}"
    found = []
    for region in (None, [box]):
        files = PictureFiles(tmp_path / "a.png", values=tmp_path / "v.npy")
        settings = RenderSettings.of("minip", size=SIZE, device=str(device.index), region=region)
        report = make_pictures(folder, files, settings)
        values, said = np.load(tmp_path / "v.npy"), report["pictures"][0]["left_out"]
        assert said["body"] and said["region"] == (region is not None)
        assert any("is left out:" in text for text in report["warnings"]) == (region is not None)
        assert np.nanmin(values) > -300.0 and report["volume"]["hu_range"][0] < -900.0
        assert report["volume"]["hu_range"][1] < 5000.0
        found.append((said["share"], int(np.isfinite(values).sum())))
    assert 0.5 < found[0][0] < found[1][0] < 1.0 and found[1][1] > 20
