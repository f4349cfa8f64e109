"""Every format of clouds is read back by other libraries and by our reader: the same points and what is known of
them.
"""

from __future__ import annotations

import errno
import sys

import numpy as np
import pytest
import tolerances
from full_disk import FullDisk
from refusals import refused

from clrecon.errors import NoSurfaceError, OutputError, RefusedInputError, UsageError
from clrecon.exchange.formats import CLOUD_FORMATS, describe_cloud_losses, write_cloud
from clrecon.points.cloud import PointCloud
from clrecon.points.cloud_reader import read_points

pytestmark = pytest.mark.unit

AFFINE = [[0.7, 0.1, 0.0, -169.4], [0.0, 0.5, -0.3, 165.0], [0.0, 0.2, 2.5, -846.25], [0.0, 0.0, 0.0, 1.0]]
SIGNS = {"lps": np.array([1, 1, 1], np.float32), "ras": np.array([-1, -1, 1], np.float32)}
EXTENSIONS = sorted(CLOUD_FORMATS)
REPORT = {
    "iso_value_hu": 226.5,
    "affine_ijk_to_lps_mm": AFFINE,
    "certificate": {"tilt_deg": 18.5, "warnings": ["one"]},
    "patient": "DOE^JANE",
}


def make_cloud(n: int = 1000, *, bare: bool = False, far: bool = False) -> PointCloud:
    """Points of a box in the patient, with normals, HU and labels that differ from point to point."""
    chance = np.random.default_rng(5)
    points = chance.uniform(-200, 200, (n, 3)) + (0, 0, 20000.0 if far else -900.0)
    if not far:
        points = points.astype(np.float32)
    points[0, 1] = 0.0
    if bare:
        return PointCloud(points)
    normals = chance.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    hu = chance.integers(-1024, 3071, n) + 0.5
    return PointCloud(points, normals, hu, labels=np.arange(n) % 70000 - 1, report=dict(REPORT))


def assert_same_cloud(read: PointCloud, cloud: PointCloud, extension: str) -> None:
    """Same points, HU, labels and normals; XYZ has HU alone, and LAS rounds points."""
    if extension == ".las":
        assert np.abs(read.points - cloud.points.astype(np.float64)).max() <= tolerances.LAS_POINT_MM
    else:
        assert read.points.dtype == cloud.points.dtype
        np.testing.assert_array_equal(read.points, cloud.points)
    for name in ("hu",) if extension == ".xyz" else ("hu", "labels", "normals"):
        expected, values = getattr(cloud, name), getattr(read, name)
        assert (expected is None) == (values is None), name
        if expected is not None:
            np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("bare", [False, True], ids=["all fields", "points alone"])
def test_cloud_is_read_back_from_every_format_with_what_it_holds(extension, space, bare, tmp_path):
    cloud = make_cloud(bare=bare)
    cloud.save(tmp_path / f"bone{extension}", space)
    assert_same_cloud(read_points(tmp_path / f"bone{extension}"), cloud, extension)


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_saving_a_cloud_returns_the_bytes_of_its_file(extension, tmp_path):
    path = tmp_path / f"bone{extension}"
    assert make_cloud().save(path) == path.stat().st_size


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_frame_of_a_cloud_is_read_from_its_file(extension, space, tmp_path):
    make_cloud().save(tmp_path / f"bone{extension}", space)
    facts = read_points(tmp_path / f"bone{extension}").report["file"]
    assert (facts["space"], facts["space_from"]) == (space.upper(), "file")
    assert facts["warnings"] == []


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_iso_value_and_certificate_of_a_cloud_are_read_from_its_file(extension, tmp_path):
    cloud = make_cloud()
    cloud.save(tmp_path / f"bone{extension}")
    read = read_points(tmp_path / f"bone{extension}")
    assert read.report["iso_value_hu"] == 226.5
    assert read.report["certificate_lines"] == ["tilt_deg 18.5", "warning one"]
    assert read.describe("lps").certificate == cloud.describe("lps").certificate


@pytest.mark.parametrize("extension", [".npz", ".vtp"])
def test_affine_of_a_cloud_is_read_from_npz_and_vtp(extension, tmp_path):
    make_cloud().save(tmp_path / f"bone{extension}")
    assert read_points(tmp_path / f"bone{extension}").report["affine_ijk_to_lps_mm"] == AFFINE


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_cloud_20_m_from_the_origin_keeps_the_digits_of_float64(extension, tmp_path):
    cloud = make_cloud(far=True)
    assert cloud.points.dtype == np.float64
    cloud.save(tmp_path / f"far{extension}")
    read = read_points(tmp_path / f"far{extension}").points
    assert read.dtype == np.float64
    rounding = tolerances.LAS_POINT_MM if extension == ".las" else tolerances.FAR_CLOUD_MM
    assert np.abs(read - cloud.points).max() <= rounding


def test_header_of_a_cloud_as_ply_has_remarks_and_vertices_alone(tmp_path):
    make_cloud(7).save(tmp_path / "bone.ply")
    lines = (tmp_path / "bone.ply").read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()
    assert lines[:5] == [
        "ply",
        "format binary_little_endian 1.0",
        "comment SPACE=LPS",
        "comment UNIT=mm",
        "comment ISO_VALUE_HU=226.5",
    ]
    assert [line for line in lines if line.startswith("element")] == ["element vertex 7"]
    assert lines[-2:] == ["property float scalar_HU", "property int label"]
    assert "property list" not in "".join(lines)


def test_estimated_size_of_a_cloud_as_ply_is_the_true_one(tmp_path):
    cloud = make_cloud(7)
    size = cloud.save(tmp_path / "bone.ply")
    assert CLOUD_FORMATS[".ply"].code.estimate(cloud.describe("lps")) == size


def test_xyz_has_frame_unit_and_the_names_of_its_columns_before_the_points(tmp_path):
    make_cloud(3).save(tmp_path / "bone.xyz", "ras")
    lines = (tmp_path / "bone.xyz").read_text("ascii").splitlines()
    *header, _, _, _ = lines  # and three points
    assert header[:2] == ["# SPACE=RAS", "# UNIT=mm"]
    assert header[-1] == "# x y z hu"


def test_xyz_in_ras_has_points_with_every_digit_of_float32_and_no_negative_zero(tmp_path):
    cloud = make_cloud(3)
    cloud.save(tmp_path / "bone.xyz", "ras")
    lines = (tmp_path / "bone.xyz").read_text("ascii").splitlines()
    x, y, z, hu = map(float, lines[-1].split())
    assert [np.float32(-x), np.float32(-y), np.float32(z), hu] == [*cloud.points[2], cloud.hu[2]]
    assert not any("-0" in line.split() for line in lines)  # y of the first point is 0


def test_fields_that_xyz_has_no_place_for_are_named_with_the_formats_that_have():
    assert describe_cloud_losses(make_cloud(3).describe("lps"), ".xyz") == [
        "XYZ has no place for normals and labels: PLY, VTP, NPZ and LAS have"
    ]


@pytest.mark.parametrize("extension", [".las", ".npz", ".ply", ".vtp"])
def test_formats_other_than_xyz_lose_no_field_of_a_cloud(extension):
    assert describe_cloud_losses(make_cloud(3).describe("lps"), extension) == []


def cloud_with_walls() -> PointCloud:
    cloud = make_cloud(4)
    cloud.values = {"thickness_mm": np.array([0.5, np.nan, 2.0, 3.5], np.float32)}
    return cloud


@pytest.mark.parametrize("extension", [".npz", ".ply", ".vtp"])
def test_numbers_in_mm_of_a_cloud_are_read_back_with_their_gaps(extension, tmp_path):
    cloud_with_walls().save(tmp_path / f"walls{extension}")
    read = read_points(tmp_path / f"walls{extension}")
    np.testing.assert_array_equal(read.values["thickness_mm"], [0.5, np.nan, 2.0, 3.5])
    assert read.report["file"]["warnings"] == []


@pytest.mark.parametrize("extension", [".las", ".xyz"])
def test_numbers_in_mm_that_a_format_loses_are_named(extension):
    (line,) = describe_cloud_losses(cloud_with_walls().describe("lps"), extension)
    assert "thickness_mm" in line and "NPZ" in line and "LAS have" not in line


def test_numbers_in_mm_follow_the_points_that_are_selected():
    chosen = cloud_with_walls()[[3, 0]].changed(labels=[1, 2])
    assert chosen.values["thickness_mm"].tolist() == [3.5, 0.5]


def test_points_that_are_moved_lose_their_numbers_in_mm():
    cloud = cloud_with_walls()
    assert cloud.changed(points=cloud.points + 1.0).values == {}


def test_numbers_of_a_cloud_without_a_name_in_mm_are_refused(tmp_path):
    cloud = make_cloud(2)
    cloud.values = {"points": np.zeros(2)}
    with refused(UsageError, "_mm", "points"):
        cloud.save(tmp_path / "walls.npz")


@pytest.fixture
def cloud_and_npz(tmp_path):
    """A cloud with indices of voxels, and its NPZ file."""
    cloud = make_cloud(1000).changed(ijk=np.arange(3000).reshape(1000, 3))
    cloud.save(tmp_path / "bone.npz")
    return cloud, tmp_path / "bone.npz"


def test_numpy_reads_the_fields_of_an_npz_cloud_without_pickle(cloud_and_npz):
    cloud, path = cloud_and_npz
    with np.load(path, allow_pickle=False) as arrays:
        for name in ("points", "normals", "hu", "ijk"):
            assert arrays[name].dtype == getattr(cloud, name).dtype
            np.testing.assert_array_equal(arrays[name], getattr(cloud, name))
        np.testing.assert_array_equal(arrays["labels"], cloud.labels)


def test_numpy_reads_frame_unit_affine_iso_value_and_certificate_of_an_npz_cloud(cloud_and_npz):
    _, path = cloud_and_npz
    with np.load(path, allow_pickle=False) as arrays:
        assert (str(arrays["space"]), str(arrays["unit"])) == ("LPS", "mm")
        assert arrays["affine"].tolist() == AFFINE
        assert arrays["iso_value_hu"] == 226.5
        assert arrays["certificate"].tolist() == ["tilt_deg 18.5", "warning one"]


def test_indices_of_voxels_are_read_back_from_an_npz_cloud(cloud_and_npz):
    cloud, path = cloud_and_npz
    np.testing.assert_array_equal(read_points(path).ijk, cloud.ijk)


@pytest.mark.parametrize("extension", [".ply", ".vtp"])
def test_pyvista_reads_points_and_normals_of_a_saved_cloud(extension, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    cloud = make_cloud()
    cloud.save(tmp_path / f"bone{extension}", "ras")
    read = pyvista.read(tmp_path / f"bone{extension}")
    np.testing.assert_array_equal(read.points, cloud.points * SIGNS["ras"])
    np.testing.assert_array_equal(read.point_data["Normals"], cloud.normals * SIGNS["ras"])


def test_pyvista_reads_hu_labels_frame_and_certificate_of_a_vtp_cloud(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    cloud = make_cloud()
    cloud.save(tmp_path / "bone.vtp", "ras")
    read = pyvista.read(tmp_path / "bone.vtp")
    np.testing.assert_array_equal(read.point_data["HU"], cloud.hu)
    np.testing.assert_array_equal(read.point_data["label"], cloud.labels)
    assert list(read.field_data["SPACE"]) == ["RAS"]
    assert list(read.field_data["CERTIFICATE"]) == ["tilt_deg 18.5", "warning one"]


def test_each_point_of_a_vtp_cloud_is_a_vertex_cell(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    make_cloud(1000).save(tmp_path / "bone.vtp")
    read = pyvista.read(tmp_path / "bone.vtp")
    assert read.n_verts == read.n_cells == 1000


def test_trimesh_reads_points_and_hu_of_a_ply_cloud(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    cloud = make_cloud()
    cloud.save(tmp_path / "bone.ply")
    read = trimesh.load(tmp_path / "bone.ply")
    np.testing.assert_array_equal(np.float32(read.vertices), cloud.points)
    fields = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(fields["scalar_HU"].ravel(), cloud.hu)


@pytest.fixture
def cloud_and_las(tmp_path):
    """A cloud, and its LAS file read by laspy."""
    laspy = pytest.importorskip("laspy")
    cloud = make_cloud()
    cloud.save(tmp_path / "bone.las")
    return cloud, laspy.read(tmp_path / "bone.las")


def test_laspy_reads_points_and_fields_of_a_las_cloud(cloud_and_las):
    cloud, las = cloud_and_las
    assert np.abs(np.stack([las.x, las.y, las.z], 1) - cloud.points).max() <= tolerances.LAS_POINT_MM
    np.testing.assert_array_equal(las["HU"], cloud.hu)
    np.testing.assert_array_equal(las["label"], cloud.labels)
    np.testing.assert_array_equal(las["nz"], cloud.normals[:, 2])


def test_offsets_of_a_las_cloud_are_its_middle_in_whole_mm(cloud_and_las):
    cloud, las = cloud_and_las
    middle = (cloud.points.min(axis=0).astype(np.float64) + cloud.points.max(axis=0)) / 2.0
    np.testing.assert_array_equal(las.header.offsets, np.rint(middle))


def test_las_cloud_has_no_date_and_one_record_of_clrecon(cloud_and_las):
    _, las = cloud_and_las
    assert las.header.creation_date is None
    assert [record.record_id for record in las.header.vlrs.get_by_id("clrecon")] == [1]


def test_las_file_without_its_last_byte_is_refused(tmp_path):
    pytest.importorskip("laspy")
    size = make_cloud(1000).save(tmp_path / "bone.las")
    content = (tmp_path / "bone.las").read_bytes()
    (tmp_path / "bone.las").write_bytes(content[:-1])
    bytes_a_point = 50
    with refused(RefusedInputError, 1000, bytes_a_point, size - 1):
        read_points(tmp_path / "bone.las")


@pytest.mark.parametrize("keep_ids", [False, True])
@pytest.mark.parametrize("extension", [".ply", ".vtp", ".xyz"])
def test_hash_of_an_identifier_is_in_a_cloud_file_on_request_alone(extension, keep_ids, tmp_path):
    identifier_hash = "0123456789abcdef"
    cloud = PointCloud(np.eye(3), report={"certificate": {"frame_of_reference_hash": identifier_hash}})
    write_cloud(cloud, tmp_path / f"a{extension}", keep_ids=keep_ids)
    content = (tmp_path / f"a{extension}").read_bytes()
    assert (identifier_hash.encode() in content) == keep_ids


@pytest.mark.release
def test_open3d_reads_points_and_normals_of_a_ply_cloud(tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    cloud = make_cloud()
    cloud.save(tmp_path / "bone.ply")
    read = open3d.io.read_point_cloud(str(tmp_path / "bone.ply"))
    np.testing.assert_array_equal(np.float32(read.points), cloud.points)
    np.testing.assert_array_equal(np.float32(read.normals), cloud.normals)


@pytest.mark.release
def test_open3d_reads_hu_and_labels_of_a_ply_cloud_as_tensors(tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    cloud = make_cloud()
    cloud.save(tmp_path / "bone.ply")
    tensor = open3d.t.io.read_point_cloud(str(tmp_path / "bone.ply")).point
    np.testing.assert_array_equal(tensor["scalar_HU"].numpy().ravel(), cloud.hu)
    np.testing.assert_array_equal(tensor["label"].numpy().ravel(), cloud.labels)


@pytest.mark.release
def test_open3d_reads_points_of_an_xyz_cloud(tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    cloud = make_cloud()
    cloud.changed(hu=None).save(tmp_path / "bone.xyz")
    read = open3d.io.read_point_cloud(str(tmp_path / "bone.xyz"))
    np.testing.assert_array_equal(np.float32(read.points), cloud.points)


@pytest.mark.release
def test_cloud_handed_to_open3d_has_its_points_and_fields():
    pytest.importorskip("open3d", exc_type=ImportError)
    cloud = make_cloud()
    handed = cloud.to_open3d()
    np.testing.assert_array_equal(handed.point["positions"].numpy(), cloud.points)
    np.testing.assert_array_equal(handed.point["hu"].numpy().ravel(), cloud.hu)
    np.testing.assert_array_equal(handed.point["label"].numpy().ravel(), cloud.labels)
    np.testing.assert_array_equal(np.float32(handed.to_legacy().normals), cloud.normals)


@pytest.mark.release
@pytest.mark.parametrize("as_text", [False, True], ids=["binary", "text"])
def test_cloud_that_open3d_writes_is_read_with_an_assumed_frame(as_text, tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    cloud, path = make_cloud(), tmp_path / "a.ply"
    open3d.io.write_point_cloud(str(path), cloud.to_open3d().to_legacy(), write_ascii=as_text)
    read = read_points(path)
    rounding = tolerances.SIX_DIGITS_MM if as_text else 0
    np.testing.assert_allclose(read.points, cloud.points, rtol=0, atol=rounding)
    np.testing.assert_allclose(read.normals, cloud.normals, rtol=0, atol=tolerances.MESH_UNIT_NORMAL)
    assert read.report["file"]["space_from"] == "assumed"


def test_cloud_handed_to_pyvista_shares_its_points_and_labels():
    pytest.importorskip("pyvista")
    cloud = make_cloud()
    polydata = cloud.to_pyvista()
    assert np.shares_memory(polydata.points, cloud.points)
    assert np.shares_memory(polydata.point_data["label"], cloud.labels)


def test_cloud_handed_to_pyvista_has_vertices_normals_frame_and_hu_as_its_scalars():
    pytest.importorskip("pyvista")
    cloud = make_cloud(1000)
    polydata = cloud.to_pyvista()
    assert polydata.n_verts == 1000
    assert polydata.active_scalars_name == "HU"
    assert polydata.active_normals is not None
    assert list(polydata.field_data["SPACE"]) == ["LPS"]


def test_cloud_is_not_handed_to_open3d_where_that_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with refused(UsageError, "open3d"):
        make_cloud(2).to_open3d()


def test_las_is_neither_written_nor_read_where_laspy_is_missing(tmp_path, monkeypatch):
    make_cloud(2).save(tmp_path / "bone.las")
    monkeypatch.setitem(sys.modules, "laspy", None)
    with refused(UsageError, "laspy"):
        make_cloud(2).save(tmp_path / "new.las")
    with refused(UsageError, "laspy"):
        read_points(tmp_path / "bone.las")
    assert list(tmp_path.iterdir()) == [tmp_path / "bone.las"]


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_cloud_saved_at_another_time_has_the_same_bytes(extension, tmp_path, monkeypatch):
    cloud = make_cloud(50)
    cloud.save(tmp_path / f"one{extension}")
    monkeypatch.setattr("time.time", lambda: 2.0e9)
    cloud.save(tmp_path / f"two{extension.upper()}")
    assert (tmp_path / f"one{extension}").read_bytes() == (tmp_path / f"two{extension.upper()}").read_bytes()


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_cloud_file_holds_no_patient_and_no_path(extension, tmp_path):
    """The report of the cloud has DOE^JANE."""
    make_cloud(50).save(tmp_path / f"one{extension}")
    content = (tmp_path / f"one{extension}").read_bytes()
    assert b"DOE" not in content
    assert str(tmp_path).encode() not in content


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_cloud_without_points_is_refused_and_nothing_is_written(extension, tmp_path):
    with refused(NoSurfaceError, "cloud", "empty"):
        PointCloud([]).save(tmp_path / f"bone{extension}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["bone.stl", "bone"])
def test_cloud_with_an_unknown_extension_is_refused_and_nothing_is_written(name, tmp_path):
    with refused(UsageError, "cloud", "extension"):
        make_cloud(3).save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_cloud_in_an_unknown_frame_is_refused_and_nothing_is_written(tmp_path):
    with refused(UsageError, "space", "scanner"):
        make_cloud(3).save(tmp_path / "bone.ply", "scanner")
    assert list(tmp_path.iterdir()) == []


def test_cloud_is_not_saved_over_a_file_with_no_clobber(tmp_path):
    (tmp_path / "bone.ply").write_bytes(b"older")
    with pytest.raises(OutputError):
        make_cloud(3).save(tmp_path / "bone.ply", no_clobber=True)
    assert (tmp_path / "bone.ply").read_bytes() == b"older"


@pytest.mark.faults
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_writer_of_every_cloud_format_notices_a_full_disk(extension):
    with refused(OSError, errno.ENOSPC):
        CLOUD_FORMATS[extension].code.write(FullDisk(room=900), make_cloud().describe("lps"))


@pytest.mark.faults
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_check_of_a_cloud_file_accepts_it_whole_and_refuses_it_cut(extension, tmp_path):
    path = tmp_path / f"bone{extension}"
    cloud = make_cloud()
    cloud.save(path)
    content, whole = cloud.describe("lps"), path.read_bytes()
    CLOUD_FORMATS[extension].code.verify(path, content)
    for length in (len(whole) - 2, len(whole) // 2, 90):  # in its end, its data and its header
        path.write_bytes(whole[:length])
        with refused(OutputError, "arrive", "disk"):
            CLOUD_FORMATS[extension].code.verify(path, content)


@pytest.mark.faults
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_check_of_a_cloud_file_refuses_that_of_a_cloud_with_a_point_less(extension, tmp_path):
    path = tmp_path / f"bone{extension}"
    cloud = make_cloud(1000)
    cloud.save(path)
    fewer = cloud.select(np.arange(1, 1000))
    with refused(OutputError, "arrive", "disk"):
        CLOUD_FORMATS[extension].code.verify(path, fewer.describe("lps"))


@pytest.mark.faults
@pytest.mark.parametrize("extension", EXTENSIONS)
def test_cloud_file_that_fails_its_check_leaves_the_older_one(extension, tmp_path, monkeypatch):
    path = tmp_path / f"bone{extension}"
    path.write_bytes(b"older")
    monkeypatch.setattr(CLOUD_FORMATS[extension].code, "write", lambda stream, content: stream.write(b"x" * 200))
    with refused(OutputError, "arrive"):
        make_cloud().save(path)
    assert path.read_bytes() == b"older"
    assert list(tmp_path.iterdir()) == [path]


@pytest.fixture(scope="module", params=EXTENSIONS)
def large_cloud_file(request, tmp_path_factory):
    """A cloud of more points than two of the pieces that writers work in, of 16,384 rows, and its file."""
    cloud = make_cloud(40_000)
    path = tmp_path_factory.mktemp("large") / f"bone{request.param}"
    cloud.save(path)
    return cloud, path


def test_estimated_size_of_a_cloud_file_is_near_the_true_one(large_cloud_file):
    cloud, path = large_cloud_file
    estimate, size = CLOUD_FORMATS[path.suffix].code.estimate(cloud.describe("lps")), path.stat().st_size
    lowest = tolerances.XYZ_ESTIMATE_LOW if path.suffix == ".xyz" else tolerances.CLOUD_ESTIMATE_LOW
    assert lowest * size <= estimate <= size


def test_cloud_larger_than_the_pieces_that_writers_work_in_is_written_whole(large_cloud_file):
    cloud, path = large_cloud_file
    assert_same_cloud(read_points(path), cloud, path.suffix)


def test_cloud_longer_than_las_can_count_is_refused_and_nothing_is_written(tmp_path):
    step_mm = 0.0001
    longest_mm = round(2**32 * step_mm)
    with refused(OutputError, "LAS", step_mm, longest_mm):
        PointCloud([[0.0, 0, 0], [1e6, 0, 0]]).save(tmp_path / "long.las")
    assert list(tmp_path.iterdir()) == []
