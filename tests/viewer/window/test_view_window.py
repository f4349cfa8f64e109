"""A real window on a screen that Xvfb makes, driven by xdotool."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from made_once import make_once
from screens import SIZE, Window, changed_share, need_screen, open_screen, open_view
from view_scenes import make_cloud, make_mesh, make_scan

import clrecon
from clrecon.viewer.window.layout import Layout, lay_out
from clrecon.viewer.window.window import SCREEN_SHARE
from clrecon.viewer.window.window import SIZE as WISHED

pytestmark = pytest.mark.xdist_group("screen")

LAYOUT: Layout = lay_out((min(WISHED[0], round(SCREEN_SHARE * SIZE[0])), min(WISHED[1], round(SCREEN_SHARE * SIZE[1]))))

NOT_DICOM = (
    "clrecon: warning: not DICOM: position, spacing and the meaning of the values are as the file says, nothing vouches"
    " for them\n"
)


@pytest.fixture(scope="module")
def display():
    with open_screen() as name:
        yield name


@pytest.fixture(scope="module")
def scan(shared_folder: Path, device) -> Path:
    return make_once(shared_folder, "view_scan.nii.gz", lambda path: make_scan().save(path))


def region(name: str, layout: Layout = LAYOUT) -> tuple[slice, slice]:
    box = layout.boxes[name]
    return slice(box.top, box.top + box.height), slice(box.left, box.left + box.width)


def middle(name: str) -> tuple[float, float]:
    box = LAYOUT.boxes[name]
    return box.left + box.width / 2, box.top + box.height / 2


def shows_bone(seen: np.ndarray) -> bool:
    """True where the picture has the colour of bone: much brighter than the back, warmer than the letters."""
    picture = seen[region("picture")].astype(int)
    return bool(((picture[..., 0] > 110) & (picture[..., 0] > picture[..., 2] + 8)).mean() > 0.01)


def wait_picture(window: Window) -> np.ndarray:
    return window.wait(shows_bone, "the picture")


def wait_quiet(window: Window) -> np.ndarray:
    """Wait until the window shows the same for a while: the sharp picture is there, and the parts."""
    before, since = window.look(), time.monotonic()
    end = since + 30.0
    while time.monotonic() - since < 0.5 and time.monotonic() < end:
        seen = window.look()
        if seen is None or before is None or seen.shape != before.shape or changed_share(seen, before, 0) > 0.0:
            since = time.monotonic()
        before = seen
    assert before is not None
    return before


def test_a_session_at_the_window(display, scan, tmp_path):
    with open_view(display, [scan, "--save-as", "shown.ply"], tmp_path) as window:
        window.wait(lambda seen: (seen[region("picture")] > 200).sum() > 50, "words")
        window.wait(lambda seen: changed_share(seen[region("axial")], np.zeros(3, np.uint8)) > 0.3, "slices")
        wait_picture(window)
        before = wait_quiet(window)
        assert before.shape[:2] == LAYOUT.size[::-1]

        slider = LAYOUT.boxes["slider"]
        y = slider.top + slider.height / 2
        window.drag((LAYOUT.size[0] * 0.62, y), (LAYOUT.size[0] * 0.8, y))
        higher = window.wait_change(before, region("picture"), 0.002, "smaller balls at a higher iso value")
        assert changed_share(higher[region("slider")], before[region("slider")]) > 0.01

        x, y = middle("picture")
        still = wait_quiet(window)
        window.drag((x - 80, y), (x + 160, y + 30))
        window.wait_change(still, region("picture"), 0.01, "the scene from another side")
        still = wait_quiet(window)
        window.key("2")
        window.wait_change(still, region("picture"), 0.01, "the scene from behind")

        still = wait_quiet(window)
        window.wheel(*middle("axial"), 3)
        window.wait_change(still, region("axial"), 0.005, "another slice")
        still = wait_quiet(window)
        window.drag(middle("sagittal"), (middle("sagittal")[0] - 60, middle("sagittal")[1] + 40), button=3)
        window.wait_change(still, region("sagittal"), 0.02, "another window and level")

        still = wait_quiet(window)
        window.key("h")
        window.wait_change(still, region("picture"), 0.01, "the help")
        window.key("h")
        wait_picture(window)

        still = wait_quiet(window)
        window.key("m")
        x, y = brightest(still)
        window.click(x, y)
        window.wait(lambda seen: yellow_pixels(seen) > 10, "the first point")
        window.click(x + 3, y + 8)
        yellow = window.wait(lambda seen: yellow_pixels(seen) > 90, "a measure")
        assert changed_share(yellow[region("status")], still[region("status")]) > 0.001

        window.key("s")
        end = time.monotonic() + 30.0
        while not (tmp_path / "shown.ply").exists() and time.monotonic() < end:
            time.sleep(0.05)
        assert clrecon.read_mesh(tmp_path / "shown.ply").triangle_count > 100
        window.key("q")
        code, said, complained = window.finish()
    assert (code, complained) == (0, NOT_DICOM)
    assert "wrote    shown.ply" in said


def yellow_pixels(seen: np.ndarray) -> int:
    red, green, blue = np.moveaxis(seen[region("picture")].astype(int), 2, 0)
    return int(((red > 220) & (green > 180) & (blue < 120)).sum())


def test_parts_are_hidden_and_brought_back(display, scan, tmp_path):
    with open_view(display, [scan], tmp_path) as window:
        wait_picture(window)
        whole = wait_quiet(window)
        window.move(*brightest(whole))
        window.key("x")
        window.wait_change(whole, region("picture"), 0.002, "the scene without a part")
        window.wait_change(whole, region("side"), 0.0005, "the part without its tick")
        less = wait_quiet(window)
        window.key("u")
        window.wait_change(less, region("side"), 0.0005, "its tick")
        window.wait_change(less, region("picture"), 0.002, "the part")
        window.key("q")
        assert window.finish()[0] == 0


def brightest(seen: np.ndarray) -> tuple[float, float]:
    """The middle of the bone that is seen most."""
    box = LAYOUT.boxes["picture"]
    picture = seen[region("picture")].astype(int)
    rows, columns = np.nonzero((picture[..., 0] > 110) & (picture[..., 0] > picture[..., 2] + 8))
    weight = np.bincount(columns, minlength=box.width)
    column = int(np.convolve(weight, np.ones(9), "same").argmax())
    return box.left + column, box.top + int(np.median(rows[np.abs(columns - column) < 3]))


def test_scan_mesh_and_cloud_lie_together_and_ras_is_said(display, scan, tmp_path):
    make_mesh().save(tmp_path / "front.ply", space="ras")
    make_cloud().save(tmp_path / "points.npz")
    with open_view(display, [scan, "front.ply", "points.npz"], tmp_path) as window:
        wait_picture(window)
        wait_quiet(window)
        window.key("q")
        code, _, complained = window.finish()
    assert code == 0
    assert "front.ply was turned from RAS to LPS" in complained


def test_a_mesh_alone_has_the_whole_window(display, tmp_path, device):
    make_mesh().save(tmp_path / "ball.stl")
    with open_view(display, ["ball.stl"], tmp_path) as window:
        wait_picture(window)
        seen = wait_quiet(window)
        alone = lay_out(LAYOUT.size, slices=False)
        assert not any(plane in alone.boxes for plane in ("axial", "coronal", "sagittal"))
        picture = seen[region("picture", alone)]
        rows, columns = np.nonzero(picture.max(axis=2) > 110)
        assert abs(np.median(columns) - picture.shape[1] / 2) < 20
        window.key("q")
        assert window.finish()[0] == 0


@pytest.mark.parametrize(
    ("when", "how"),
    [
        ("at once", "key"),
        ("at once", "interrupt"),
        ("while it works", "window manager"),
        ("while it works", "interrupt"),
    ],
)
def test_closing_while_it_works_ends_it_soon_and_says_nothing(display, scan, tmp_path, how, when):
    with open_view(display, [scan], tmp_path) as window:
        if when == "while it works":
            wait_picture(window)
            x, y = middle("picture")
            window.drag((x, y), (x + 60, y))
        else:
            window.wait(lambda seen: (seen[region("picture")] > 200).sum() > 50, "words")
        begun = time.monotonic()
        if how == "key":
            window.key("q")
        elif how == "window manager":
            window.close()
        else:
            window.process.send_signal(signal.SIGINT)
        code, _, complained = window.finish()
        assert time.monotonic() - begun < 20.0  # a thread that is not told to end waits for ever
    interrupted = "clrecon: error: interrupted\n" if how == "interrupt" else ""
    assert code == (130 if how == "interrupt" else 0)
    assert complained in (interrupted, NOT_DICOM + interrupted)


def refusal(arguments: list[str | Path], folder: Path, environment: dict[str, str], *before: str) -> tuple[int, str]:
    done = subprocess.run(
        [*before, sys.executable, "-m", "clrecon", "view", *map(str, arguments)],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.stdout == ""
    return done.returncode, done.stderr


def check_refusal(found: tuple[int, str], words: str) -> None:
    code, complained = found
    assert code == 3
    assert words in complained and complained.count("\n") == 1
    for way_out in ("--web", "--html", "clrecon render"):
        assert way_out in complained


def test_without_a_display_the_other_ways_are_said(tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    check_refusal(refusal([tmp_path], tmp_path, dict(os.environ)), "there is no display here")


def test_a_display_that_does_not_answer_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":4711")
    check_refusal(refusal([tmp_path], tmp_path, dict(os.environ)), "the display :4711 does not answer")


HIDE = 'for f in $(ls {folders} 2>/dev/null); do mount --bind /dev/null $f || exit 99; done; exec "$@"'


def test_without_opengl_no_process_dies_of_a_signal(display, tmp_path, monkeypatch):
    """The libraries of OpenGL are hidden in a mount namespace of the child."""
    need_screen()
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode:
        pytest.skip("needs unshare -m, which a container may not allow")
    monkeypatch.setenv("DISPLAY", display)
    names = "lib{GL,EGL,GLX_mesa,EGL_mesa,OSMesa}.so.*"
    hide = HIDE.format(folders=f"/usr/lib/{names} /usr/lib/*-linux-gnu/{names} /usr/lib64/{names}")
    before = ("unshare", "-m", "bash", "-c", hide, "hide")
    tried = subprocess.run([*before, "true"], capture_output=True)
    if tried.returncode:
        pytest.skip(f"libraries cannot be hidden here: {tried.stderr.decode()[-200:]}")
    check_refusal(refusal([tmp_path], tmp_path, dict(os.environ), *before), "OpenGL does not work")
