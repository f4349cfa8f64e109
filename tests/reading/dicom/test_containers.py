"""Row 48 of the fault list: archives and other files in place of DICOM are named, never opened."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zipfile

import pytest
from dicom_series import Plan, write_series
from refusals import refused

from clrecon.errors import NoDicomError
from clrecon.mesh import Mesh
from clrecon.reading import read_volume
from clrecon.reading.dicom.series.scan import advise_on, describe_container


def make_zip(data):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("slice.dcm", data)
    return file.getvalue()


PACKED = {"gzip file": gzip.compress, "bzip2 file": bz2.compress, "xz file": lzma.compress}


@pytest.mark.fault_row(48)
@pytest.mark.parametrize("kind", PACKED)
def test_packed_series_is_refused_with_its_kind_and_the_advice_to_unpack(tmp_path, kind):
    plan = write_series(tmp_path / "ct", Plan(shape=(2, 5, 6)))
    (tmp_path / "packed").write_bytes(PACKED[kind]((tmp_path / "ct" / plan.name(0)).read_bytes()))
    with refused(NoDicomError, 1, kind.split()[0], "unpack"):
        read_volume(tmp_path / "packed")


@pytest.mark.fault_row(48)
def test_archive_beside_the_slices_is_counted_as_skipped(tmp_path):
    write_series(tmp_path, Plan(shape=(2, 5, 6)))
    (tmp_path / "backup").write_bytes(make_zip(b"x"))
    assert read_volume(tmp_path).report["files"]["skipped"] == {"zip archive": 1}


@pytest.mark.parametrize(
    ("start", "kind"),
    [
        (b"7z\xbc\xaf\x27\x1c", "7z archive"),
        (b"Rar!\x1a\x07\x01\0", "rar archive"),
        (b"\x89PNG\r\n\x1a\n", "PNG image"),
        (b"\xff\xd8\xff\xe0", "JPEG image"),
        (b"%PDF-1.7", "PDF document"),
        (b"\x5c\x01\0\0" + bytes(340) + b"n+1\0", "NIfTI volume"),
        (b"NRRD0004\n", "NRRD volume"),
        (b"\x7fELF", "program"),
        (b"plain text", ""),
        (b"", ""),
        (bytes(257), ""),
    ],
)
def test_kind_of_a_file_is_told_by_its_first_bytes(start, kind):
    assert describe_container(start) == kind


@pytest.mark.parametrize(("extension", "kind"), [(".3mf", "3MF"), (".glb", "GLB")])
def test_mesh_in_place_of_a_scan_is_refused_as_a_mesh(tmp_path, extension, kind):
    mesh = Mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    mesh.save(tmp_path / f"a{extension}")
    with refused(NoDicomError, kind, "mesh", 1):
        read_volume(tmp_path / f"a{extension}")


@pytest.mark.parametrize(
    ("kinds", "advice"),
    [
        pytest.param(["PNG image", "not DICOM"], "", id="nothing to unpack"),
        pytest.param(
            ["zip archive", "PNG image", "tar archive"],
            "unpack each tar archive and zip archive and name the folder",
            id="archives",
        ),
        pytest.param(
            ["NRRD volume", "MetaImage volume"],
            "a MetaImage volume or NRRD volume is read when the file itself is named",
            id="volumes",
        ),
    ],
)
def test_advice_on_skipped_files_is_to_unpack_archives_or_to_name_volumes(kinds, advice):
    assert advise_on(kinds) == advice


def test_advice_on_a_gzip_file_is_also_that_it_may_be_a_nifti():
    assert advise_on(["gzip file"]).endswith("; a NIfTI volume (.nii.gz) is read when the file itself is named")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"1 2 3\n4 5 6\n", (1, "DICOM", "NIfTI")),
        (b"\xef\xbb\xbf1;2;3\r\n", ("text",)),
        (b"\x93NUMPY\1\0v\0", (1, "NumPy")),
        (bytes(range(256)), (1, "DICOM", "NIfTI", "NRRD")),
    ],
)
def test_single_file_that_is_no_scan_is_refused_with_what_it_is(tmp_path, content, words):
    (tmp_path / "a.asc").write_bytes(content)
    with refused(NoDicomError, *words):
        read_volume(tmp_path / "a.asc")
