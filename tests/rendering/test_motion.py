"""Moving pictures: what is in them when they are read again, and what happens when something goes wrong."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
import tolerances
from picture_files import PARALLEL, make_picture
from PIL import Image
from refusals import refused

from clrecon.errors import OutputError, UsageError
from clrecon.rendering import movies
from clrecon.rendering import movies as motion
from clrecon.rendering.movies import MOST_FRAMES, check_animation, stage_animation, turntable_cameras, write_animation


@pytest.fixture
def encoder() -> str:
    """The path of ffmpeg."""
    try:
        return movies.find_encoder()
    except UsageError as error:
        pytest.skip(str(error))


def moving_frames(count=5, size=(63, 40), channels=3):
    """Frames of a bright block that moves by 8 pixels a frame over a coloured ramp; `size` is width and height."""
    width, height = size
    for number in range(count):
        frame = np.zeros((height, width, channels), np.uint8)
        frame[..., 0] = np.linspace(20, 200, width, dtype=np.uint8)
        frame[..., 1] = np.linspace(180, 40, height, dtype=np.uint8)[:, None]
        frame[10:20, 8 * number : 8 * number + 8] = 250
        if channels == 4:
            frame[..., 3] = 255 - 20 * number
        yield frame


def names_in(folder) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_cameras_of_a_whole_turn_end_one_step_before_its_beginning():
    cameras = turntable_cameras(PARALLEL, frames=8)  # from 300 mm in front
    assert cameras[0] == PARALLEL
    assert cameras[2].position == pytest.approx((300.0, 0.0, 0.0))  # a quarter: from the patient's left
    assert cameras[7].position == pytest.approx(PARALLEL.orbit(-45.0).position)


def test_cameras_of_a_quarter_turn_end_at_its_end():
    cameras = turntable_cameras(PARALLEL, frames=4, degrees=-90.0)  # from 300 mm in front
    assert cameras[-1].position == pytest.approx((-300.0, 0.0, 0.0))
    assert cameras[1].position == pytest.approx(PARALLEL.orbit(-30.0).position)


def test_single_camera_of_a_turn_is_at_its_beginning():
    assert turntable_cameras(PARALLEL, frames=1, degrees=90.0) == [PARALLEL]


@pytest.mark.parametrize(("frames", "degrees"), [(0, 360), (MOST_FRAMES + 1, 360), (2.5, 360), (10, np.nan)])
def test_turntable_of_an_impossible_number_of_frames_or_degrees_is_refused(frames, degrees):
    with refused(UsageError, "turntable"):
        turntable_cameras(PARALLEL, frames, degrees)


SIX_FRAMES = list(moving_frames(6, size=(63, 40)))


@pytest.fixture
def mp4(tmp_path, encoder):
    """An MP4 of `SIX_FRAMES`, 20 a second."""
    path = tmp_path / "turn.mp4"
    assert write_animation(iter(SIX_FRAMES), path, fps=20.0) == path.stat().st_size
    return path


def test_mp4_shows_its_frames(mp4, encoder):
    command = [encoder, "-loglevel", "error", "-i", mp4, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    data = subprocess.run(command, capture_output=True, check=True).stdout

    read = np.frombuffer(data, np.uint8).reshape(-1, 40, 64, 3)  # the odd width is made even
    assert len(read) == 6
    difference = np.abs(read[:, :, :63].astype(int) - np.array(SIX_FRAMES))
    assert difference.mean() <= tolerances.MP4_MEAN_GREY


def test_mp4_is_h264_in_bt_709_with_the_given_frames_a_second(mp4, encoder):
    described = subprocess.run([encoder, "-i", mp4], capture_output=True, text=True).stderr
    assert [words for words in ("h264", "yuv420p(tv, bt709", "20 fps") if words not in described] == []


def test_webm_is_vp9_and_shows_its_frames(tmp_path, encoder):
    write_animation(iter(SIX_FRAMES), tmp_path / "turn.webm", fps=20.0)

    command = [encoder, "-i", tmp_path / "turn.webm", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run(command, capture_output=True, check=True)
    assert [words for words in ("vp9", "yuv420p(tv, bt709", "20 fps") if words not in decoded.stderr.decode()] == []
    read = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 40, 64, 3)[:, :, :63]  # the odd width is made even
    assert len(read) == 6
    assert np.abs(read.astype(int) - np.array(SIX_FRAMES)).mean() <= tolerances.MP4_MEAN_GREY  # as of MP4


def test_mp4_is_written_alone(mp4):
    assert names_in(mp4.parent) == ["turn.mp4"]


@pytest.mark.parametrize("color", [(227, 60, 40), (30, 160, 70), (40, 60, 200)])
def test_mp4_keeps_colours_and_their_luma_of_bt_709(tmp_path, encoder, color):
    frame = np.full((64, 64, 3), color, np.uint8)
    write_animation(iter([frame] * 2), tmp_path / "a.mp4")
    command = [encoder, "-loglevel", "error", "-i", tmp_path / "a.mp4", "-f", "rawvideo", "-pix_fmt"]
    data = subprocess.run([*command, "rgb24", "-"], capture_output=True, check=True).stdout
    assert np.abs(np.frombuffer(data, np.uint8).reshape(-1, 3).astype(int) - color).max() <= tolerances.MP4_FLAT_GREY
    data = subprocess.run([*command, "yuv420p", "-"], capture_output=True, check=True).stdout
    luma = 16 + 219 / 255 * np.dot((0.2126, 0.7152, 0.0722), color)  # ITU-R BT.709
    of_first_frame = np.frombuffer(data, np.uint8)[: 64 * 64]  # Y comes before U and V
    assert abs(of_first_frame.mean() - luma) <= 1.0  # one grey of rounding


@pytest.fixture
def gif_of_seven(tmp_path):
    """A GIF of seven frames of 63 x 40 pixels, 30 a second, and the frames."""
    frames = list(moving_frames(7, size=(63, 40)))
    write_animation(iter(frames), tmp_path / "turn.gif", fps=30.0)
    with Image.open(tmp_path / "turn.gif") as read:
        yield read, frames


def test_gif_shows_its_frames(gif_of_seven):
    read, frames = gif_of_seven

    assert (read.n_frames, read.size) == (7, (63, 40))
    for number, frame in enumerate(frames):
        read.seek(number)
        difference = np.abs(np.array(read.convert("RGB")).astype(int) - frame)
        assert difference.mean() <= tolerances.GIF_MEAN_GREY


def test_gif_repeats_and_takes_the_time_of_its_frames_in_hundredths_of_a_second(gif_of_seven):
    read, _ = gif_of_seven

    durations_ms = []
    for number in range(7):
        read.seek(number)
        durations_ms.append(read.info["duration"])

    assert read.info["loop"] == 0  # without an end
    assert sum(durations_ms) == 230  # 7 / 30 s are 233 ms


def test_large_frame_of_a_gif_is_as_near_as_one_whose_colours_all_pixels_chose(tmp_path):
    large = (520, 600)  # 2 x 256 and more along the shorter side: one of two pixels chooses colours
    j, i = np.indices(large) / 600.0
    frame = np.stack([255 * i, 200 * j, 128 + 127 * np.sin(9 * i * j)], axis=-1).astype(np.uint8)
    write_animation(iter([frame, frame]), tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as read:
        shown = np.asarray(read.convert("RGB"), np.float64)
    picture = Image.fromarray(frame)
    best = picture.quantize(256, Image.Quantize.MEDIANCUT)
    known = np.asarray(picture.quantize(palette=best, dither=Image.Dither.FLOYDSTEINBERG).convert("RGB"), np.float64)
    off, known_off = (np.sqrt(np.mean(np.square(one - frame))) for one in (shown, known))
    assert off < 1.05 * known_off, (off, known_off)  # 0.997 was measured


def test_gif_of_two_colours_keeps_them(tmp_path):
    frames = [np.full((5, 4, 3), shade, np.uint8) for shade in (0, 255)]
    frames[1][0, 0] = 0
    write_animation(iter(frames), tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as read:
        read.seek(1)
        assert np.array_equal(np.array(read.convert("RGB")), frames[1])


@pytest.mark.parametrize("channels", [3, 4])
def test_apng_keeps_every_pixel_of_the_frames(tmp_path, channels):
    path = tmp_path / "turn.apng"
    frames = list(moving_frames(5, channels=channels))
    assert write_animation(iter(frames), path, fps=12.5) == path.stat().st_size
    with Image.open(path) as read:
        assert (read.n_frames, read.info["loop"], read.info["duration"]) == (5, 0, 1000 / 12.5)
        for number, frame in enumerate(frames):
            read.seek(number)
            assert np.array_equal(np.array(read), frame)


@pytest.mark.parametrize("name", ["turn.gif", "turn.apng"])
def test_frames_drawn_one_after_another_into_one_array_are_all_kept(tmp_path, name):
    """The next frame is drawn while one is packed."""

    def frames_in_one_array():
        canvas = np.empty((300, 300, 3), np.uint8)
        for value in (20, 120, 220):
            canvas[...] = value
            yield canvas

    write_animation(frames_in_one_array(), tmp_path / name)
    with Image.open(tmp_path / name) as animation:
        for number, value in enumerate((20, 120, 220)):
            animation.seek(number)
            assert (np.asarray(animation.convert("RGB")) == value).all()


@pytest.mark.parametrize("name", ["turn", "turn/", "v1.2/"])
def test_animation_to_a_folder_writes_its_frames(tmp_path, name):
    pictures = [make_picture(background=(0, 0, 0, opacity)) for opacity in (0, 120, 255)]
    size = write_animation(iter(pictures), f"{tmp_path}/{name}")
    folder = tmp_path / name
    assert names_in(tmp_path) == [folder.name]
    assert names_in(folder) == ["frame_0000.png", "frame_0001.png", "frame_0002.png"]
    assert size == sum(entry.stat().st_size for entry in folder.iterdir())
    for number, picture in enumerate(pictures):
        assert np.array_equal(np.array(Image.open(folder / f"frame_{number:04d}.png")), picture.image)


def test_folder_of_an_earlier_animation_is_replaced_by_one_with_fewer_frames(tmp_path):
    write_animation(moving_frames(5), tmp_path / "turn")
    write_animation(moving_frames(2), tmp_path / "turn")

    assert names_in(tmp_path / "turn") == ["frame_0000.png", "frame_0001.png"]
    assert names_in(tmp_path) == ["turn"]


def test_folder_of_an_animation_with_another_file_is_refused_and_stays(tmp_path):
    write_animation(moving_frames(2), tmp_path / "turn")
    (tmp_path / "turn" / "notes.txt").write_text("mine")

    with refused(UsageError, "notes.txt", 1):  # thing that is no frame
        write_animation(moving_frames(2), tmp_path / "turn")

    assert names_in(tmp_path / "turn") == ["frame_0000.png", "frame_0001.png", "notes.txt"]


@pytest.mark.parametrize("name", ["turn.mp4", "turn.gif", "turn.apng", "turn"])
def test_interrupted_animation_leaves_no_files_but_an_older_animation(tmp_path, name, request, monkeypatch):
    if name.endswith("mp4"):
        request.getfixturevalue("encoder")
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    place = tmp_path / "place"
    place.mkdir()

    def interrupted():
        yield from moving_frames(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_animation(interrupted(), place / name)
    assert names_in(place) == []
    write_animation(moving_frames(2), place / name)
    with pytest.raises(KeyboardInterrupt):
        write_animation(interrupted(), place / name)
    assert names_in(place) == [name] and names_in(scratch) == []
    if name == "turn":
        assert len(names_in(place / name)) == 2


@pytest.mark.parametrize("name", ["turn.gif", "turn"])
def test_staged_animation_replaces_the_older_one_only_when_it_is_committed(tmp_path, name):
    write_animation(moving_frames(2), tmp_path / name)

    with stage_animation(moving_frames(3), tmp_path / name) as staged:
        assert staged.size > 0
        assert count_frames(tmp_path / name) == 2
        staged.commit()

    assert (names_in(tmp_path), count_frames(tmp_path / name)) == ([name], 3)


@pytest.mark.parametrize("name", ["turn.gif", "turn"])
def test_staged_animation_that_is_not_committed_leaves_the_older_one(tmp_path, name):
    write_animation(moving_frames(2), tmp_path / name)

    with stage_animation(moving_frames(3), tmp_path / name):
        pass

    assert (names_in(tmp_path), count_frames(tmp_path / name)) == ([name], 2)


def count_frames(path) -> int:
    if path.is_dir():
        return len(names_in(path))
    with Image.open(path) as read:
        return read.n_frames


@pytest.mark.parametrize("name", ["turn.mp4", "turn.gif", "turn.apng", "turn"])
def test_frames_of_an_animation_are_asked_for_one_by_one_with_their_progress(tmp_path, name, request):
    if name.endswith("mp4"):
        request.getfixturevalue("encoder")
    asked: list = []
    told: list = []

    def watched():
        for number, frame in enumerate(moving_frames(4)):
            asked.append((number, len(told)))
            yield frame

    write_animation(watched(), tmp_path / name, total=4, progress=lambda *step: told.append(step))
    assert told == [("frames", done, 4) for done in (1, 2, 3, 4)]
    assert asked == [(0, 0), (1, 1), (2, 2), (3, 3)]


def never():
    """Frames that must not be asked for."""
    raise AssertionError("a frame was computed")
    yield


@pytest.mark.parametrize(
    ("name", "fps", "error", "message"),
    [
        ("turn.avi", 25, UsageError, "use one of .mp4, .webm, .gif, .apng, or a name without extension"),
        ("turn.png", 25, UsageError, "folder of PNG files"),
        ("turn.gif", 60, UsageError, "GIF takes 0.1 to 50 frames a second"),
        ("turn", 0, UsageError, "a folder of frames takes"),
        ("turn.apng", "fast", UsageError, "frames a second"),
        ("none/turn.gif", 25, OutputError, "does not exist, make it first"),
        ("none/turn", 25, OutputError, "does not exist, make it first"),
        ("file", 25, OutputError, "it is a file"),
    ],
)
def test_animation_that_cannot_be_written_is_refused_before_the_first_frame(tmp_path, name, fps, error, message):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(error, match=message):
        write_animation(never(), tmp_path / name, fps)
    assert names_in(tmp_path) == ["file"]


@pytest.fixture
def no_encoder(monkeypatch):
    """imageio-ffmpeg is absent; the `monkeypatch` with which a test says what is on the PATH."""
    movies.find_encoder.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    yield monkeypatch
    movies.find_encoder.cache_clear()


def test_mp4_without_an_encoder_is_refused_before_the_first_frame(tmp_path, no_encoder):
    no_encoder.setenv("PATH", str(tmp_path))

    with refused(UsageError, "MP4"):
        write_animation(never(), tmp_path / "turn.mp4")

    assert names_in(tmp_path) == []


def test_webm_by_an_ffmpeg_without_vp9_is_refused(tmp_path, no_encoder):
    fake_ffmpeg(tmp_path, "echo ' V..... libx264 '")
    no_encoder.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    with refused(UsageError, "VP9"):
        check_animation(tmp_path / "turn.webm")


def test_gif_needs_no_encoder(tmp_path, no_encoder):
    no_encoder.setenv("PATH", str(tmp_path))
    assert check_animation(tmp_path / "turn.gif") == ".gif"


def fake_ffmpeg(folder, script: str):
    program = folder / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)


def test_mp4_by_an_ffmpeg_without_h264_is_refused(tmp_path, no_encoder):
    fake_ffmpeg(tmp_path, "echo ' V..... mpeg4'")
    no_encoder.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    with refused(UsageError, "H.264"):
        check_animation(tmp_path / "turn.mp4")


def test_mp4_by_an_encoder_that_fails_is_refused_and_leaves_no_file(tmp_path, no_encoder):
    fake_ffmpeg(tmp_path, 'case "$*" in *-encoders) echo " V libx264 "; exit;; esac; echo "No space left" >&2; exit 1')
    no_encoder.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    with refused(OutputError, "MP4", "space"):  # what the encoder said last
        write_animation(moving_frames(9, size=(640, 480)), tmp_path / "turn.mp4")
    assert names_in(tmp_path) == ["ffmpeg"]


@pytest.mark.parametrize(
    ("frames", "name", "message"),
    [
        ([], "a.gif", "at least one frame"),
        ([], "a", "at least one frame"),
        ([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 5, 3), np.uint8)], "a.apng", r"frame 1 has shape \(4, 5, 3\)"),
        ([np.zeros((4, 4), np.uint8)], "a.gif", "no picture of uint8"),
        ([np.zeros((4, 4, 3))], "a.gif", "no picture of uint8"),
        ([np.zeros((4, 4, 4), np.uint8)], "a.gif", "GIF cannot hold a transparent background"),
    ],
)
def test_frames_of_no_common_form_are_refused(tmp_path, frames, name, message):
    with pytest.raises(UsageError, match=message):
        write_animation(iter(frames), tmp_path / name)
    assert names_in(tmp_path) == []


def test_number_as_the_name_of_an_animation_is_refused():
    with refused(UsageError, "path", "int"):
        motion.check_animation(5)
