"""Data sets without preamble or meta header (read on demand alone), and programs in the preamble."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, write_series
from enhanced_image import make_enhanced
from hostile_bytes import NATIVE, make_series, save_bytes
from pydicom.uid import JPEG2000Lossless
from refusals import refused

from clrecon.cli.main import main
from clrecon.errors import NoDicomError, RefusedInputError
from clrecon.reading import list_series, read_volume

PLAN = Plan(shape=(3, 3, 4))  # as `make_series` has it
MARK_END = 132
ENCODINGS = {
    "explicit": "explicit VR little endian",
    "implicit": "implicit VR little endian",
    "big endian": "explicit VR big endian",
}


def meta_end(data: bytes) -> int:
    """Behind the meta header, whose length stands in bytes 140 to 143."""
    return 144 + int.from_bytes(data[140:144], "little")


def cut_all(data: bytes) -> bytes:
    return data[meta_end(data) :]


def cut_preamble(data: bytes) -> bytes:
    return data[MARK_END:]


def cut_zeros(data: bytes) -> bytes:
    return data[128:]


def cut_meta(data: bytes) -> bytes:
    return data[:MARK_END] + data[meta_end(data) :]


def write_cut(folder, files, cut):
    """A folder of these files, each without what `cut` takes away."""
    folder.mkdir(exist_ok=True)
    for k, data in enumerate(files):
        (folder / f"{k}").write_bytes(cut(data))
    return folder


BARE = pytest.mark.parametrize("cut", [cut_all, cut_meta], ids=["no preamble and meta header", "no meta header"])


@pytest.mark.fault_row(36)
@BARE
@pytest.mark.parametrize("name", ENCODINGS)
def test_bare_data_sets_are_refused_with_the_parameter_that_reads_them(tmp_path, name, cut):
    folder = write_cut(tmp_path / "ct", make_series(NATIVE[name]), cut)
    with refused(NoDicomError if cut is cut_all else RefusedInputError, "force=True"):
        read_volume(folder)


@pytest.mark.fault_row(36)
@BARE
@pytest.mark.parametrize("name", ENCODINGS)
def test_bare_data_sets_are_read_with_force_and_a_warning(tmp_path, name, cut):
    folder = write_cut(tmp_path / "ct", make_series(NATIVE[name]), cut)
    volume = read_volume(folder, force=True)
    assert np.array_equal(volume.voxels, PLAN.hu())
    assert volume.report["warnings"] == [f"no meta header: read on demand, {ENCODINGS[name]} taken (all slices)"]
    assert list_series(folder, force=True).series[0].slices == 3


@pytest.mark.fault_row(36)
@pytest.mark.parametrize("cut", [cut_preamble, cut_zeros])
@pytest.mark.parametrize("syntax", [*NATIVE.values(), JPEG2000Lossless])
def test_meta_header_without_preamble_is_refused_unless_it_is_forced(tmp_path, syntax, cut):
    files = make_series(syntax)
    whole = read_volume(write_cut(tmp_path / "whole", files, bytes))
    folder = write_cut(tmp_path / "ct", files, cut)
    with refused(NoDicomError, 3, "force=True"):
        read_volume(folder)
    volume = read_volume(folder, force=True)
    assert np.array_equal(volume.voxels, whole.voxels)
    assert "no preamble: read on demand (all slices)" in volume.report["warnings"]


@pytest.mark.fault_row(36)
def test_one_bare_slice_refuses_the_series_unless_it_is_forced(tmp_path):
    folder = write_cut(tmp_path / "ct", make_series(NATIVE["explicit"]), bytes)
    (folder / "2").write_bytes(cut_all((folder / "2").read_bytes()))
    with refused(RefusedInputError, "force=True", 2):
        read_volume(folder)
    volume = read_volume(folder, force=True)
    assert volume.voxels.shape[0] == 3
    place = f"at {PLAN.position(2)[2]:.2f} mm"
    assert f"explicit VR little endian taken (1 of 3 slices, {place})" in volume.report["warnings"][0]


@pytest.mark.fault_row(36)
@pytest.mark.parametrize(
    "content",
    [b"\x89PNG\r\n\x1a\n" + bytes(300), b"plain text\n" * 40, b"PK\x03\x04" + bytes(300), b"\x08\0", bytes(500)],
    ids=["PNG", "text", "zip", "two bytes", "zeros"],
)
def test_files_that_are_no_dicom_are_refused_with_force_too(tmp_path, content):
    (tmp_path / "file").write_bytes(content)
    with refused(NoDicomError, "DICOM", "images"):
        read_volume(tmp_path, force=True)


@pytest.mark.fault_row(36)
def test_bare_enhanced_image_is_refused_with_force_too(tmp_path):
    (tmp_path / "frames").write_bytes(cut_all(save_bytes(make_enhanced(PLAN))))
    with refused(RefusedInputError, "image", "header"):
        read_volume(tmp_path, force=True)


@pytest.mark.fault_row(36)
def test_command_names_the_option_that_reads_bare_data_sets_and_reads_them_with_it(tmp_path, printed):
    folder = write_cut(tmp_path / "ct", make_series(NATIVE["implicit"]), cut_all)
    assert main(["info", str(folder)]) == 2
    printed().assert_error("--force")
    assert main(["info", str(folder), "--force"]) == 0
    printed().assert_output("demand")  # no meta header: read on demand


def write_bare_with_long_headers(folder):
    """Three bare slices of 3 x 4 pixels with 40 kB of a private element; bytes are counted behind them."""
    plan = Plan(shape=(3, 3, 4))
    for k in range(3):
        ds = make_dataset(plan, k)
        ds.add_new(0x00091001, "OB", bytes(40_000))
        save_dataset(ds, folder / f"{k}")
        (folder / f"{k}").write_bytes(cut_all((folder / f"{k}").read_bytes()))
    return plan


def test_bare_slices_with_long_headers_are_read_with_force(tmp_path):
    plan = write_bare_with_long_headers(tmp_path)
    assert np.array_equal(read_volume(tmp_path, force=True).voxels, plan.hu())


def test_bare_slice_with_a_long_header_that_lacks_its_last_byte_is_refused_with_both_sizes(tmp_path):
    write_bare_with_long_headers(tmp_path)
    (tmp_path / "1").write_bytes((tmp_path / "1").read_bytes()[:-1])
    pixel_bytes = 3 * 4 * 2  # rows, columns, and the bytes of a pixel
    with refused(RefusedInputError, 1, pixel_bytes, pixel_bytes - 1):
        read_volume(tmp_path, force=True)


@pytest.mark.fault_row(44)
@pytest.mark.parametrize(("start", "kind"), [(b"MZ\x90\0", "Windows"), (b"\x7fELF\x02", "Linux")])
def test_program_in_the_preamble_is_warned_of(tmp_path, start, kind):
    plan = write_series(tmp_path, Plan(shape=(7, 5, 6), name="{}".format))
    for k in (0, 3):
        data = (tmp_path / f"{k}").read_bytes()
        (tmp_path / f"{k}").write_bytes(start + bytes(128 - len(start)) + data[128:])
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    _, _, first_mm = plan.position(0)
    assert volume.report["warnings"] == [
        f"the preamble starts a program ({kind}): neither run nor copied"
        f" (2 of 7 slices, the first at {first_mm:.2f} mm)"
    ]


@pytest.mark.fault_row(44)
def test_tiff_picture_in_the_preamble_is_not_warned_of(tmp_path):
    """Files that are TIFF pictures too are a use that the standard names."""
    plan = write_series(tmp_path, Plan(shape=(7, 5, 6), name="{}".format))
    for k in range(7):
        data = (tmp_path / f"{k}").read_bytes()
        (tmp_path / f"{k}").write_bytes(b"II*\0" + bytes(124) + data[128:])
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == []
