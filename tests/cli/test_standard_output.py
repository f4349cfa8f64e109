"""``-o -`` and ``--report -``: what standard output holds, and nothing else."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from variants import daily_rows

from clrecon.cli import console
from clrecon.cli.main import main
from clrecon.proof.phantom import PhantomSettings, write_phantom


@pytest.fixture(scope="module")
def ct(tmp_path_factory):
    """A series of a sphere in 40 x 40 voxels."""
    folder = tmp_path_factory.mktemp("stream") / "ct"
    write_phantom(folder, PhantomSettings(kind="sphere", size=(40, 40)))
    return folder


def run_clrecon(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


@pytest.mark.parametrize(("output", "extension"), daily_rows(1, [("-", ".stl"), ("-.ply", ".ply"), ("-.glb", ".glb")]))
def test_mesh_on_standard_output_has_the_bytes_of_a_file_in_its_format(
    device, ct, tmp_path, capfdbinary, output, extension
):
    command = ("mesh", ct, "--hu", 200, "--device", device.index)
    assert run_clrecon(*command, "-o", tmp_path / f"a{extension}") == 0
    capfdbinary.readouterr()

    assert run_clrecon(*command, "-o", output) == 0

    streamed, _ = capfdbinary.readouterr()
    assert streamed == (tmp_path / f"a{extension}").read_bytes()


@pytest.mark.release
def test_mesh_on_standard_output_in_3mf_is_a_package_of_it(device, ct, capfdbinary):
    assert run_clrecon("mesh", ct, "--hu", 200, "--device", device.index, "-o", "-.3mf") == 0

    streamed, _ = capfdbinary.readouterr()
    with zipfile.ZipFile(io.BytesIO(streamed)) as package:  # whose bytes hold the time
        assert b"<triangle " in package.read("3D/3dmodel.model")


@pytest.mark.parametrize(("output", "is_in_metres"), daily_rows(1, [("-", False), ("-.glb", True)]))
def test_words_of_a_mesh_on_standard_output_go_to_standard_error_with_its_unit(
    device, ct, capfdbinary, output, is_in_metres
):
    assert run_clrecon("mesh", ct, "--hu", 200, "--device", device.index, "-o", output) == 0

    _, words = capfdbinary.readouterr()
    assert b"input    " in words
    assert b"wrote    standard output, " in words
    assert b"clrecon-" not in words  # the name of the file behind it
    assert (b"metres, Y up" in words) == is_in_metres


@pytest.mark.release
def test_report_on_standard_output_is_that_in_a_file_and_words_go_to_standard_error(device, ct, tmp_path, printed):
    common = ("mesh", ct, "--hu", 200, "-o", tmp_path / "a.stl", "--device", device.index)
    assert run_clrecon(*common, "--report", tmp_path / "r.json") == 0
    written = json.loads((tmp_path / "r.json").read_text())
    printed()
    assert run_clrecon(*common, "--report", "-") == 0
    said = printed()
    streamed = said.report()
    assert streamed.keys() == written.keys()
    assert streamed["volume_ml"] == written["volume_ml"] is not None
    said.assert_error("wrote", "a.stl")
    assert not (tmp_path / "-").exists() and not os.path.exists("-")


@pytest.mark.parametrize(
    ("arguments", "start"),
    [
        (("cloud", "--hu", 200, "-o", "-"), b"ply"),
        (("export", "-o", "-.nrrd"), b"NRRD"),
        (("render", "--size", "40x40", "-o", "-"), b"\x89PNG"),
    ],
)
def test_result_of_another_command_goes_to_standard_output(device, ct, capfdbinary, arguments, start):
    command, *options = arguments
    at = [] if command == "export" else ["--device", device.index]

    assert run_clrecon(command, ct, *options, *at) == 0

    streamed, words = capfdbinary.readouterr()
    assert streamed.startswith(start)
    assert len(streamed) > 500  # bytes, more than a start: measured 556 of the picture, which is the smallest
    assert b"wrote    " in words


def test_cloud_on_standard_output_in_xyz_is_three_coordinates_a_line(device, ct, capfdbinary):
    assert run_clrecon("cloud", ct, "--hu", 200, "-o", "-.xyz", "--device", device.index) == 0

    streamed, _ = capfdbinary.readouterr()
    assert np.loadtxt(io.BytesIO(streamed))[:, :3].shape[0] > 1000  # points of a cloud of 2,686


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("mesh", "-o", "-", "--report", "-"), "-o and --report cannot share standard output"),
        (("mesh", "-o", "-", "--json"), "-o and --json cannot share standard output"),
        (("mesh", "-o", "-.stp"), "the extension '.stp'"),
        (("mesh", "-o", "-", "--hu", "200,300"), "-o -: several iso values make several files"),
        (("mesh", "-o", "-", "--below", "-400,-300"), "-o -: several iso values make several files"),
        (("mesh", "-o", "-", "--split"), "-o -: the components of --split make several files"),
        (("mesh", "-o", "-.ply", "--labels", "gone.nii"), "-o -.ply: labels (name one with --label) make several"),
        (("render", "-o", "-", "--view", "left,right"), "-o -: several views make several files"),
        (("render", "-o", "-", "--turntable", "-", "--frames", "3"), "--turntable -: an animation needs a file or a"),
        (("render", "--turntable", "-", "--frames", "3"), "--turntable -: an animation needs a file or a folder"),
        (("render", "--turntable=-.mp4"), "--turntable -.mp4: an animation needs a file or a folder"),
        (("compare", "-o", "-"), "-o -: compare writes several files, which one stream cannot hold"),
    ],
)
def test_wrong_output_for_standard_output_is_refused_in_one_line_before_any_work(ct, capfdbinary, arguments, words):
    command, *rest = arguments
    assert run_clrecon(command, ct, *rest) == 3
    out, err = capfdbinary.readouterr()
    if "--json" not in rest:  # with it the error is an object there
        assert out == b""
    assert b"input    " not in err and not os.path.exists("-")  # refused before any work
    assert words in err.decode() and b"/stream" not in err
    assert len([line for line in err.decode().splitlines() if "error" in line]) == 1


@pytest.fixture(scope="module")
def spine(tmp_path_factory):
    """A series of L2 to L4 with the label map levels.nrrd."""
    folder = tmp_path_factory.mktemp("stream") / "spine"
    write_phantom(folder, PhantomSettings(size=(72, 72), spacing=(2.5, 2.5, 2.5), levels="L2-L4"))
    return folder


@pytest.mark.parametrize(
    ("arguments", "entry"),
    daily_rows(
        4,
        [
            (("stats", "{ct}", "--labels", "{ct}/levels.nrrd"), "labels"),
            (("inside", "{ct}", "-o", "{out}.stl", "--labels", "{ct}/levels.nrrd", "--label", "L3"), "vertebrae"),
            (("vertebrae", "{ct}", "-o", "{out}.nii.gz"), "vertebrae"),
            (("cloud", "{ct}", "-o", "{out}.ply", "--hu", "200"), "points"),
            (("corridor", "{ct}", "--labels", "{ct}/levels.nrrd", "--label", "L3"), "vertebrae"),
            (("export", "{ct}", "-o", "{out}.nii.gz"), "volume"),
            (("render", "{ct}", "-o", "{out}.png", "--size", "40"), "pictures"),
            (("distance", "{out}_a.stl", "{out}_a.stl"), "hausdorff_mm"),
        ],
    ),
)
def test_report_of_other_commands_than_mesh_goes_to_standard_output(
    device, spine, tmp_path, printed, monkeypatch, arguments, entry
):
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    if arguments[0] == "distance":
        assert run_clrecon("mesh", spine, "-o", tmp_path / "out_a.stl", "-q") == 0
    given = [word.format(ct=spine, out=tmp_path / "out") for word in arguments]
    code = run_clrecon(*given, "--report", "-")
    said = printed()
    assert code == 0, said
    assert said.report()[entry] is not None
    said.assert_error("time")
    assert not any(path.name == "-" for path in tmp_path.iterdir())


def test_table_of_labels_goes_to_standard_output_with_a_line_for_each(spine, capfdbinary):
    assert run_clrecon("stats", spine, "--labels", spine / "levels.nrrd", "--csv", "-") == 0
    out, err = capfdbinary.readouterr()
    assert out.startswith(b"number,name,") and out.count(b"\n") == 4  # the head, and a line for each label
    assert b"wrote    standard output" in err


def test_label_map_goes_to_standard_output_without_a_picture(spine, capfdbinary):
    assert run_clrecon("vertebrae", spine, "-o", "-") == 0
    out, err = capfdbinary.readouterr()
    assert out[:2] == b"\x1f\x8b"  # a NIfTI in gzip
    assert b"wrote    standard output" in err and b"picture" not in err


@pytest.mark.parametrize("streamed", ["output", "report"])
def test_failed_mesh_leaves_standard_output_empty(ct, tmp_path, printed, streamed):
    files = ["-o", "-"] if streamed == "output" else ["-o", tmp_path / "a.stl", "--report", "-"]
    assert run_clrecon("mesh", ct, *files, "--hu", 5000) == 2  # no voxel has that much
    assert printed().output_lines == 0


def test_mesh_for_a_terminal_is_refused(ct, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)

    assert run_clrecon("mesh", ct, "-o", "-") == 3

    printed = capsys.readouterr()
    assert "standard output is a terminal" in printed.err
    assert printed.out == ""


MOST_BYTES_IN_A_PIPE = 65_536  # of Linux; fewer elsewhere


def test_reader_that_closes_standard_output_before_all_is_written_is_no_error(device, ct, tmp_path):
    mesh = ["mesh", str(ct), "--hu", "200", "--device", str(device.index)]
    assert run_clrecon(*mesh, "-o", tmp_path / "whole.stl") == 0
    assert (tmp_path / "whole.stl").stat().st_size > MOST_BYTES_IN_A_PIPE  # 268,484: the command has to wait

    command = [sys.executable, "-m", "clrecon", *mesh, "-o", "-"]
    job = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert job.stdout is not None and job.stderr is not None
    job.stdout.read(10)
    job.stdout.close()
    errors = job.stderr.read().decode()
    job.stderr.close()
    assert job.wait(120) == 0, errors
    assert "Traceback" not in errors and "error" not in errors


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
@pytest.mark.parametrize("command", ["mesh", "stats"])
def test_result_for_a_full_disk_behind_standard_output_ends_with_6_and_is_not_said_to_be_written(
    device, ct, spine, command
):
    """A table fits the buffer of the stream: its error comes with the last flush."""
    given = {
        "mesh": [ct, "--hu", 200, "-o", "-", "--device", device.index],
        "stats": [spine, "--labels", spine / "levels.nrrd", "--csv", "-"],
    }
    words = [sys.executable, "-m", "clrecon", command, *map(str, given[command])]
    with open("/dev/full", "wb") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 6
    assert "wrote" not in done.stderr and done.stderr.count("cannot write to standard output") == 1


def test_each_command_with_a_result_for_standard_output_exists():
    from clrecon.cli.main import COMMANDS

    assert set(console.STREAMED) <= set(COMMANDS)
