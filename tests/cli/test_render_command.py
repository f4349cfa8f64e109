"""``clrecon render``: what each option does to a picture, and what is said of what cannot be."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ct_files import ORIGIN, SPACING, find_words, write_series
from label_files import write_nifti
from PIL import Image
from variants import daily

from clrecon.cli.main import main

SHAPE_KJI = (17, 25, 31)
BLOCK = (slice(11, 15), slice(3, 9), slice(22, 28))
"""A block (k, j, i) near the patient's head, front and left: no two views of it are alike."""
BLOCK_HU, AIR_HU = 1200, -1000
ISO = 100
SIDE = 64


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A series in which `BLOCK` lies in air."""
    voxels = np.full(SHAPE_KJI, AIR_HU, np.int16)
    voxels[BLOCK] = BLOCK_HU
    return write_series(tmp_path_factory.mktemp("ct") / "scan", voxels)


def lps(ijk: tuple[float, float, float]) -> np.ndarray:
    return np.array(ORIGIN) + np.array(SPACING) * ijk


class Renders:
    """Runs the command on the block, 64 x 64 pixels, and returns the picture with its report."""

    def __init__(self, ct: Path, folder: Path, device: Any, capsys: pytest.CaptureFixture[str]):
        self.ct, self.folder, self.device, self.capsys = ct, folder, device, capsys

    def code(self, *arguments: object) -> int:
        given = [str(argument) for argument in arguments]
        size = [] if "--size" in given else ["--size", str(SIDE)]
        return main(["render", str(self.ct), *given, *size, "--device", str(self.device.index)])

    def report(self, *arguments: object) -> dict[str, Any]:
        assert self.code(*arguments, "--json") == 0, self.capsys.readouterr().err
        report: dict[str, Any] = json.loads(self.capsys.readouterr().out)
        return report

    def __call__(self, *arguments: object) -> tuple[np.ndarray, dict[str, Any]]:
        report = self.report("-o", self.folder / "a.png", *arguments)
        return np.asarray(Image.open(self.folder / "a.png")), report

    def image(self, *arguments: object) -> np.ndarray:
        return self(*arguments)[0]


@pytest.fixture
def render(ct: Path, tmp_path: Path, device: Any, capsys: pytest.CaptureFixture[str]) -> Renders:
    """Renders `ct`, by its command."""
    return Renders(ct, tmp_path, device, capsys)


def is_lit(image: np.ndarray) -> np.ndarray:
    return np.asarray(image[..., :3].max(axis=-1) > 20)


def area_mm2(image: np.ndarray, report: dict[str, Any]) -> float:
    return float(is_lit(image).sum() * report["pictures"][0]["pixel_mm"] ** 2)


def side_of(mask: np.ndarray) -> tuple[str, str]:
    """Where the middle of what is marked lies: left or right, top or bottom."""
    rows, columns = np.nonzero(mask)
    height, width = mask.shape
    return (
        "right" if columns.mean() > 0.5 * (width - 1) else "left",
        "top" if rows.mean() < 0.5 * (height - 1) else "bottom",
    )


PLACE_IN_VIEW = {
    "anterior": ("right", "top"),
    "posterior": ("left", "top"),
    "left": ("left", "top"),
    "right": ("right", "top"),
    "superior": ("left", "top"),
    "inferior": ("right", "top"),
    "0,0": ("right", "top"),
    "90,0": ("left", "top"),
    "-90,0": ("right", "top"),
}


@pytest.mark.parametrize("mode", daily(1, [["--mode", "dvr"], ["--preset", "mip"], ["--iso", ISO]]))
@pytest.mark.parametrize(("view", "place"), PLACE_IN_VIEW.items(), ids=PLACE_IN_VIEW)
def test_view_shows_the_block_on_the_side_of_the_patient_that_it_lies_on(
    view: str, place: tuple[str, str], mode: list[Any], render: Renders
) -> None:
    image, report = render(*mode, "--view", view)

    shown = is_lit(image)
    assert 10 < shown.sum() < 0.2 * shown.size  # the block is a small part of the volume
    assert side_of(shown) == place
    assert report["pictures"][0]["view"] == view


OFFSETS = {"axial": 4.5 * SPACING[2], "coronal": -6.5 * SPACING[1], "sagittal": -9.5 * SPACING[0]}
"""From the middle of the volume to that of the block, away from the camera."""


@pytest.mark.parametrize(("plane", "view"), [("axial", "inferior"), ("coronal", "anterior"), ("sagittal", "left")])
def test_slice_through_the_block_shows_it_where_radiologists_expect_it(plane: str, view: str, render: Renders) -> None:
    image, report = render("--mode", "slice", "--view", plane, "--offset", OFFSETS[plane])
    assert side_of(is_lit(image)) == PLACE_IN_VIEW[view]
    assert (report["mode"], report["offset_mm"]) == ("slice", OFFSETS[plane])
    assert report["pictures"][0]["values_hu"] == [AIR_HU, BLOCK_HU]
    through_the_middle, _ = render("--mode", "slice", "--view", plane)
    assert not is_lit(through_the_middle).any()  # it misses the block


def test_several_views_are_written_to_files_named_after_them(render: Renders) -> None:
    report = render.report("-o", render.folder / "a.png", "--view", "anterior,left", "--view", "-30,15.5")
    assert sorted(path.name for path in render.folder.iterdir()) == [
        "a_anterior.png", "a_az-30_el15.5.png", "a_left.png",
    ]  # fmt: skip
    assert [picture["name"] for picture in report["pictures"]] == ["anterior", "left", "az-30_el15.5"]


def test_twice_the_zoom_magnifies_the_block_about_four_times_in_area(render: Renders) -> None:
    small, large = (is_lit(render.image("--zoom", zoom)).sum() for zoom in (0.5, 1.0))
    assert 3.0 < large / small < 5.0  # 2 * 2, with pixels at the rim: measured 174 / 41


@pytest.mark.parametrize(
    ("up", "place"), [("left", ("left", "top")), ("0,0,-1", ("left", "bottom"))], ids=["the patient's left", "the feet"]
)
def test_option_up_turns_the_picture(up: str, place: tuple[str, str], render: Renders) -> None:
    assert side_of(is_lit(render.image("--up", up))) == place


def test_size_and_perspective_are_those_of_the_picture_and_its_camera(render: Renders) -> None:
    image, report = render("--size", "80x64", "--perspective", "20")

    assert image.shape == (64, 80, 4)
    (picture,) = report["pictures"]
    assert picture["camera"]["view_angle_deg"] == 20.0
    assert picture["pixel_mm"] is None  # it differs over the picture


def test_perspective_without_a_number_has_an_angle_of_30_degrees(render: Renders) -> None:
    _, report = render("--perspective")
    assert report["pictures"][0]["camera"]["view_angle_deg"] == 30.0


@pytest.mark.parametrize(
    ("options", "rgba"),
    [
        pytest.param([], [0, 0, 0, 255], id="by default black"),
        pytest.param(["--background", "#ff8000"], [255, 128, 0, 255], id="orange"),
    ],
)
def test_background_colour_fills_the_corner_of_the_picture(
    options: list[str], rgba: list[int], render: Renders
) -> None:
    image, _ = render(*options)
    assert image[0, 0].tolist() == rgba


def test_transparent_background_is_seen_through_beside_an_opaque_block(render: Renders) -> None:
    image, _ = render("--background", "transparent")
    assert image[0, 0, 3] == 0
    assert image[..., 3].max() > 200  # of 255; measured 254


MIDDLE_OF_BLOCK_X, *_ = lps((24.5, 0, 0))
BESIDE_BLOCK_X, *_ = lps((21.5, 0, 0))


def test_clip_box_and_clip_plane_leave_a_half_of_the_block_each(render: Renders) -> None:
    whole_mm2 = area_mm2(*render())

    of_box, report = render("--clip-box", f",{MIDDLE_OF_BLOCK_X},,,,")
    of_plane_mm2 = area_mm2(*render("--clip", f"{MIDDLE_OF_BLOCK_X},0,0,1,0,0"))

    assert report["clip_planes_lps_mm"] == [[-1.0, 0.0, 0.0, pytest.approx(-MIDDLE_OF_BLOCK_X)]]
    of_box_mm2 = area_mm2(of_box, report)
    assert 0.4 < of_box_mm2 / whole_mm2 < 0.65  # measured 0.47
    assert of_box_mm2 + of_plane_mm2 == pytest.approx(whole_mm2, rel=0.15)  # pixels of some 0.7 mm


def test_clip_planes_that_leave_nothing_give_an_empty_picture_without_depths(render: Renders) -> None:
    away_from_block = f"{BESIDE_BLOCK_X},0,0,-1,0,0"

    _, report = render("--clip", away_from_block, "--clip", f"{BESIDE_BLOCK_X},0,0,-2,0,0")

    assert report["pictures"][0]["hit_share"] == 0.0
    assert report["pictures"][0]["depth_mm"] is None


def test_surface_without_a_light_has_one_colour(render: Renders) -> None:
    image, report = render("--iso", ISO, "--light", "none", "--view", "30,30")

    assert (report["lighting"]["diffuse"], report["lighting"]["ambient"]) == (0.0, 1.0)
    assert len(np.unique(image[is_lit(image)], axis=0)) == 1


@pytest.mark.parametrize("light", ["superior", "0,0,5"], ids=["by its side", "by its direction"])
def test_light_from_above_is_reported_with_its_direction_and_changes_the_picture(light: str, render: Renders) -> None:
    of_camera, _ = render("--iso", ISO, "--view", "30,30")

    from_above, report = render("--iso", ISO, "--view", "30,30", "--light", light)

    assert report["lighting"]["direction"] == [0.0, 0.0, 1.0]
    assert (of_camera != from_above).any()


def test_depth_cue_darkens_the_surface_and_brightens_nothing(render: Renders) -> None:
    plain, cued = (render.image("--iso", ISO, *extra).astype(int) for extra in ([], ["--depth-cue", "0.6"]))
    assert (cued <= plain).all()
    assert cued[is_lit(plain)].mean() < 0.95 * plain[is_lit(plain)].mean()  # measured 0.948; without a cue it is 1


def test_shadows_darken_a_part_of_the_floor_and_brighten_nothing(
    ct: Path, tmp_path: Path, device: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    voxels = np.full(SHAPE_KJI, AIR_HU, np.int16)
    voxels[2:4, 2:23, 2:29] = BLOCK_HU
    voxels[10:13, 8:17, 10:21] = BLOCK_HU
    render = Renders(write_series(tmp_path / "ct", voxels), tmp_path, device, capsys)
    plain, dark = (
        render.image("--iso", ISO, "--view", "superior", "--light", "0.5,0,1", *extra).astype(int)
        for extra in ([], ["--shadows"])
    )
    assert (dark <= plain).all()
    in_shadow = (dark < plain - 20).any(axis=-1)  # by up to 197 of 255
    assert 20 < in_shadow.sum() < 0.3 * in_shadow.size  # measured 308 of 64 x 64 pixels


def test_given_ray_step_is_reported(render: Renders) -> None:
    _, report = render("--ray-step", "0.9")
    assert report["pictures"][0]["ray_step_mm"] == pytest.approx(0.9)


def test_ray_step_by_default_is_half_of_the_smallest_spacing(render: Renders) -> None:
    _, report = render()
    assert report["pictures"][0]["ray_step_mm"] == pytest.approx(0.5 * min(SPACING))


def test_jitter_is_reported_and_changes_the_picture(render: Renders) -> None:
    plain, _ = render("--ray-step", "0.9")

    jittered, report = render("--ray-step", "0.9", "--jitter")

    assert report["jitter"] is True
    assert (plain != jittered).any()


def test_window_maps_hu_to_grey_in_proportion_between_its_ends(render: Renders) -> None:
    image, report = render("--mode", "mip", "--window", f"{AIR_HU},{3 * BLOCK_HU}", "--values", render.folder / "v.npy")
    assert report["pictures"][0]["window_hu"] == [AIR_HU, 3 * BLOCK_HU]
    values = np.load(render.folder / "v.npy")
    assert report["pictures"][0]["values_hu"] == [float(np.nanmin(values)), BLOCK_HU]
    expected = 255.0 * (BLOCK_HU - AIR_HU) / (3 * BLOCK_HU - AIR_HU)
    assert image[..., :3].max() == round(expected)


def test_depth_file_holds_the_mm_from_the_camera_to_the_surface(render: Renders) -> None:
    _, report = render("--iso", ISO, "--depth", render.folder / "d.npy")

    depth = np.load(render.folder / "d.npy")
    assert (depth.dtype, depth.shape) == (np.float32, (SIDE, SIDE))
    _, front, _ = lps((0, 2.5, 0))  # ISO lies half way between air and the block, between voxels 2 and 3
    camera = report["pictures"][0]["camera"]["position_lps_mm"][1]
    assert float(np.nanmedian(depth)) == pytest.approx(front - camera, abs=0.02)  # crossings sought along the ray


def test_depths_in_a_tif_file_are_those_in_an_npy_file(render: Renders) -> None:
    render("--iso", ISO, "--depth", render.folder / "d.npy")
    render("--iso", ISO, "--depth", render.folder / "d.tif")

    depth = np.load(render.folder / "d.npy")
    assert np.array_equal(np.asarray(Image.open(render.folder / "d.tif")), depth, equal_nan=True)


@pytest.mark.parametrize(
    ("combine", "low_hu", "high_hu"),
    [("mean", AIR_HU + 1, BLOCK_HU - 1), ("max", BLOCK_HU, BLOCK_HU), ("min", AIR_HU, AIR_HU)],
    ids=["mean", "max", "min"],
)
def test_slab_of_a_slice_is_combined_by_mean_maximum_or_minimum(
    combine: str, low_hu: int, high_hu: int, render: Renders
) -> None:
    _, to_the_block, _ = lps((0, 5.5, 0)) - lps((0, 12, 0))  # from the middle of the volume
    thicker_than_the_block = 12.0
    slab = ("--offset", to_the_block, "--thickness", thicker_than_the_block, "--combine", combine)

    _, report = render("--mode", "slice", "--view", "coronal", *slab)

    assert (report["thickness_mm"], report["combine"]) == (thicker_than_the_block, combine)
    _, highest = report["pictures"][0]["values_hu"]
    assert low_hu <= highest <= high_hu


@pytest.mark.parametrize("kind", ["straightened", "stretched"])
def test_curve_of_a_file_is_straightened_or_stretched_at_its_length(kind: str, render: Renders) -> None:
    points = [lps((24.5, 5.5, k)) for k in (1, 8, 15)]  # upwards through the block, which begins at k = 11
    (render.folder / "line.csv").write_text("x,y,z\n" + "\n".join(",".join(map(str, point)) for point in points))
    image, report = render("--curve", render.folder / "line.csv", "--cpr", kind)
    assert (report["mode"], report["pictures"][0]["curve"]["kind"]) == ("cpr", kind)
    assert report["pictures"][0]["curve"]["length_mm"] == pytest.approx(14 * SPACING[2])
    assert report["pictures"][0]["camera"] is None
    _, end = side_of(is_lit(image))
    assert end == "top"


def test_transfer_function_of_a_file_colours_the_picture(render: Renders) -> None:
    content = {
        "format": "clrecon transfer function",
        "version": 1,
        "points": [{"hu": 0, "color": [0, 1, 0], "opacity": 0}, {"hu": 200, "color": [0, 1, 0], "opacity": 1}],
        "lighting": {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0},
    }
    path = render.folder / "green.json"
    path.write_text(json.dumps(content))
    image, report = render("--transfer-function", path)
    assert (report["preset"], report["transfer_function"]["points"][1]) == (None, [200, 0, 1, 0, 1])
    assert image[..., 1].max() > 240  # green; measured 255
    assert image[..., [0, 2]].max() == 0


def test_chosen_slice_in_space_shows_the_block_at_its_place(render: Renders) -> None:
    image, report = render("--mode", "slices", "--slices", "13,", "--slice-opacity", 1.0, "--view", "superior")

    assert report["pictures"][0]["slices"] == [13]
    assert side_of(is_lit(image)) == PLACE_IN_VIEW["superior"]


def test_slices_in_space_beside_the_block_show_nothing(render: Renders) -> None:
    image, _ = render("--mode", "slices", "--slices", "1,2", "--view", "superior")
    assert not is_lit(image).any()


def test_single_number_of_slices_in_space_is_their_distance(render: Renders) -> None:
    _, report = render("--mode", "slices", "--slices", "4")
    assert report["pictures"][0]["slices"] == [0, 4, 8, 12, 16]  # of 17


@pytest.fixture
def label_20(render: Renders) -> Path:
    """A label map in which the block has the label 20."""
    pytest.importorskip("nibabel")
    voxels = np.zeros(SHAPE_KJI, np.uint8)
    voxels[BLOCK] = 20
    affine = np.diag([*SPACING, 1.0])
    affine[:3, 3] = ORIGIN
    return write_nifti(render.folder / "labels.nii.gz", voxels, affine)


@pytest.mark.seconds
@pytest.mark.parametrize("mode", [["--iso", ISO], []], ids=["surface", "volume"])
def test_label_has_the_given_colour(render: Renders, label_20: Path, mode: list[Any]) -> None:
    image, report = render(*mode, "--light", "none", "--labels", label_20, "--label-color", "20=blue")
    (label,) = report["labels"]
    assert (label["label_number"], label["color"], label["opacity"]) == (20, "blue", None)
    red, _, blue, _ = image[is_lit(image)].mean(axis=0)
    assert blue > 3.0 * red  # measured 5.1 times in the volume, whose rim is grey


@pytest.mark.seconds
def test_label_of_opacity_0_darkens_pixels_that_it_lit(render: Renders, label_20: Path) -> None:
    shown = is_lit(render.image("--labels", label_20))
    assert not is_lit(render.image("--labels", label_20, "--label-opacity", "20=0"))[shown].all()


@pytest.mark.seconds
def test_label_of_opacity_0_3_is_fainter_than_an_opaque_one(render: Renders, label_20: Path) -> None:
    surface = ("--iso", ISO, "--light", "none", "--labels", label_20, "--label-color", "20=blue")
    whole, faint = render.image(*surface), render.image(*surface, "--label-opacity", "20=0.3")
    assert faint[is_lit(whole)][:, 2].mean() < 0.8 * whole[is_lit(whole)][:, 2].mean()  # measured 0.298


@pytest.mark.seconds
def test_surface_has_the_given_colour(render: Renders) -> None:
    image = render.image("--iso", ISO, "--light", "none", "--color", "red")
    assert image[..., :3][is_lit(image)].mean(axis=0).tolist() == [255.0, 0.0, 0.0]


@pytest.mark.parametrize("option", [["--letters"], ["--scale-bar"], ["--caption", "T12"]], ids=lambda words: words[0])
def test_annotation_is_drawn_beside_the_middle_of_the_picture(option: list[str], render: Renders) -> None:
    plain, _ = render("--size", "128")

    drawn, _ = render("--size", "128", *option)

    assert (drawn != plain).any()
    assert not is_lit(drawn)[60:68, 60:68].any()


def test_figure_of_a_resolution_is_an_svg_of_its_size_in_mm_with_letters_as_text(render: Renders) -> None:
    report = render.report("-o", render.folder / "a.svg", "--letters", "--dpi", 254, "--size", "200x100")

    figure = (render.folder / "a.svg").read_text()
    assert 'width="20mm" height="10mm"' in figure
    assert [f">{letter}</text>" in figure for letter in "RLSI"] == [True] * 4
    assert report["dpi"] == 254.0
    assert report["pictures"][0]["output"] == {"format": "svg", "bytes": len(figure)}


def test_turntable_into_a_gif_has_its_frames_and_bytes_in_the_report(render: Renders) -> None:
    report = render.report("--turntable", render.folder / "a.gif", "--frames", "3", "--fps", "10")

    turntable = report["turntable"]
    assert (turntable["frames"], turntable["fps"]) == (3, 10.0)
    assert turntable["output"] == {"format": "gif", "bytes": (render.folder / "a.gif").stat().st_size}
    assert Image.open(render.folder / "a.gif").n_frames == 3
    assert report["pictures"] == []


def test_turntable_into_a_folder_has_a_frame_from_the_front_and_one_from_behind(render: Renders) -> None:
    _, report = render("--turntable", render.folder / "frames", "--frames", "4")

    assert report["turntable"]["output"]["format"] == "folder"
    names = sorted(path.name for path in (render.folder / "frames").iterdir())
    assert names == [f"frame_{number:04d}.png" for number in range(4)]
    front, _, back, _ = (np.asarray(Image.open(render.folder / "frames" / name)) for name in names)
    (side_in_front, _), (side_behind, _) = side_of(is_lit(front)), side_of(is_lit(back))
    assert (side_in_front, side_behind) == ("right", "left")


def test_picture_within_little_memory_is_that_of_the_whole_volume(render: Renders) -> None:
    whole, _ = render()

    in_slabs, report = render("--memory", "150kB")

    assert report["memory_allowed_bytes"] == 150_000
    assert np.abs(whole.astype(int) - in_slabs).max() <= 2  # of 255: rounding at the borders of slabs


def test_voxels_outside_the_field_of_view_are_masked_before_rendering(render: Renders) -> None:
    _, report = render("--fov", "5")
    assert report["pictures"][0]["hit_share"] == 0.0
    assert report["volume"]["field_of_view"]["radius_mm"] == 5.0
    assert any("outside of 5 mm" in warning for warning in report["warnings"])


def test_words_of_render_have_volume_mode_views_and_files(render: Renders) -> None:
    assert render.code("-o", render.folder / "a.png", "--view", "anterior,left", "--letters", "-v") == 0

    printed = render.capsys.readouterr()
    assert "17 slices of 31 x 25, spacing 0.8 x 1.1 x 1.5 mm" in printed.out
    assert "mode dvr, preset bone" in printed.out
    assert "anterior: 64 x 64" in printed.out
    assert "a_left.png" in printed.out
    assert "rendering" in printed.err


def test_quiet_render_prints_nothing(render: Renders) -> None:
    assert render.code("-o", render.folder / "a.png", "-q") == 0
    assert render.capsys.readouterr() == ("", "")


def test_files_and_words_of_render_do_not_name_the_patient(render: Renders) -> None:
    outputs = [render.folder / name for name in ("a.png", "a.npy", "a.json", "a.apng")]
    picture, depth, report, turntable = outputs
    assert render.code("-o", picture, "--depth", depth, "--report", report, "--turntable", turntable,
                       "--frames", 2, "-v") == 0  # fmt: skip
    shown = "".join(render.capsys.readouterr())
    written = b"".join(path.read_bytes() for path in outputs) + shown.encode()
    assert find_words(written) == []


@pytest.mark.parametrize(("preset", "warns"), [("skin", True), ("bone", False), ("x-ray", False)])
def test_picture_of_skin_alone_is_warned_of_as_one_that_can_show_a_face(
    preset: str, warns: bool, render: Renders
) -> None:
    _, report = render("--preset", preset)
    assert any("can show a face" in warning for warning in report["warnings"]) == warns


WRONG = {
    "preset": (["--preset", "bones"], 3, "use one of bone, "),
    "mode": (["--mode", "raycast"], 3, "use one of dvr, "),
    "view": (["--view", "front"], 3, "anterior, posterior"),
    "names and angles": (["--view", "anterior,left,30,15"], 3, "'anterior,left,30,15' is neither names of views with"),
    "angles twice": (["--view", "30,15,60,15"], 3, "nor one AZ,EL in degrees, such as 30,15: give --view again"),
    "one angle": (["--view", "30"], 3, "anterior, posterior, left, right, superior, inferior; of slices axial"),
    "an empty view": (["--view", "left,"], 3, "neither names of views"),
    "angle": (["--view", "30,95"], 3, "elevation from -90 to 90"),
    "view twice": (["--view", "left,left"], 3, "twice"),
    "up along the view": (["--up", "anterior"], 3, "up direction"),
    "size 0": (["--size", "0"], 3, "not (0, 0)"),
    "size absurd": (["--size", "99999x10"], 3, "99999"),
    "size of words": (["--size", "big"], 3, "1024x768"),
    "zoom": (["--zoom", "0"], 3, "zoom"),
    "perspective": (["--perspective", "190"], 3, "190"),
    "step": (["--ray-step", "-1"], 3, "ray step"),
    "step too fine": (["--ray-step", "0.0001"], 3, "ray step"),
    "window": (["--mode", "mip", "--window", "100,100"], 3, "window"),
    "window of one": (["--mode", "mip", "--window", "100"], 3, "LOW,HIGH"),
    "window of no name": (["--mode", "mip", "--window", "liver"], 3, "bone, soft, lung"),
    "window of a radiograph": (["--mode", "drr", "--window", "Lung"], 3, "mm of water"),
    "window elsewhere": (["--window", "0,100"], 3, "--window does not apply to mode dvr"),
    "box": (["--clip-box", "0,1,2"], 3, "X0,X1"),
    "box without room": (["--clip-box", "5,1,,,,"], 3, "holds nothing"),
    "plane": (["--clip", "0,0,0,0,0,0"], 3, "length 0"),
    "colour": (["--background", "octarine"], 3, "octarine"),
    "sheet": (["--sheet", "few"], 3, "a number of slices, or their distance such as '5mm', not 'few'"),
    "sheet of a volume": (["--sheet", "4", "--mode", "dvr"], 3, "--sheet does not apply to mode dvr"),
    "sheet and offset": (["--sheet", "4", "--offset", "3"], 3, "leave --offset out"),
    "label 0": (["--labels", "a.nii", "--label-color", "0=red"], 3, "what has no label (0) keeps the colours"),
    "air of a maximum": (["--mode", "mip", "--keep-air"], 3, "only to minip"),
    "light": (["--light", "sun"], 3, "head, none, anterior"),
    "depth cue": (["--iso", "100", "--depth-cue", "2"], 3, "depth cue"),
    "shadows of the camera": (["--iso", "100", "--shadows"], 3, "--light"),
    "slices": (["--mode", "slices", "--slices", "a,b"], 3, "every N-th"),
    "slice not there": (["--mode", "slices", "--slices", "17,"], 3, "slices 0 to 16"),
    "slice opacity": (["--mode", "slices", "--slice-opacity", "0"], 3, "opacity of a slice"),
    "shadows elsewhere": (["--shadows"], 3, "--shadows does not apply to mode dvr"),
    "no spine": (["--curve", "auto"], 4, "no spine was found that one could be sure of"),
    "curve file": (["--curve", "nowhere.csv"], 3, "there is no file"),
    "small letters": (["--letters", "--size", "20"], 3, "at least 64"),
    "coarse print": (["--dpi", "10"], 3, "36 to 4,800 pixels per inch"),
    "function file": (["--transfer-function", "nowhere.json"], 3, "nowhere.json"),
    "long name of a function": (["--transfer-function", "a" * 300 + ":b"], 4, "File name too long"),
    "long name of labels": (["--labels", "a" * 300], 4, "File name too long"),
    "two functions": (["--transfer-function", "a.json", "--preset", "bone"], 3, "not both"),
    "label option": (["--label-color", "1=red"], 3, "--labels FILE"),
    "label colour": (["--labels", "a.nii", "--label-color", "1"], 3, "LABEL=COLOUR"),
    "label opacity": (["--labels", "a.nii", "--label-opacity", "1=7"], 3, "between 0 and 1"),
    "turntable option": (["--frames", "9"], 3, "--turntable OUT"),
    "no frames": (["--turntable", "OUT/b.gif", "--frames", "0"], 3, "1 to 10000"),
    "turntable format": (["--turntable", "OUT/b.avi"], 3, ".mp4"),
    "turntable of a slice": (["--mode", "slice", "--turntable", "OUT/b.gif"], 3, "--turntable does not apply"),
    "turntable of views": (["--view", "left,right", "--turntable", "OUT/b.gif"], 3, "one view"),
    "transparent gif": (["--turntable", "OUT/b.gif", "--background", "transparent"], 3, "GIF"),
    "depth format": (["--depth", "OUT/d.exr"], 3, ".npy"),
    "values of dvr": (["--values", "OUT/v.npy"], 3, "--values does not apply"),
    "one file twice": (["--depth", "OUT/a.tif", "-o", "OUT/a.tif"], 3, "cannot be the same file"),
    "picture format": (["-o", "OUT/a.bmp"], 3, ".png"),
    "transparent jpg": (["-o", "OUT/a.jpg", "--background", "transparent"], 3, "JPG"),
    "no folder": (["-o", "OUT/gone/a.png"], 6, "gone"),
    "no series": (["--series", "9"], 3, "no series matches"),
    "device": (["--device", "abacus"], 5, "abacus"),
    "memory": (["--memory", "5kB"], 5, "5,000 bytes are allowed on"),
    "curve outside": (["--curve", "OUT/../far.txt"], 3, "outside of the volume"),
}


@pytest.mark.parametrize(("extra", "code", "words"), WRONG.values(), ids=WRONG)
def test_wrong_argument_of_render_is_refused_in_one_line_and_leaves_nothing(
    extra: list[str], code: int, words: str, ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "far.txt").write_text("0 0 9000\n0 0 9100\n")
    arguments = [text.replace("OUT", str(out)) for text in extra]
    for option, value in (("-o", str(out / "a.png")), ("--size", "32")):  # small, should it be rendered after all
        if option not in arguments:
            arguments += [option, value]
    found = main(["render", str(ct), *arguments])
    captured = capsys.readouterr()
    assert (found, captured.out) == (code, "")
    (line,) = captured.err.splitlines()
    assert line.startswith("clrecon: error: ") and words in line
    assert list(out.iterdir()) == []


def test_render_without_a_picture_or_turntable_is_refused(ct: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", str(ct)]) == 3
    assert "name a picture (-o out.png) or a turntable" in capsys.readouterr().err


def test_depths_of_a_turntable_without_a_picture_are_refused(
    ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = ["--turntable", str(tmp_path / "a.gif"), "--depth", str(tmp_path / "d.npy")]
    assert main(["render", str(ct), *files]) == 3
    assert "belong to a picture" in capsys.readouterr().err
