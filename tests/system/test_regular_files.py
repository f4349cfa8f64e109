"""Only regular files are read, and no more of them than makes sense: a FIFO waits for ever, /dev/zero has no end."""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from house import ROOT
from refusals import assert_one_line, refused

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.jobs.batch.plan import Plan, read_cases
from clrecon.labels import read_labels
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.reading import list_series, read_volume
from clrecon.rendering import load_transfer_function
from clrecon.rendering.views.centre_line import LARGEST_BYTES, read_curve_points
from clrecon.system.paths import open_regular, read_regular

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="FIFOs and devices of POSIX")

READERS: dict[str, Callable[..., object]] = {
    "volume": read_volume,
    "listing": list_series,
    "labels": read_labels,
    "curve": read_curve_points,
    "transfer function": load_transfer_function,
    "manifest": lambda path: read_cases(path, Plan(output="out")),
}


@pytest.fixture(params=["fifo", "link to a fifo", "zero", "random", "folder"])
def irregular_file(request, tmp_path):
    """What has a name and is no regular file."""
    path = tmp_path / "odd"
    if request.param == "fifo":
        os.mkfifo(path)
    elif request.param == "link to a fifo":
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to("pipe")
    elif request.param == "folder":
        path.mkdir()
    else:
        path.symlink_to(f"/dev/{request.param}")
    return path


@pytest.mark.parametrize("reader", READERS)
def test_reader_refuses_an_irregular_file_in_one_line_without_waiting(irregular_file, reader):
    with pytest.raises(ClreconError) as caught:
        READERS[reader](irregular_file)
    assert_one_line(caught.value)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are counted in /proc")
def test_irregular_file_that_was_refused_is_not_left_open(irregular_file):
    open_before = len(os.listdir("/proc/self/fd"))
    with refused(OSError, "regular", "file"):
        open_regular(irregular_file)
    assert len(os.listdir("/proc/self/fd")) == open_before


def test_regular_file_is_read_up_to_the_largest_size_and_refused_above(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_regular(tmp_path / "a", limit=5) == b"12345"
    with refused(OSError, "bytes", 4):
        read_regular(tmp_path / "a", limit=4)


def test_regular_file_is_opened_as_a_stream(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    with open_regular(tmp_path / "a", buffering=0) as stream:
        assert stream.read(2) == b"12"


def test_file_of_curve_points_larger_than_16_mib_is_refused(tmp_path):
    assert LARGEST_BYTES == 16 << 20
    with open(tmp_path / "large", "wb") as stream:
        stream.truncate(LARGEST_BYTES + 1)
    with refused(RefusedInputError, LARGEST_BYTES):
        read_curve_points(tmp_path / "large")


def test_phantom_is_refused_without_waiting_where_a_fifo_has_the_name_of_its_truth(tmp_path):
    folder = tmp_path / "phantom"
    folder.mkdir()
    os.mkfifo(folder / "truth.json")
    with refused(UsageError, "truth.json"):
        write_phantom(folder, PhantomSettings(kind="sphere"))


OPENING_MODULES = {
    "system/files.py": "locks of folders",
    "system/foreign_words.py": "streams of a command",
    "system/paths.py": "a name that is taken; the helper itself",
    "system/memory.py": "maps a file that it has looked at; the system",
    "cli/console.py": "the null device; what the command has just written",
    "exchange/las.py": "looks again at what it has written, and reads a file that was looked at",
    "exchange/npz.py": "members of an archive",
    "exchange/xyz.py": "looks again at what it has written",
    "reading/dicom/pixels/decoder_pool.py": "pipes to its own processes",
    "reading/dicom/pixels/decoder_process.py": "its own pipes and memory",
    "reading/dicom/parse/elements.py": "looks at kind and size with one call, for speed",
    "opencl/cache.py": "its own cache",
    "opencl/pocl.py": "its own cache; the system",
    "opencl/sources.py": "its own sources",
    "exchange/glb.py": "what it has just written",
    "exchange/obj.py": "what it has just written",
    "exchange/page.py": "what it has just written",
    "viewer/web/start_page.py": "new files in its own folder",
    "viewer/web/server.py": "files of the package, and what a session has just written",
    "exchange/ply.py": "what it has just written",
    "exchange/stl.py": "what it has just written",
    "exchange/threemf.py": "what it has just written",
    "exchange/vtp.py": "what it has just written",
    "__init__.py": "its own list of names",
    "reading/archives.py": "members of an archive, and its own files of them",
    "reading/buckets.py": "objects of a bucket, and its own files of them",
    "reading/dicomweb.py": "its own files of instances",
    "reading/web.py": "a URL, and its own file of it",
    "reading/grids/metaimage.py": "what it has just written",
    "reading/grids/grid_file.py": "a stream that it is given",
    "proof/timing.py": "the system",
    "proof/compare/job.py": "what it has just written",
    "proof/compare/page.py": "its own style",
    "jobs/run.py": "the system",
    "jobs/batch/case.py": "reports of its own cases",
    "jobs/batch/cohort.py": "tables and pages of its own cases",
    "rendering/movies.py": "new frames, its own temporary files",
}
"""Modules that open files by themselves, and what they are."""


def count_openings(text: str) -> int:
    """Calls of open, of methods of that name with a mode, and of those of paths that read."""
    count = 0
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call):
            continue
        name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        method = isinstance(node.func, ast.Attribute)
        owner = getattr(getattr(node.func, "value", None), "id", "")
        mode = any(isinstance(arg, ast.Constant) and arg.value in ("r", "rb", "w", "wb", "xb") for arg in node.args)
        count += name == "open" and (not method or owner == "os" or mode)
        count += method and name in ("read_text", "read_bytes", "fromfile", "memmap", "dcmread")
    return count


@pytest.mark.seconds
def test_only_listed_modules_open_files_without_the_helper_for_regular_files():
    folder = ROOT / "clrecon"
    opening = {str(path.relative_to(folder)) for path in folder.rglob("*.py") if count_openings(path.read_text())}
    assert opening == set(OPENING_MODULES)


@pytest.mark.parametrize("code", ["open(path)", "path.open('rb')", "os.open(p, 0)", "path.read_text()"])
def test_each_way_to_open_a_file_is_counted(code):
    assert count_openings(code) == 1


@pytest.mark.parametrize("code", ["open_regular(p)", "source.open(name)"])
def test_helper_and_methods_without_a_mode_are_not_counted(code):
    assert count_openings(code) == 0
