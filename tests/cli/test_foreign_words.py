"""Words of libraries stay off the result and out of the messages of a command."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from volume_files import make_ct, write_metaimage

from clrecon.system.foreign_words import hush, own_streams

CLRECON = [sys.executable, "-m", "clrecon"]


@pytest.mark.parametrize(
    ("options", "errors"), [([], "foreign "), (["show"], "foreign hushed hushed ")], ids=["hidden", "shown"]
)
def test_words_of_a_library_go_to_standard_error_or_are_hidden_and_own_ones_to_standard_output(
    options: list[str], errors: str
) -> None:
    code = (
        "import os, sys; from clrecon.system.foreign_words import hush, own_streams\n"
        "with own_streams(show='show' in sys.argv):\n"
        "    os.write(1, b'foreign '); print('own')\n"
        "    with hush(): os.write(1, b'hushed '); os.write(2, b'hushed ')\n"
        "os.write(1, b'after ')"
    )

    done = subprocess.run([sys.executable, "-c", code, *options], capture_output=True, text=True)

    assert (done.stdout, done.stderr) == ("own\nafter ", errors)


def test_words_of_a_library_are_not_hidden_from_a_caller_in_python(capfd: pytest.CaptureFixture[str]) -> None:
    with hush():
        os.write(1, b"mine")
    assert capfd.readouterr().out == "mine"


def test_warning_of_a_library_is_logged_by_its_kind_and_not_printed(
    capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO", "clrecon"), own_streams():
        warnings.warn("a UID of 1.2.3", RuntimeWarning, stacklevel=1)
    assert capfd.readouterr().err == ""
    (line,) = caplog.messages
    assert line.startswith("RuntimeWarning of a library in test_foreign_words.py, line ") and "1.2.3" not in line


@pytest.mark.parametrize(
    "fields",
    [
        {"ElementSize": "1 1"},
        {"Color": "1 2"},
        {"TransformMatrix": "1e300 0 0 0 1 0 0 0 1"},
        {"CompressedDataSize": "z"},
    ],
    ids=lambda fields: next(iter(fields)),
)
def test_bad_metaimage_is_refused_in_one_line(fields: dict[str, str], tmp_path: Path) -> None:
    write_metaimage(tmp_path / "a.mha", make_ct(), **fields)
    done = subprocess.run([*CLRECON, "info", "a.mha"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (4, "")
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("clrecon: error: a.mha ")


def test_nifti_with_an_infinite_sform_is_refused_in_one_line(tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    import numpy as np

    header = nibabel.Nifti1Image(np.zeros((3, 4, 5), np.int16), np.eye(4)).header
    header["sform_code"], header["srow_x"] = 1, [np.inf, np.inf, -np.inf, np.inf]
    (tmp_path / "a.nii").write_bytes(header.binaryblock + bytes(4 + 60 * 2))  # no extension, and 60 voxels of int16
    done = subprocess.run([*CLRECON, "info", "a.nii"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (4, "")
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("clrecon: error: a.nii ")
