"""The picture job: order of work, what is left when a step fails, what the report says."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from refusals import refused
from variants import daily, daily_rows

from clrecon.errors import DeviceError, OutputError, RefusedInputError, UsageError
from clrecon.jobs.render.job import PictureFiles, make_pictures, name_view, path_of
from clrecon.jobs.render.picture_taker import PictureTaker, read_function
from clrecon.jobs.render.settings import LabelLook, RenderSettings, Turntable
from clrecon.labels import LabelMap
from clrecon.labels.label_map import encode_nifti
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.reading import read_volume
from clrecon.rendering.pictures.styles import Projection, VolumeLook

SIZE = (48, 40)


@pytest.fixture(scope="module")
def sphere_and_truth(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a tilted, oblique, anisotropic CT of a sphere, and its truth."""
    folder = tmp_path_factory.mktemp("render") / "ct"
    settings = PhantomSettings(
        kind="sphere", size=(44, 60), slices=31, spacing=(0.5, 0.7, 1.0), tilt=15.0, oblique=(20.0, 5.0, -40.0), noise=0
    )
    return folder, write_phantom(folder, settings)


@pytest.fixture(scope="module")
def sphere(sphere_and_truth: tuple[Path, dict[str, Any]]) -> Path:
    """The folder of the CT of a sphere."""
    folder, _ = sphere_and_truth
    return folder


@pytest.fixture(scope="module")
def true_surface(sphere_and_truth: tuple[Path, dict[str, Any]]) -> dict[str, Any]:
    """Radius and centre of the sphere."""
    _, truth = sphere_and_truth
    return truth["surface"]


@pytest.fixture(scope="module")
def views_of_sphere(device: Any, sphere: Path, tmp_path_factory: Any) -> tuple[Path, Any]:
    """The folder with r.json and the depths d_VIEW.npy of the sphere from three sides, and the report."""
    folder = tmp_path_factory.mktemp("views")
    files = PictureFiles(folder / "a.png", depth=folder / "d.npy", report=folder / "r.json")
    settings = RenderSettings.of(views=("anterior", "left", "40,-25"), size=SIZE, device=str(device.index))
    return folder, make_pictures(sphere, files, settings)


def test_sphere_is_a_disc_of_its_area_from_three_sides(views_of_sphere: tuple[Path, Any], true_surface: Any) -> None:
    folder, report = views_of_sphere
    radius_mm = true_surface["radius_mm"]

    areas = [
        np.isfinite(np.load(folder / f"d_{picture['name']}.npy")).sum() * picture["pixel_mm"] ** 2
        for picture in report["pictures"]
    ]

    assert areas == [pytest.approx(np.pi * radius_mm**2, rel=0.08)] * 3  # pixels of a tenth of the radius


def test_least_depth_of_a_sphere_is_that_of_its_nearest_point_from_three_sides(
    views_of_sphere: tuple[Path, Any], true_surface: Any
) -> None:
    folder, report = views_of_sphere
    assert len(report["pictures"]) == 3

    for picture in report["pictures"]:
        camera = picture["camera"]
        position, focal = np.array(camera["position_lps_mm"]), np.array(camera["focal_point_lps_mm"])
        forward = (focal - position) / np.linalg.norm(focal - position)
        nearest_mm = (np.array(true_surface["center_lps_mm"]) - position) @ forward - true_surface["radius_mm"]
        depth = np.load(folder / f"d_{picture['name']}.npy")
        assert float(np.nanmin(depth)) == pytest.approx(nearest_mm, abs=0.7)  # voxels of up to 1 mm


def test_written_report_of_pictures_is_the_returned_one(views_of_sphere: tuple[Path, Any]) -> None:
    folder, report = views_of_sphere
    assert json.loads((folder / "r.json").read_text()) == json.loads(json.dumps(report))


@pytest.mark.parametrize("mode", daily(1, ["dvr", "slice"]))
def test_views_fit_scales_of_their_own_which_zoom_makes_one(
    mode: str, device: Any, sphere: Path, tmp_path: Path
) -> None:
    files = PictureFiles(tmp_path / "a.png")
    settings = RenderSettings.of(mode, views=("anterior", "left", "superior"), size=SIZE, device=str(device.index))
    fitted = {made["view"]: made["pixel_mm"] for made in make_pictures(sphere, files, settings)["pictures"]}
    largest = max(fitted.values())
    assert min(fitted.values()) < 0.95 * largest  # measured 0.76: they differ
    for view, pixel_mm in fitted.items():
        zoomed = replace(settings, views=(view,), zoom=pixel_mm / largest)
        (picture,) = make_pictures(sphere, files, zoomed)["pictures"]
        assert picture["pixel_mm"] == pytest.approx(largest, rel=1e-9)  # float64


@pytest.fixture(scope="module")
def mip_and_turntable(device: Any, sphere: Path, tmp_path_factory: Any) -> tuple[Path, Any]:
    """The folder of a.png, a.npy and two frames in frames/ of a maximum intensity projection, and the report."""
    folder = tmp_path_factory.mktemp("mip")
    files = PictureFiles(folder / "a.png", turntable=folder / "frames", depth=folder / "a.npy")
    settings = RenderSettings.of(
        "mip", window=(-100, 100), size=SIZE, turntable=Turntable(2), device=str(device.index), memory=10**9
    )
    return folder, make_pictures(sphere, files, settings)


def test_report_of_pictures_has_mode_device_memory_and_tilt(mip_and_turntable: tuple[Path, Any], device: Any) -> None:
    _, report = mip_and_turntable

    assert (report["mode"], report["device"], report["memory_allowed_bytes"]) == ("mip", device.label, 10**9)
    assert report["volume"]["tilt_deg"] == pytest.approx(15.0, abs=1e-3)  # directions of 9 decimals


def test_times_of_pictures_sum_to_the_total(mip_and_turntable: tuple[Path, Any]) -> None:
    _, report = mip_and_turntable
    seconds = dict(report["seconds"])
    total = seconds.pop("total")
    assert total == pytest.approx(sum(seconds.values()), abs=0.01)  # each is rounded to 0.1 ms


def test_report_of_a_turntable_has_the_bytes_of_its_frames(mip_and_turntable: tuple[Path, Any]) -> None:
    folder, report = mip_and_turntable
    sizes = [path.stat().st_size for path in (folder / "frames").iterdir()]
    assert len(sizes) == 2
    assert report["turntable"]["output"]["bytes"] == sum(sizes)


def test_progress_of_pictures_names_its_stages_in_order_and_counts_frames(
    device: Any, sphere: Path, tmp_path: Path
) -> None:
    stages: list[tuple[str, int, int]] = []
    files = PictureFiles(tmp_path / "a.png", turntable=tmp_path / "a.gif")
    settings = RenderSettings.of(size=SIZE, turntable=Turntable(frames=3), device=str(device.index))
    make_pictures(sphere, files, settings, progress=lambda *step: stages.append(step))
    assert list(dict.fromkeys(stage for stage, _, _ in stages)) == ["device", "scan", "read", "render", "frames"]
    assert [step for step in stages if step[0] == "frames"] == [("frames", done, 3) for done in range(4)]


@pytest.mark.parametrize(
    ("output", "function", "error", "fact"),
    [
        pytest.param("nowhere/a.png", "none.json", OutputError, "nowhere", id="output folder first"),
        pytest.param("a.png", "none.json", UsageError, "none.json", id="then files of settings"),
        pytest.param("a.png", None, DeviceError, "abacus", id="then the device"),
    ],
)
def test_pictures_of_a_missing_scan_are_refused_for_other_faults_before_it(
    output: str, function: str | None, error: type[Exception], fact: str, tmp_path: Path
) -> None:
    settings = RenderSettings.of(device="abacus", transfer_function=function and str(tmp_path / function))

    with refused(error, fact):
        make_pictures(tmp_path / "no scan", PictureFiles(tmp_path / output), settings)

    assert list(tmp_path.iterdir()) == []


def fail(*_: Any, **__: Any) -> Any:
    raise OutputError("the disk is full")


@pytest.mark.parametrize(
    "failing_step",
    [
        "clrecon.jobs.render.job.encode_floats",
        "clrecon.jobs.run.stage_report",
        "clrecon.jobs.render.job.stage_animation",
        "clrecon.system.files.StagedFile.commit",
    ],
    ids=["depths", "report", "movie", "last step"],
)
def test_older_files_of_a_picture_stay_where_one_of_them_cannot_be_written(
    failing_step: str, device: Any, sphere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["a.png", "a.npy", "a.json", "a.gif"]
    for name in names:
        (tmp_path / name).write_bytes(b"old")
    picture, depth, report, movie = (tmp_path / name for name in names)
    settings = RenderSettings.of(views=("left",), size=SIZE, turntable=Turntable(2), device=str(device.index))

    monkeypatch.setattr(failing_step, fail)
    with refused(OutputError, "full"):
        make_pictures(sphere, PictureFiles(picture, depth=depth, turntable=movie, report=report), settings)

    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(names, b"old")


def test_older_picture_of_a_first_view_stays_where_the_second_cannot_be_taken(
    device: Any, sphere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a_left.png").write_bytes(b"old")
    settings = RenderSettings.of(views=("left", "right"), size=SIZE, device=str(device.index))
    take_view = PictureTaker.take_view

    monkeypatch.setattr(
        PictureTaker, "take_view", lambda taker, view: fail() if view == "right" else take_view(taker, view)
    )
    with refused(OutputError, "full"):
        make_pictures(sphere, PictureFiles(tmp_path / "a.png"), settings)

    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a_left.png": b"old"}


@pytest.fixture
def two_frames(device: Any, sphere: Path, tmp_path: Path) -> tuple[Path, RenderSettings]:
    """The folder of a turntable of two frames, and settings for one of three."""
    settings = RenderSettings.of(size=SIZE, turntable=Turntable(2), device=str(device.index))
    make_pictures(sphere, PictureFiles(turntable=tmp_path / "frames"), settings)
    return tmp_path / "frames", replace(settings, turntable=Turntable(3), views=("left",))


def test_older_folder_of_frames_stays_where_the_report_cannot_be_written(
    two_frames: tuple[Path, RenderSettings], sphere: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    frames, settings = two_frames
    older = {path.name: path.read_bytes() for path in frames.iterdir()}

    monkeypatch.setattr("clrecon.jobs.run.stage_report", fail)
    with refused(OutputError, "full"):
        make_pictures(sphere, PictureFiles(turntable=frames, report=tmp_path / "a.json"), settings)

    assert {path.name: path.read_bytes() for path in frames.iterdir()} == older
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


def test_folder_of_frames_is_replaced_together_with_the_report(
    two_frames: tuple[Path, RenderSettings], sphere: Path, tmp_path: Path
) -> None:
    frames, settings = two_frames

    make_pictures(sphere, PictureFiles(turntable=frames, report=tmp_path / "a.json"), settings)

    assert sorted(path.name for path in frames.iterdir()) == [f"frame_000{number}.png" for number in range(3)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "frames"]


@pytest.mark.parametrize("name", ["v1.2/", "v1.2"], ids=["slash at the end", "no slash"])
def test_folder_of_frames_with_a_dot_in_its_name_is_reported_as_a_folder(
    name: str, device: Any, sphere: Path, tmp_path: Path
) -> None:
    (tmp_path / "v1.2").mkdir()
    settings = RenderSettings.of(size=SIZE, turntable=Turntable(2), background="transparent", device=str(device.index))

    report = make_pictures(sphere, PictureFiles(turntable=f"{tmp_path}/{name}"), settings)

    assert report["turntable"]["output"]["format"] == "folder"


def test_earlier_folder_of_frames_named_as_a_movie_takes_new_frames(device: Any, sphere: Path, tmp_path: Path) -> None:
    settings = RenderSettings.of(size=SIZE, turntable=Turntable(2), background="transparent", device=str(device.index))
    make_pictures(sphere, PictureFiles(turntable=f"{tmp_path}/frames/"), settings)
    (tmp_path / "frames").rename(tmp_path / "v1.gif")

    report = make_pictures(sphere, PictureFiles(turntable=tmp_path / "v1.gif"), settings)

    assert report["turntable"]["frames"] == len(list((tmp_path / "v1.gif").iterdir())) == 2


@pytest.mark.skipif(os.name != "posix", reason="the limit of open files is that of POSIX systems")
def test_more_views_than_open_files_are_allowed_are_written_where_the_limit_can_be_raised(
    device: Any, sphere: Path, tmp_path: Path
) -> None:
    import resource

    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    settings = RenderSettings.of(views=[f"{angle},0" for angle in range(60)], size=(8, 8), device=str(device.index))
    with open(os.devnull) as file:
        resource.setrlimit(resource.RLIMIT_NOFILE, (file.fileno() + 30, limits[1]))
    try:
        report = make_pictures(sphere, PictureFiles(tmp_path / "a.png", depth=tmp_path / "a.npy"), settings)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert len(report["pictures"]) == 60 and len(list(tmp_path.iterdir())) == 120


def test_report_within_the_folder_of_frames_is_refused(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    files = PictureFiles(turntable=tmp_path / "frames", report=tmp_path / "frames" / "a.json")
    with refused(UsageError, "frames", "report"):
        make_pictures(tmp_path / "nowhere", files, RenderSettings.of(turntable=Turntable(2)))
    assert list((tmp_path / "frames").iterdir()) == []


def test_picture_of_a_volume_in_slabs_is_that_of_the_whole(device: Any, sphere: Path, tmp_path: Path) -> None:
    def draw_with(memory: int | None) -> tuple[int, np.ndarray]:
        settings = RenderSettings.of(size=SIZE, views=("30,20",), device=str(device.index), memory=memory)
        report = make_pictures(sphere, PictureFiles(tmp_path / "a.png"), settings)
        (picture,) = report["pictures"]
        return picture["slabs"], np.asarray(Image.open(tmp_path / "a.png")).astype(int)

    slabs_of_whole, whole = draw_with(memory=None)
    slabs, in_slabs = draw_with(memory=250_000)

    assert slabs_of_whole == 1
    assert slabs > 1
    assert np.abs(in_slabs - whole).max() <= 2  # of 255: rounding at the borders of slabs


def test_x_ray_is_a_sum_in_mm_of_water_with_a_window_within_its_values(
    device: Any, sphere: Path, tmp_path: Path
) -> None:
    settings = RenderSettings.of(preset="x-ray", size=SIZE, device=str(device.index))

    report = make_pictures(sphere, PictureFiles(tmp_path / "a.png", values=tmp_path / "v.npy"), settings)

    (picture,), most_mm = report["pictures"], float(np.load(tmp_path / "v.npy").max())
    assert report["mode"] == "drr"
    assert (picture["values_hu"], picture["window_hu"]) == (None, None)
    assert picture["values_mm_water"] == [0.0, pytest.approx(most_mm)]
    low, high = picture["window_mm_water"]
    assert 0.05 * most_mm < low < high <= most_mm  # of the rays that meet the body


def test_given_window_of_an_x_ray_is_in_mm_of_water(device: Any, sphere: Path, tmp_path: Path) -> None:
    files = PictureFiles(tmp_path / "a.png", values=tmp_path / "v.npy")
    settings = RenderSettings.of(preset="x-ray", size=SIZE, device=str(device.index))
    make_pictures(sphere, files, settings)
    twice_the_most_mm = 2.0 * float(np.load(tmp_path / "v.npy").max())

    windowed = replace(settings, style=Projection("drr", window=(0.0, twice_the_most_mm)))
    (picture,) = make_pictures(sphere, files, windowed)["pictures"]

    assert picture["window_mm_water"] == [0.0, pytest.approx(twice_the_most_mm)]
    middle_grey = (127, 128)
    assert np.asarray(Image.open(tmp_path / "a.png").convert("L")).max() in middle_grey


FAR = (5000, 0, 0, 1, 0, 0)
"""A clip plane that leaves nothing of the scan."""


EMPTY_LOOKS = daily_rows(
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
)
"""Settings of a picture that shows nothing, and what its warning says."""


@pytest.mark.parametrize(("settings", "words"), EMPTY_LOOKS)
def test_picture_that_shows_nothing_is_warned_of(
    device: Any, sphere: Path, tmp_path: Path, settings: dict[str, Any], words: str
) -> None:
    looks = RenderSettings.of(size=SIZE, device=str(device.index), **settings)
    report = make_pictures(sphere, PictureFiles(tmp_path / "a.png"), looks)
    assert any(re.search(words, text) for text in report["warnings"])


@pytest.mark.parametrize(("settings", "words"), EMPTY_LOOKS[:5])  # a slice does not turn
def test_turntable_that_shows_nothing_is_warned_of(
    device: Any, sphere: Path, tmp_path: Path, settings: dict[str, Any], words: str
) -> None:
    looks = RenderSettings.of(size=SIZE, turntable=Turntable(2), device=str(device.index), **settings)
    report = make_pictures(sphere, PictureFiles(turntable=tmp_path / "b.gif"), looks)
    assert any(re.search(words, text) for text in report["warnings"])


def test_picture_that_shows_a_sphere_has_no_warning_of_emptiness(device: Any, sphere: Path, tmp_path: Path) -> None:
    settings = RenderSettings.of(size=SIZE, device=str(device.index))
    report = make_pictures(sphere, PictureFiles(tmp_path / "a.png"), settings)
    assert not any("picture is" in text or "nothing" in text for text in report["warnings"])


def test_several_views_name_their_files_by_their_word_or_angles() -> None:
    views = ("left", "30,-5.50")
    assert [name_view(view, views) for view in views] == ["left", "az30_el-5.5"]
    assert path_of("x/a.png", "left") == "x/a_left.png"


def test_single_view_does_not_name_its_file() -> None:
    assert name_view("left", ("left",)) == ""
    assert path_of("x/a.png", "") == "x/a.png"


@pytest.mark.parametrize(
    ("settings", "mode"),
    [
        ({}, "dvr"),
        ({"preset": "x-ray"}, "drr"),
        ({"iso_value": 0.0}, "surface"),
        ({"curve": "auto"}, "cpr"),
        ({"preset": "x-ray", "mode": "dvr"}, "dvr"),
    ],
)
def test_mode_of_a_picture_follows_from_its_settings_where_it_is_not_given(settings: Any, mode: str) -> None:
    assert RenderSettings.of(**settings).mode == mode


@pytest.mark.parametrize(
    ("mode", "preset", "views"),
    [("dvr", "bone", ("anterior",)), ("mip", None, ("anterior",)), ("slice", None, ("axial",))],
)
def test_preset_and_view_by_default_follow_from_the_mode(mode: str, preset: str | None, views: tuple[str, ...]) -> None:
    settings = RenderSettings.of(mode)
    assert (settings.preset_used, settings.views_used) == (preset, views)


def test_crop_of_a_picture_clips_its_rays() -> None:
    style = RenderSettings.of(clip_box=(-1, 1, -2, 2, 0, float("inf"))).style
    assert isinstance(style, VolumeLook)
    assert len(style.clip.planes) == 5  # one side is open


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
def test_impossible_settings_of_a_picture_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        RenderSettings.of(**wrong)


def test_unknown_colour_of_a_label_in_a_picture_is_refused() -> None:
    with refused(UsageError, "octarine"):
        LabelLook("a.nii", colors={"L1": "octarine"})


def test_opacity_of_a_label_above_1_is_refused() -> None:
    with refused(UsageError, "L1", 1.5):
        LabelLook("a.nii", opacities={"L1": 1.5})


@pytest.fixture
def glass_file(tmp_path: Path) -> Path:
    """A transfer function of the name `glass`, in a file with a colon in its name."""
    points = [{"hu": 0, "color": [1, 1, 1], "opacity": 0}, {"hu": 9, "color": [1, 1, 1], "opacity": 1}]
    content = {"format": "clrecon transfer function", "version": 1, "name": "glass", "points": points}
    path = tmp_path / "a:b.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("form", ["{path}", "{path}:glass"], ids=["file", "file and name"])
def test_transfer_function_is_read_by_its_file_or_file_and_name(form: str, glass_file: Path) -> None:
    function = read_function(form.format(path=glass_file))
    assert function.points[:, 0].tolist() == [0.0, 9.0]


def test_transfer_function_of_another_name_than_in_its_file_is_refused(glass_file: Path) -> None:
    with refused(UsageError, "glass"):
        read_function(f"{glass_file}:stone")


def test_file_without_a_transfer_function_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text("{}")
    with refused(RefusedInputError, "bad.json"):
        read_function(str(tmp_path / "bad.json"))


def test_no_transfer_function_is_read_where_none_is_named() -> None:
    assert read_function(None) is None


def test_slices_in_space_are_seen_obliquely_by_default_without_a_warning(
    device: Any, sphere: Path, tmp_path: Path
) -> None:
    settings = RenderSettings.of("slices", size=SIZE, device=str(device.index))

    report = make_pictures(sphere, PictureFiles(tmp_path / "a.png"), settings)

    (picture,) = report["pictures"]
    assert picture["view"] == "30,30"
    assert picture["hit_share"] > 0.1  # measured 0.106; seen edge-on it is 0
    assert not any("edge-on" in text for text in report["warnings"])


@pytest.fixture
def sheet_settings(device: Any, sphere: Path, tmp_path: Path) -> RenderSettings:
    """Settings of a sheet of six slices with a label map of what lies above 100 HU, in red."""
    volume = read_volume(sphere)
    above_100_hu = LabelMap((volume.voxels > 100).astype(np.uint8), volume.affine, {1: "ball"})
    (tmp_path / "ball.nii.gz").write_bytes(encode_nifti(above_100_hu, packed=True))
    labels = LabelLook(str(tmp_path / "ball.nii.gz"), colors={"1": "#ff0000"})
    return RenderSettings.of(sheet=6, labels=labels, letters=True, scale_bar=True, device=str(device.index))


def test_report_of_a_sheet_has_its_size_slices_and_colours_of_labels(
    sheet_settings: RenderSettings, sphere: Path, tmp_path: Path
) -> None:
    assert (sheet_settings.mode, sheet_settings.style.is_sheet) == ("slice", True)
    assert sheet_settings.size_used == (1600, 1200)

    report = make_pictures(sphere, PictureFiles(tmp_path / "a.png"), sheet_settings)

    (picture,) = report["pictures"]
    assert picture["size"] == [1600, 1200]
    assert len(picture["tiles"]) == 6
    assert picture["camera"] is None
    assert [entry["color"] for entry in picture["labels"]] == ["#ff0000"]


def test_red_pixels_of_a_sheet_are_those_of_its_label(
    sheet_settings: RenderSettings, sphere: Path, tmp_path: Path
) -> None:
    make_pictures(sphere, PictureFiles(tmp_path / "a.png", values=tmp_path / "v.npy"), sheet_settings)

    image = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    is_red = (image[..., 0] - image[..., 1]) > 30
    in_label = np.load(tmp_path / "v.npy") > 100  # HU
    # Voxels of the label against interpolated HU: measured 1.4 % more.
    assert is_red.sum() == pytest.approx(in_label.sum(), rel=0.03)


def test_depths_of_a_sheet_are_refused(sheet_settings: RenderSettings, sphere: Path, tmp_path: Path) -> None:
    with refused(UsageError, "sheet", "depths"):
        make_pictures(sphere, PictureFiles(tmp_path / "a.png", depth=tmp_path / "d.npy"), sheet_settings)


@dataclass
class DrawnMinimum:
    """A minimum intensity projection of a ball of tissue in air: its report, and its values in HU."""

    report: Any
    values: np.ndarray

    @property
    def left_out(self) -> dict[str, Any]:
        (picture,) = self.report["pictures"]
        return picture["left_out"]


@pytest.fixture(scope="module")
def draw_minimum(device: Any, tmp_path_factory: Any) -> Any:
    """A function that draws the ball whole, or with a region: a box of 40 mm in its middle."""
    folder = tmp_path_factory.mktemp("minimum")
    ball = PhantomSettings(kind="sphere", size=(60, 60), slices=40, spacing=(2.0, 2.0, 2.0), noise=0, seed=1)
    x, y, z = write_phantom(folder / "ct", ball)["surface"]["center_lps_mm"]
    box = f"box:{x - 20},{x + 20},{y - 20},{y + 20},{z - 20},{z + 20}"

    def draw(has_region: bool) -> DrawnMinimum:
        files = PictureFiles(folder / "a.png", values=folder / "v.npy")
        settings = RenderSettings.of("minip", size=SIZE, device=str(device.index), region=[box] if has_region else None)
        return DrawnMinimum(make_pictures(folder / "ct", files, settings), np.load(folder / "v.npy"))

    return draw


@pytest.mark.parametrize("has_region", [False, True], ids=["whole", "region"])
def test_minimum_shows_tissue_and_leaves_out_the_air_about_it(has_region: bool, draw_minimum: Any) -> None:
    drawn = draw_minimum(has_region=has_region)
    assert np.nanmin(drawn.values) > 500.0  # the sphere; measured 748 on, and air has -1000
    assert drawn.report["volume"]["hu_range"] == [-1000.0, 1000.0]  # of the scan, which is read whole
    assert drawn.left_out["body"]


@pytest.mark.parametrize("has_region", [False, True], ids=["whole", "region"])
def test_minimum_reports_and_warns_that_what_is_outside_of_a_region_is_left_out(
    has_region: bool, draw_minimum: Any
) -> None:
    drawn = draw_minimum(has_region=has_region)
    assert drawn.left_out["region"] == has_region
    assert any("is left out:" in text for text in drawn.report["warnings"]) == has_region


def test_minimum_with_a_region_leaves_out_more_than_without(draw_minimum: Any) -> None:
    whole, region = draw_minimum(has_region=False), draw_minimum(has_region=True)
    assert 0.5 < whole.left_out["share"] < region.left_out["share"] < 1.0  # measured 0.958 and 0.961
    assert np.isfinite(region.values).sum() > 20  # pixels that show the region
