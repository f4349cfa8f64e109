"""A label map that takes long to unpack is held against its scan before it is."""

from __future__ import annotations

import zlib
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
from clrecon.labels.reader import LARGE_BYTES, is_large_map

MEMBER = 2**26


def pack(content: bytes) -> bytes:
    packer = zlib.compressobj(6, zlib.DEFLATED, 31)
    return packer.compress(content) + packer.flush()


@pytest.fixture(scope="module")
def zeros(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """34 GB of zeros in 33 MB, in both formats with gzip, which joins streams that follow each other."""
    nibabel = pytest.importorskip("nibabel")
    folder = tmp_path_factory.mktemp("zeros")
    header = nibabel.Nifti1Header()
    header.set_data_shape((2048, 2048, 1024))
    header.set_data_dtype(np.int64)
    header.set_sform(np.eye(4), 1)
    header["magic"], header["vox_offset"] = b"n+1", 352
    said = (
        b"NRRD0004\ntype: int64\ndimension: 3\nspace: left-posterior-superior\nsizes: 2048 2048 1024\n"
        b"space directions: (1,0,0) (0,1,0) (0,0,1)\nkinds: domain domain domain\nendian: little\nencoding: gzip\n"
        b"space origin: (0,0,0)\n\n"
    )
    many = pack(bytes(MEMBER)) * (2**35 // MEMBER)
    (folder / "zeros.nii.gz").write_bytes(pack(header.binaryblock + bytes(4)) + many)
    (folder / "zeros.nrrd").write_bytes(said + many)
    return {path.suffix: path for path in folder.iterdir()}


@pytest.mark.parametrize("kind", [".gz", ".nrrd"])
def test_zeros_are_not_unpacked(kind: str, zeros: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def unpack(*_: Any) -> None:
        raise AssertionError("unpacked")

    monkeypatch.setattr("clrecon.labels.label_grids.iterate_labels", unpack)
    assert is_large_map(zeros[kind]) and zeros[kind].stat().st_size < 40e6
    scan = Volume(np.zeros((17, 25, 31), np.int16), np.eye(4))
    with refused(RefusedInputError, 2048, 1024, 325994):
        clrecon.read_labels(zeros[kind], volume=scan)


@pytest.mark.parametrize("command", ["mesh", "render"])
def test_commands_hold_large_maps_against_the_scan(
    command: str, device: Any, zeros: dict[str, Path], tmp_path: Path, printed: Printer
) -> None:
    scan, out = write_series(tmp_path / "ct"), {"mesh": "a.stl", "render": "a.png"}[command]
    given = ["--labels", str(zeros[".gz"]), "--device", str(device.index)]
    assert main([command, str(scan), "-o", str(tmp_path / out), *given]) == 4
    told = printed()
    assert told.error_lines == 1
    told.assert_error("times", 8)
    assert [path.name for path in tmp_path.iterdir()] == ["ct"]


def test_maps_in_proportion_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nibabel = pytest.importorskip("nibabel")
    labels = np.zeros((8, 8, 16), np.uint8)
    labels[2:4, 2:4, 2:4] = 1
    nibabel.save(nibabel.Nifti1Image(labels, np.eye(4)), tmp_path / "a.nii.gz")
    assert not is_large_map(tmp_path / "a.nii.gz") and not is_large_map(tmp_path / "missing") and LARGE_BYTES > 512**3
    monkeypatch.setattr("clrecon.labels.reader.LARGE_BYTES", 100)
    assert is_large_map(tmp_path / "a.nii.gz", most_bytes=100)
    fits, small = (Volume(np.zeros((nk, 8, 8), np.int16), np.eye(4)) for nk in (2, 1))
    assert clrecon.read_labels(tmp_path / "a.nii.gz", volume=fits).numbers == (1,)
    with refused(RefusedInputError, 16, "times"):
        clrecon.read_labels(tmp_path / "a.nii.gz", volume=small)
