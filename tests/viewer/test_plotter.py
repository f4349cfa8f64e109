"""A plain window of pyvista on a screen that Xvfb makes, driven by xdotool; and without a screen."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_once import make_once
from refusals import refused
from screens import need_screen, open_screen, open_view
from variants import daily
from view_scenes import ISO, make_cloud, make_labels, make_mesh, make_scan

import clrecon
from clrecon.system.display import NoDisplayError
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.plotter import SIZE, open_plotter

pytestmark = pytest.mark.xdist_group("screen")

PICTURE = (slice(60, 680), slice(150, 950))
"""Rows and columns above the slider and beside the axes."""

HIDE = 'for f in $(ls {folders} 2>/dev/null); do mount --bind /dev/null $f || exit 99; done; exec "$@"'


@pytest.fixture(scope="module")
def display():
    """The name of a screen."""
    with open_screen() as name:
        yield name


@pytest.fixture(scope="module")
def scan_of_balls(shared_folder: Path, device) -> Path:
    """The file of a scan of three balls."""
    return make_once(shared_folder, "view_scan.nii.gz", lambda path: make_scan().save(path))


def shows_bone(seen: np.ndarray) -> bool:
    """True where something has the colour of bone."""
    picture = seen[PICTURE].astype(int)
    return bool(((picture[..., 0] > 90) & (picture[..., 0] > picture[..., 2] + 8)).mean() > 0.01)


@pytest.mark.release
def test_keys_and_slider_of_a_window_turn_clip_and_change_the_iso_value(display, scan_of_balls, tmp_path):
    with open_view(display, [scan_of_balls, "--window", "--hu", f"{ISO:g}"], tmp_path) as window:
        before = window.wait(shows_bone, "the surface")
        assert before.shape[:2] == SIZE[::-1]
        window.key("2")
        behind = window.wait_change(before, PICTURE, share=0.01, what="the scene from behind")
        window.key("c")
        cut = window.wait_change(behind, PICTURE, share=0.01, what="a plane that clips")
        window.key("c")
        window.wait_change(cut, PICTURE, share=0.01, what="the whole scene")
        start, end = ((0.25 + 0.5 * share) * SIZE[0] for share in (0.61, 0.9))  # 300 HU of -800 to 1000, and 820
        window.drag((start, 0.92 * SIZE[1]), (end, 0.92 * SIZE[1]))
        window.wait_change(behind, PICTURE, share=0.002, what="smaller balls at a higher iso value")
        window.key("q")
        code, said, complained = window.finish()
    assert (code, said, "Traceback" in complained) == (0, "", False)


@pytest.mark.release
def test_distance_between_two_clicks_is_written_into_the_window(display, tmp_path):
    make_mesh().save(tmp_path / "ball.stl")
    with open_view(display, ["ball.stl", "--window"], tmp_path) as window:
        before = window.wait(shows_bone, "the ball")
        window.key("m")
        x, y = SIZE[0] / 2, SIZE[1] / 2
        window.click(x - 60, y)
        window.click(x + 60, y)
        window.wait_change(before, (slice(0, 60), slice(700, 1100)), share=0.001, what="the distance in words")
        window.key("q")
        code, _, _ = window.finish()
    assert code == 0


@pytest.mark.release
@pytest.mark.parametrize("how", daily(1, ["interrupt", "window manager"]))  # a session below is closed by the latter
def test_window_ends_by_ctrl_c_and_by_the_window_manager(display, tmp_path, how):
    make_mesh().save(tmp_path / "ball.stl")
    with open_view(display, ["ball.stl", "--window"], tmp_path) as window:
        window.wait(shows_bone, "the ball")
        if how == "interrupt":
            window.process.send_signal(signal.SIGINT)
        else:
            window.close()
        code, _, complained = window.finish()
    assert code == (130 if how == "interrupt" else 0)
    assert complained.endswith("clrecon: error: interrupted\n" if how == "interrupt" else "")
    assert "Traceback" not in complained


@pytest.fixture
def scene(device, monkeypatch):
    """A plotter of a scan, a mesh named front, a cloud and labels; keys by letter, and the widgets asked for."""
    need_screen()
    plotters, asked, keys = pytest.importorskip("pyvista").Plotter, [], {}
    monkeypatch.setattr(plotters, "add_key_event", lambda self, key, callback: keys.update({key: callback}))
    for name in ("add_measurement_widget", "clear_measure_widgets", "add_plane_widget", "clear_plane_widgets"):
        monkeypatch.setattr(plotters, name, lambda *given, name=name, **named: asked.append(name))
    objects = show_objects([make_scan(), make_mesh(), make_cloud(), make_labels()], ["", "front"])
    with open_plotter(objects, iso_value=ISO, device=device, off_screen=True) as plotter:
        yield SimpleNamespace(plotter=plotter, keys=keys, asked=asked)


@pytest.mark.opencl
def test_each_object_is_an_actor_of_the_scene_by_its_name(scene):
    actors = scene.plotter.renderer.actors
    assert {"scan 1", "front", "cloud 3", "labels 4 one", "labels 4 two"} <= set(actors)
    assert actors["cloud 3"].prop.point_size == 3


@pytest.mark.opencl
def test_scan_in_a_scene_is_its_isosurface(scene, device):
    shown = scene.plotter.renderer.actors["scan 1"].mapper.dataset
    mesh = clrecon.extract_isosurface(make_scan(), ISO, device=device)
    np.testing.assert_array_equal(np.sort(shown.points, axis=0), np.sort(mesh.vertices, axis=0))


@pytest.mark.opencl
def test_scene_that_is_to_be_fitted_begins_on_the_bone(device):
    need_screen()
    with open_plotter(
        show_objects([make_scan()]), iso_value=ISO, fitted=True, device=device, off_screen=True
    ) as plotter:
        assert "thickness_mm" in plotter.renderer.actors["scan 1"].mapper.dataset.point_data


@pytest.mark.opencl
def test_key_t_fits_the_scan_to_its_bone_and_back(scene):
    actor = scene.plotter.renderer.actors["scan 1"]
    at_level = np.array(actor.mapper.dataset.points)

    scene.keys["t"]()
    fitted = np.array(actor.mapper.dataset.points)
    scene.keys["t"]()

    assert np.linalg.norm(fitted - at_level, axis=1).mean() > 0.15  # mm; measured 0.31
    np.testing.assert_array_equal(actor.mapper.dataset.points, at_level)


@pytest.mark.opencl
def test_key_capital_t_colours_a_fitted_scan_by_its_thickness_with_a_scale(scene):
    actor = scene.plotter.renderer.actors["scan 1"]

    scene.keys["t"]()
    scene.keys["T"]()

    assert actor.mapper.scalar_visibility
    assert actor.mapper.dataset.point_data.active_scalars_name == "thickness_mm"
    assert list(scene.plotter.scalar_bars.keys()) == ["mm thick"]


@pytest.mark.opencl
@pytest.mark.parametrize("keys", ["T", "tTt"], ids=["never fitted", "no longer fitted"])
def test_scan_that_is_not_fitted_is_not_coloured_by_its_thickness(keys, scene):
    for key in keys:
        scene.keys[key]()

    assert not scene.plotter.renderer.actors["scan 1"].mapper.scalar_visibility
    assert not scene.plotter.scalar_bars.keys()


@pytest.mark.opencl
def test_scene_is_first_seen_from_anterior(scene):
    camera = scene.plotter.camera
    assert camera.position[1] < camera.focal_point[1]


@pytest.mark.opencl
def test_keys_m_and_c_put_measure_and_clip_widgets_on_and_off(scene):
    for key in "mmcc":
        scene.keys[key]()
    assert scene.asked == [
        "add_measurement_widget", "clear_measure_widgets", "add_plane_widget", "clear_plane_widgets",
    ]  # fmt: skip


@pytest.mark.opencl
@pytest.mark.parametrize(
    ("key", "axis", "sign"),
    [("3", 0, 1), ("4", 0, -1), ("5", 2, 1), ("6", 2, -1)],
    ids=["left", "right", "above", "below"],
)
def test_key_of_a_side_turns_the_view_to_it(scene, key, axis, sign):
    scene.keys[key]()
    away = np.subtract(scene.plotter.camera.position, scene.plotter.camera.focal_point)
    assert np.argmax(np.abs(away)) == axis
    assert sign * away[axis] == pytest.approx(np.linalg.norm(away))


def test_method_show_calls_the_function_with_its_object_and_arguments(monkeypatch):
    asked: list[tuple[tuple[object, ...], dict[str, object]]] = []
    monkeypatch.setattr(clrecon, "show", lambda *shown, **given: asked.append((shown, given)), raising=False)
    volume, mesh = make_scan(), make_mesh()
    volume.show(iso_value=250)
    mesh.show()
    assert asked == [((volume,), {"iso_value": 250}), ((mesh,), {})]


def run_refused_view(
    arguments: list[str | Path], folder: Path, environment: dict[str, str], *before: str
) -> tuple[int, str]:
    """The exit code and the standard error of ``clrecon view --window``, run by the command `before`."""
    done = subprocess.run(
        [*before, sys.executable, "-m", "clrecon", "view", "--window", *map(str, arguments)],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.stdout == ""
    return done.returncode, done.stderr


def check_refusal(found: tuple[int, str], words: str) -> None:
    """Assert exit code 3 and one line with these words and the other ways to look at a scan."""
    code, complained = found
    assert code == 3
    assert words in complained and complained.count("\n") == 1
    for way_out in ("without --window", "--html", "clrecon render"):
        assert way_out in complained


def test_window_without_a_display_is_refused_with_the_other_ways(tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    check_refusal(run_refused_view([tmp_path], tmp_path, dict(os.environ)), "there is no display here")
    with refused(NoDisplayError, "window", "DISPLAY"):
        clrecon.show(make_mesh())


@pytest.mark.release
def test_window_on_a_display_that_does_not_answer_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":4711")
    check_refusal(run_refused_view([tmp_path], tmp_path, dict(os.environ)), "the display :4711 does not answer")


@pytest.mark.seconds
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
    check_refusal(run_refused_view([tmp_path], tmp_path, dict(os.environ), *before), "OpenGL does not work")
