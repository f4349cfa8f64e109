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
from clrecon.jobs.cloud.job import CloudFiles, make_cloud
from clrecon.jobs.export import export_volume
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import RenderSettings, Turntable
from clrecon.jobs.vertebrae import make_vertebrae
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


def make_path_to(how: str, slice_file: Path, name: str) -> str:
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


OUTPUTS: dict[str, tuple[str, Callable[[str], object]]] = {
    "mesh": (".stl", lambda path: make_mesh("ct", path)),
    "report of a mesh": (".json", lambda path: make_mesh("ct", "a.stl", report_path=path)),
    "report of a picture": (".json", lambda path: make_pictures("ct", PictureFiles("a.png", report=path))),
    "report of a bench": (".json", lambda path: run_bench("ct", report_path=path)),
    "picture": (".png", lambda path: make_pictures("ct", PictureFiles(path))),
    "depths": (".npy", lambda path: make_pictures("ct", PictureFiles("a.png", depth=path))),
    "values": (
        ".npy",
        lambda path: make_pictures("ct", PictureFiles("a.png", values=path), RenderSettings.of(mode="mip")),
    ),
    "movie": (
        ".gif",
        lambda path: make_pictures(
            "ct", PictureFiles(turntable=path), RenderSettings.of(turntable=Turntable(frames=2))
        ),
    ),
    "cloud": (".ply", lambda path: make_cloud("ct", CloudFiles(path))),
    "removed points": (".ply", lambda path: make_cloud("ct", CloudFiles("a.ply", removed=path))),
    "surface of a cloud": (".stl", lambda path: make_cloud("ct", CloudFiles("a.ply", surface=path))),
    "report of a cloud": (".json", lambda path: make_cloud("ct", CloudFiles("a.ply", report=path))),
    "volume": (".nrrd", lambda path: export_volume("ct", path)),
    "report of a volume": (".json", lambda path: export_volume("ct", "a.nrrd", report_path=path)),
    "map of vertebrae": (".nii.gz", lambda path: make_vertebrae("ct", path)),
}
"""Outputs of jobs that need a scan alone: their extension, and a job that writes to a path."""


@pytest.mark.parametrize("link", ["link", "link to a link", "hard link"])
@pytest.mark.parametrize(("extension", "run_job"), OUTPUTS.values(), ids=OUTPUTS)
def test_output_of_a_job_over_a_slice_by_a_link_is_refused(scan, link, extension, run_job):
    path = make_path_to(link, scan / "IM0001", f"out{extension}")
    with pytest.raises(OutputError, match=DICOM_THERE):
        run_job(path)


def test_report_over_a_slice_is_refused_in_one_line_and_no_mesh_is_written(scan, printed):
    assert main(["mesh", "ct", "-o", "a.stl", "--report", "ct/IM0001"]) == 6
    told = printed()
    assert told.output_lines == 0
    assert told.error_lines == 1
    told.assert_error("IM0001", "DICOM")
    assert not Path("a.stl").exists()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system has no /proc")
def test_report_over_a_slice_by_an_open_descriptor_is_refused(scan):
    descriptor = os.open(scan / "IM0001", os.O_RDWR)
    try:
        with pytest.raises(OutputError, match="it leads to an open stream"):
            make_mesh("ct", "a.stl", report_path=f"/proc/self/fd/{descriptor}")
    finally:
        os.close(descriptor)


def test_report_over_a_dicom_file_of_another_scan_is_refused(scan, tmp_path):
    other = tmp_path / "other.json"
    other.write_bytes((scan / "IM0001").read_bytes())

    with refused(OutputError, "other.json", "DICOM"):
        make_mesh("ct", "a.stl", report_path=other)

    assert other.read_bytes() == (scan / "IM0001").read_bytes()


def test_replacing_a_dicom_file_is_refused_whatever_the_writer(scan, tmp_path):
    other = tmp_path / "other.json"
    other.write_bytes((scan / "IM0001").read_bytes())

    with refused(OutputError, "other.json", "DICOM"):
        replace_file(other, lambda stream: stream.write(b"new"))

    assert other.read_bytes() == (scan / "IM0001").read_bytes()


def test_report_over_a_slice_without_the_head_of_dicom_files_is_refused(scan):
    file = scan / "IM0003"
    whole = file.read_bytes()
    first_element = whole.index(b"\x08\0\x08\0CS")  # ImageType
    file.write_bytes(whole[first_element:])

    with refused(UsageError, "DICOM", "data"):
        make_mesh("ct", "a.stl", report_path=file)

    assert file.read_bytes() == whole[first_element:]
    file.write_bytes(whole)  # as `scan` expects it


@pytest.mark.parametrize("folder", ["ct", ".", "frames"])
def test_folder_of_frames_over_a_scan_is_refused(scan, tmp_path, folder):
    """Also where its slices are called as frames are."""
    frames = tmp_path / "frames"
    frames.mkdir()
    for number, file in enumerate(sorted(scan.iterdir())):
        (frames / f"frame_{number:04d}.png").write_bytes(file.read_bytes())
    settings = RenderSettings.of(turntable=Turntable(frames=2))
    with pytest.raises(ClreconError, match="holds other things|DICOM files are there|would replace"):
        make_pictures("frames", PictureFiles(turntable=str(tmp_path / folder)), settings)
    assert len(list(frames.iterdir())) == 4


@pytest.fixture
def header_and_voxels(tmp_path, monkeypatch):
    """ct.mhd, and ct.raw, which it names."""
    sitk = pytest.importorskip("SimpleITK")
    monkeypatch.chdir(tmp_path)
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((3, 4, 5), "i2")), "ct.mhd")


@pytest.mark.usefixtures("header_and_voxels")
def test_report_over_the_voxel_file_that_a_header_names_is_refused():
    before = Path("ct.raw").read_bytes()

    with refused(UsageError, "ct.raw"):
        make_mesh("ct.mhd", "a.stl", report_path="ct.raw")

    assert Path("ct.raw").read_bytes() == before


@pytest.mark.usefixtures("header_and_voxels")
def test_report_over_the_header_of_a_scan_is_refused():
    before = Path("ct.mhd").read_bytes()

    with refused(UsageError, "report", "ct.mhd"):
        run_bench("ct.mhd", report_path="ct.mhd")

    assert Path("ct.mhd").read_bytes() == before


@pytest.mark.usefixtures("scan")
@pytest.mark.parametrize("name", ["a.json", "ct2.json"])
def test_earlier_json_beside_a_scan_is_replaced(name):
    Path(name).write_text("{}")
    replace_file(name, lambda stream: stream.write(b"[]"))
    assert Path(name).read_text() == "[]"
