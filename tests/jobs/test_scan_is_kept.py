"""No output replaces a slice of the scan, or any other file that is read, whatever name leads there."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from dicom_series import Plan, write_series
from refusals import refused

from clrecon.cli.main import main
from clrecon.errors import ClreconError, OutputError, UsageError
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import RenderSettings, Turntable
from clrecon.proof.bench import run_bench
from clrecon.system.files import replace_file

DICOM_THERE = "a DICOM file is there, which is never replaced"


@pytest.fixture
def scan(tmp_path, monkeypatch):
    """A scan of files without suffix; at the end of the test its bytes are what they were."""
    folder = tmp_path / "ct"
    write_series(folder, Plan(shape=(4, 5, 6), name="IM{:04d}".format))
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    monkeypatch.chdir(tmp_path)
    yield folder
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def lead(how: str, slice_file: Path, name: str) -> str:
    """A name with the extension of `name` that leads to the slice."""
    other = slice_file.parent.parent / name
    if how == "link":
        other.symlink_to(slice_file)
    elif how == "link to a link":
        middle = other.with_name("middle")
        middle.symlink_to(slice_file)
        other.symlink_to("middle")
    else:
        os.link(slice_file, other)
    return str(other)


def jobs(path: str) -> list[Callable[[], object]]:
    """Every output of every job in the place `path`, which is asked for by its extension."""
    turntable = RenderSettings.of(turntable=Turntable(frames=2))
    places: dict[str, list[Callable[[], object]]] = {
        ".stl": [lambda: make_mesh("ct", path)],
        ".json": [
            lambda: make_mesh("ct", "a.stl", report_path=path),
            lambda: make_pictures("ct", PictureFiles("a.png", report=path)),
            lambda: run_bench("ct", report_path=path),
        ],
        ".png": [lambda: make_pictures("ct", PictureFiles(path))],
        ".npy": [
            lambda: make_pictures("ct", PictureFiles("a.png", depth=path)),
            lambda: make_pictures("ct", PictureFiles("a.png", values=path), RenderSettings.of(mode="mip")),
        ],
        ".gif": [lambda: make_pictures("ct", PictureFiles(turntable=path), turntable)],
    }
    return places[Path(path).suffix]


@pytest.mark.parametrize("how", ["link", "link to a link", "hard link"])
@pytest.mark.parametrize("extension", [".stl", ".json", ".png", ".npy", ".gif"])
def test_no_output_replaces_a_slice(scan, how, extension):
    path = lead(how, scan / "IM0001", f"out{extension}")
    for job in jobs(path):
        with pytest.raises(OutputError, match=DICOM_THERE):
            job()


def test_report_replaces_no_slice_of_its_name(scan, printed):
    assert main(["mesh", "ct", "-o", "a.stl", "--report", "ct/IM0001"]) == 6
    told = printed()
    assert told.output_lines == 0
    assert told.error_lines == 1
    told.assert_error("IM0001", "DICOM")
    assert not Path("a.stl").exists()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system has no /proc")
def test_report_replaces_no_slice_behind_an_open_descriptor(scan):
    descriptor = os.open(scan / "IM0001", os.O_RDWR)
    try:
        with pytest.raises(OutputError, match="it leads to an open stream"):
            make_mesh("ct", "a.stl", report_path=f"/proc/self/fd/{descriptor}")
    finally:
        os.close(descriptor)


def test_report_replaces_no_dicom_file_of_another_scan(scan, tmp_path):
    """Nor does anything else that writes with `replace_file`."""
    other = tmp_path / "other.json"
    other.write_bytes((scan / "IM0001").read_bytes())
    with refused(OutputError, "other.json", "DICOM"):
        make_mesh("ct", "a.stl", report_path=other)
    with refused(OutputError, "other.json", "DICOM"):
        replace_file(other, lambda stream: stream.write(b"new"))
    assert other.read_bytes() == (scan / "IM0001").read_bytes()


def test_report_replaces_no_bare_data_set_of_the_scan(scan):
    file = scan / "IM0003"
    whole = file.read_bytes()
    start = whole.index(b"\x08\0\x08\0CS")
    file.write_bytes(whole[start:])
    with refused(UsageError, "DICOM", "data"):
        make_mesh("ct", "a.stl", report_path=file)
    file.write_bytes(whole)


@pytest.mark.parametrize("folder", ["ct", ".", "frames"])
def test_folder_of_frames_replaces_no_scan(scan, tmp_path, folder):
    """Also where its slices are called as frames are."""
    frames = tmp_path / "frames"
    frames.mkdir()
    for number, file in enumerate(sorted(scan.iterdir())):
        (frames / f"frame_{number:04d}.png").write_bytes(file.read_bytes())
    settings = RenderSettings.of(turntable=Turntable(frames=2))
    with pytest.raises(ClreconError, match="holds other things|DICOM files are there|would replace"):
        make_pictures("frames", PictureFiles(turntable=str(tmp_path / folder)), settings)
    assert len(list(frames.iterdir())) == 4


def test_report_replaces_no_voxels_that_a_header_names(tmp_path, monkeypatch):
    pytest.importorskip("SimpleITK")
    import SimpleITK

    monkeypatch.chdir(tmp_path)
    SimpleITK.WriteImage(SimpleITK.GetImageFromArray(np.zeros((3, 4, 5), "i2")), "ct.mhd")
    voxels = Path("ct.raw").read_bytes()
    with refused(UsageError, "ct.raw"):
        make_mesh("ct.mhd", "a.stl", report_path="ct.raw")
    with refused(UsageError, "report", "ct.mhd"):
        run_bench("ct.mhd", report_path="ct.mhd")
    assert Path("ct.raw").read_bytes() == voxels


def test_earlier_outputs_are_replaced(scan, tmp_path):
    """An older report or mesh, also beside the slices, is no slice."""
    for name in ("a.json", "ct2.json"):
        Path(name).write_text("{}")
        replace_file(name, lambda stream: stream.write(b"[]"))
        assert Path(name).read_text() == "[]"
