"""A label map that takes long to unpack is held against its scan before it is."""

from __future__ import annotations

import zlib
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ct_files import write_series
from printed_text import Printer
from refusals import refused

import clrecon
from clrecon.cli.main import main
from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.labels.reader import is_large_map

MEMBER = 2**26


def pack(content: bytes) -> bytes:
    packer = zlib.compressobj(6, zlib.DEFLATED, 31)
    return packer.compress(content) + packer.flush()


ZEROS_SHAPE = (2048, 2048, 1024)


@pytest.fixture(scope="module")
def maps_of_zeros(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """34 GB of zeros in 33 MB, as `.nii.gz` and `.nrrd` with gzip, which joins streams that follow each other."""
    nibabel = pytest.importorskip("nibabel")
    folder = tmp_path_factory.mktemp("zeros")
    nifti_header = nibabel.Nifti1Header()
    nifti_header.set_data_shape(ZEROS_SHAPE)
    nifti_header.set_data_dtype(np.int64)
    nifti_header.set_sform(np.eye(4), 1)
    nifti_header["magic"], nifti_header["vox_offset"] = b"n+1", 352
    nrrd_header = (
        b"NRRD0004\ntype: int64\ndimension: 3\nspace: left-posterior-superior\nsizes: 2048 2048 1024\n"
        b"space directions: (1,0,0) (0,1,0) (0,0,1)\nkinds: domain domain domain\nendian: little\nencoding: gzip\n"
        b"space origin: (0,0,0)\n\n"
    )
    packed_zeros = pack(bytes(MEMBER)) * (2**35 // MEMBER)
    (folder / "zeros.nii.gz").write_bytes(pack(nifti_header.binaryblock + bytes(4)) + packed_zeros)
    (folder / "zeros.nrrd").write_bytes(nrrd_header + packed_zeros)
    return {path.suffix: path for path in folder.iterdir()}


@pytest.mark.parametrize("suffix", [".gz", ".nrrd"])
def test_map_of_34_gb_in_33_mb_is_called_large(suffix: str, maps_of_zeros: dict[str, Path]) -> None:
    assert maps_of_zeros[suffix].stat().st_size < 34e6  # measured 33.4e6
    assert is_large_map(maps_of_zeros[suffix])


@pytest.mark.parametrize("suffix", [".gz", ".nrrd"])
def test_large_map_of_far_more_voxels_than_its_scan_is_refused_before_it_is_unpacked(
    suffix: str, maps_of_zeros: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def unpack(*_: Any) -> None:
        raise AssertionError("unpacked")

    monkeypatch.setattr("clrecon.labels.label_grids.iterate_labels", unpack)
    scan = Volume(np.zeros((17, 25, 31), np.int16), np.eye(4))
    times_as_many = round(prod(ZEROS_SHAPE) / (17 * 25 * 31))
    with refused(RefusedInputError, 2048, 1024, times_as_many):
        clrecon.read_labels(maps_of_zeros[suffix], volume=scan)


@pytest.mark.parametrize(("command", "output"), [("mesh", "a.stl"), ("render", "a.png")], ids=["mesh", "render"])
def test_commands_refuse_a_large_map_out_of_proportion_in_one_line_and_write_nothing(
    command: str, output: str, device: Any, maps_of_zeros: dict[str, Path], tmp_path: Path, printed: Printer
) -> None:
    scan = write_series(tmp_path / "ct")
    given = ["--labels", str(maps_of_zeros[".gz"]), "--device", str(device.index)]

    assert main([command, str(scan), "-o", str(tmp_path / output), *given]) == RefusedInputError.exit_code

    messages = printed()
    assert messages.error_lines == 1
    messages.assert_error("times", 8)  # how many times as many voxels are unpacked
    assert [path.name for path in tmp_path.iterdir()] == ["ct"]


def write_map_of_16_slices(path: Path) -> Path:
    """Write a map of 8 x 8 x 16 voxels of a byte, some of them of label 1."""
    nibabel = pytest.importorskip("nibabel")
    labels_ijk = np.zeros((8, 8, 16), np.uint8)
    labels_ijk[2:4, 2:4, 2:4] = 1
    nibabel.save(nibabel.Nifti1Image(labels_ijk, np.eye(4)), path)
    return path


def test_small_map_is_not_large_by_default_but_where_100_bytes_are_many(tmp_path: Path) -> None:
    path = write_map_of_16_slices(tmp_path / "a.nii.gz")  # 1,024 bytes
    assert not is_large_map(path)
    assert is_large_map(path, most_bytes=100)


def test_map_that_is_missing_is_not_called_large(tmp_path: Path) -> None:
    assert not is_large_map(tmp_path / "missing", most_bytes=0)


def test_large_map_of_8_times_the_voxels_of_its_scan_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clrecon.labels.reader.LARGE_BYTES", 100)  # the map has 1,024 bytes
    path = write_map_of_16_slices(tmp_path / "a.nii.gz")
    scan_of_2_slices = Volume(np.zeros((2, 8, 8), np.int16), np.eye(4))
    assert clrecon.read_labels(path, volume=scan_of_2_slices).numbers == (1,)


def test_large_map_of_16_times_the_voxels_of_its_scan_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clrecon.labels.reader.LARGE_BYTES", 100)  # the map has 1,024 bytes
    path = write_map_of_16_slices(tmp_path / "a.nii.gz")
    scan_of_1_slice = Volume(np.zeros((1, 8, 8), np.int16), np.eye(4))
    with refused(RefusedInputError, 16, "times"):
        clrecon.read_labels(path, volume=scan_of_1_slice)
