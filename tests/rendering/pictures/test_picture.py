"""Pictures and their files: what is kept, what is said, what is refused, and nothing half written."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import tolerances
from picture_files import PARALLEL, PERSPECTIVE, make_picture
from PIL import Image
from refusals import refused

from clrecon.errors import OutputError, UsageError
from clrecon.rendering.looks.colors import COLORS, find_color
from clrecon.rendering.pictures import picture as image_files

CLEAR = (10, 20, 30, 0)
PIXEL_MM = 2 * PARALLEL.parallel_scale / 80  # of `make_picture`, by default of 120 x 80 pixels


@pytest.mark.parametrize("name", ["a.png", "a.PNG", "a.tif", "a.tiff"])
def test_saved_picture_has_its_colours_opacity_and_resolution(tmp_path, name):
    picture = make_picture(background=(10, 20, 30, 77))
    size = picture.save(tmp_path / name)
    assert size == (tmp_path / name).stat().st_size
    with Image.open(tmp_path / name) as read:
        assert read.mode == "RGBA"
        assert np.array_equal(np.array(read), picture.image)
        millimetres = 25.4 / np.array(read.info["dpi"], dtype=float)
    assert millimetres == pytest.approx(PIXEL_MM, rel=tolerances.PNG_RESOLUTION)


def test_png_has_its_resolution_in_whole_pixels_a_metre(tmp_path):
    make_picture().save(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    start = data.index(b"pHYs") + 4
    across, down = (int.from_bytes(data[start + n : start + n + 4], "big") for n in (0, 4))
    assert across == down == 1000 / PIXEL_MM
    assert data[start + 8] == 1  # the metre


def test_png_of_a_perspective_picture_has_no_resolution(tmp_path):
    make_picture(camera=PERSPECTIVE).save(tmp_path / "a.png")
    assert b"pHYs" not in (tmp_path / "a.png").read_bytes()


def test_png_without_a_camera_has_a_resolution_where_the_report_has_the_size_of_pixels(tmp_path):
    picture = make_picture(camera=None)
    assert picture.pixel_mm is None
    picture.save(tmp_path / "a.png")
    picture.report["pixel_mm"] = 0.5
    picture.save(tmp_path / "b.png")
    assert b"pHYs" not in (tmp_path / "a.png").read_bytes()
    assert b"pHYs" in (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(("pixel_mm", "told"), [(4.7e-7, True), (4.6e-7, False), (999.0, True), (1001.0, False)])
def test_pixels_too_small_or_large_for_the_resolution_of_png_are_saved_without_it(tmp_path, pixel_mm, told):
    """PNG has 31 bits for the whole number of pixels a metre: at most 1000 mm a pixel, and at least 1000 / 2^31 mm."""
    picture = make_picture(camera=None)
    picture.report["pixel_mm"] = pixel_mm
    image_files.write_floats(picture.depth, tmp_path / "d.tif", pixel_mm)  # TIFF takes any
    picture.save(tmp_path / "a.tif")
    picture.save(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as read:
        assert ("dpi" in read.info) == told
        assert np.array_equal(np.array(read), picture.image)


def test_png_names_its_software_mode_view_pixel_and_camera(tmp_path):
    make_picture(camera=PARALLEL.orbit(azimuth=30.0, elevation=10.0)).save(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as read:
        text = read.text
    assert text["Software"].startswith("clrecon ")
    assert text["Mode"] == "dvr"
    assert text["View"] == "from ALS"
    assert text["Pixel"] == f"{PIXEL_MM} mm"
    x, y, z = 300 * np.array([np.sin(np.pi / 6) * np.cos(np.pi / 18), -np.cos(np.pi / 6) * np.cos(np.pi / 18),
                              np.sin(np.pi / 18)])  # fmt: skip
    assert text["Camera"].startswith(f"LPS mm: position {x:.6g} {y:.6g} {z:.6g}; focal point 0 0 0; up ")
    assert text["Camera"].endswith("parallel scale 100 mm")


@pytest.mark.parametrize("extension", image_files.IMAGE_FORMATS)
def test_same_picture_has_the_same_bytes_in_a_format(extension):
    first, second = (image_files.encode_image(make_picture(), extension) for _ in range(2))
    assert first == second


def test_jpeg_keeps_an_opaque_picture(tmp_path):
    picture = make_picture()
    picture.save(tmp_path / "a.jpg")
    with Image.open(tmp_path / "a.jpg") as read:
        difference = np.abs(np.array(read).astype(int) - picture.image[..., :3])
    assert difference.mean() <= tolerances.JPEG_MEAN_GREY


def test_transparent_picture_is_refused_by_jpeg(tmp_path):
    with refused(UsageError, "PNG", "background"):
        make_picture(background=CLEAR).save(tmp_path / "a.jpg")
    assert not list(tmp_path.iterdir())


def test_transparent_picture_on_a_background_is_saved_as_jpeg(tmp_path):
    make_picture(background=CLEAR).with_background("white").save(tmp_path / "a.jpg")
    with Image.open(tmp_path / "a.jpg") as read:
        assert min(read.getpixel((0, 0))) >= 250  # white has 255, and JPEG may lose a little


def test_background_is_mixed_into_a_picture_by_its_opacity():
    a_fifth = 51  # of 255
    picture = make_picture(background=(200, 100, 0, a_fifth))

    on_white = picture.with_background((1.0, 1.0, 1.0))

    expected = [0.2 * channel + 0.8 * 255 for channel in (200, 100, 0)]
    assert on_white.image[0, 0].tolist() == [*expected, 255]
    opaque = (40, 60)  # a pixel of what is drawn
    assert np.array_equal(on_white.image[opaque], picture.image[opaque])
    assert on_white.is_opaque


def test_picture_that_gets_a_background_stays_and_shares_its_depths():
    picture = make_picture(background=(200, 100, 0, 51))

    on_white = picture.with_background((1.0, 1.0, 1.0))

    assert picture.image[0, 0, 3] == 51
    assert not picture.is_opaque
    assert on_white.depth is picture.depth


@pytest.mark.parametrize("extension", [".npy", ".tif"])
@pytest.mark.parametrize("expected", [False, True], ids=["first hits", "expected depths"])
def test_saved_depths_are_read_with_their_gaps(tmp_path, extension, expected):
    picture = make_picture()  # its expected depths are 1 mm behind the first hits
    path = tmp_path / f"depth{extension}"

    picture.save_depth(path, expected=expected)

    read = np.load(path) if extension == ".npy" else np.array(Image.open(path))
    assert read.dtype == np.float32
    assert np.array_equal(read, picture.depth + (1 if expected else 0), equal_nan=True)


def test_values_of_a_picture_are_saved(tmp_path):
    picture = make_picture()
    picture.values = np.arange(80 * 120, dtype=np.float32).reshape(80, 120)

    picture.save_values(tmp_path / "hu.npy")

    assert np.array_equal(np.load(tmp_path / "hu.npy"), picture.values)


def test_values_of_a_picture_without_any_are_refused(tmp_path):
    with refused(UsageError, "dvr", "values"):
        make_picture().save_values(tmp_path / "hu.npy")


@pytest.mark.parametrize(
    ("save", "message"),
    [
        (lambda picture, folder: picture.save(folder / "a.bmp"), "use one of .png, .jpg"),
        (lambda picture, folder: picture.save(folder / "a"), "no extension"),
        (lambda picture, folder: picture.save(f"{folder}/a.png/"), "slash"),
        (lambda picture, folder: picture.save(folder / ".PNG"), "only an extension"),
        (lambda picture, folder: picture.save(5), "string or a path"),
        (lambda picture, folder: picture.save(folder / "a.jpg", quality=0), "between 1 and 100"),
        (lambda picture, folder: picture.save_depth(folder / "a.png"), "use one of .npy, .tif"),
    ],
)
def test_picture_with_a_wrong_name_or_quality_is_refused_and_writes_nothing(tmp_path, save, message):
    with pytest.raises(UsageError, match=message):
        save(make_picture(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_picture_in_a_missing_folder_is_refused(tmp_path):
    with refused(OutputError, "a.png", "none", "folder"):
        make_picture().save(tmp_path / "none" / "a.png")


def test_picture_on_a_full_disk_is_refused_and_the_older_one_stays(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"older")

    class Usage:
        total, free = 10**9, 100

    monkeypatch.setattr("clrecon.system.files.shutil.disk_usage", lambda folder: Usage)
    with refused(OutputError, "a.png", "kB", "free"):
        make_picture().save(path)
    assert path.read_bytes() == b"older"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.png"]


def test_picture_in_a_notebook_is_a_png():
    assert make_picture()._repr_png_().startswith(b"\x89PNG")


def test_picture_is_saved_where_the_command_line_hides_pillow(tmp_path):
    code = f"""
import sys
sys.modules["PIL"] = None
import numpy as np, pydicom
from clrecon.rendering import Rendering
image = np.zeros((4, 4, 4), np.uint8)
Rendering(image, image[..., 0], image[..., 0], None).save({str(tmp_path / "a.png")!r})
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "a.png").exists()


def test_picture_without_pillow_is_refused_by_its_name(monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.setattr(sys, "path", [])
    monkeypatch.setattr(sys, "path_importer_cache", {})
    with refused(UsageError, "Pillow"):
        make_picture().save("a.png")


@pytest.mark.parametrize("color", ["orange", " Orange ", "#ffa500", "#FFA500", (1.0, 165 / 255, 0.0)])
def test_orange_is_found_by_name_hexadecimal_number_or_shares(color):
    assert find_color(color) == pytest.approx([1.0, 165 / 255, 0.0])


def test_colour_of_three_hexadecimal_digits_has_each_twice():
    assert find_color("#f0a") == pytest.approx([1.0, 0.0, 0xAA / 255])


def test_grey_is_spelt_in_both_ways():
    assert find_color("Grey") == pytest.approx(find_color("gray"))


@pytest.mark.parametrize("name", COLORS)
def test_named_colour_has_three_shares_from_0_to_1(name):
    color = find_color(name)
    assert color.shape == (3,)
    assert ((color >= 0) & (color <= 1)).all()


@pytest.mark.parametrize("color", ["", "blakc", "#12", "ff0000", "#gggggg", (1, 2, 3), (1, 0), None, (0, 0, np.nan)])
def test_unknown_colour_is_refused_with_the_known_ones(color):
    with refused(UsageError, "black"):
        find_color(color)


def test_picture_is_described_in_one_short_line_with_size_and_mode():
    described = repr(make_picture((40, 30)))
    assert "40 x 30" in described
    assert "dvr" in described
    assert "\n" not in described
    assert len(described) <= 80  # columns of a terminal
