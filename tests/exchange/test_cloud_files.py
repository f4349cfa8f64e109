"""Every format of clouds is read back by other libraries and by our reader: the same points and what is known of
them.
"""

from __future__ import annotations

import io

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon.errors import NoSurfaceError, OutputError, RefusedInputError, UsageError
from clrecon.exchange.formats import CLOUD_FORMATS, describe_cloud_losses, write_cloud
from clrecon.points import PointCloud
from clrecon.points.cloud_reader import read_points

pytestmark = pytest.mark.unit

AFFINE = [[0.7, 0.1, 0.0, -169.4], [0.0, 0.5, -0.3, 165.0], [0.0, 0.2, 2.5, -846.25], [0.0, 0.0, 0.0, 1.0]]
SIGNS = {"lps": np.array([1, 1, 1], np.float32), "ras": np.array([-1, -1, 1], np.float32)}
EVERY = sorted(CLOUD_FORMATS)
KEEPS_ALL = [extension for extension in EVERY if extension != ".xyz"]
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
    return PointCloud(points, normals, hu, np.arange(n) % 70000 - 1, None, dict(REPORT))


def check_same(read: PointCloud, cloud: PointCloud, extension: str) -> None:
    if extension == ".las":
        assert np.abs(read.points - cloud.points.astype(np.float64)).max() <= tolerances.LAS_POINT_MM
    else:
        assert read.points.dtype == cloud.points.dtype
        np.testing.assert_array_equal(read.points, cloud.points)
    for name in ("hu",) if extension == ".xyz" else ("hu", "labels", "normals"):
        own, found = getattr(cloud, name), getattr(read, name)
        assert (own is None) == (found is None), name
        if own is not None:
            np.testing.assert_array_equal(found, own)


@pytest.mark.parametrize("space", ["lps", "ras"])
@pytest.mark.parametrize("extension", EVERY)
@pytest.mark.parametrize("bare", [False, True])
def test_cloud_is_read_back_unchanged_from_every_format(extension, space, bare, tmp_path):
    cloud = make_cloud(bare=bare)
    path = tmp_path / f"bone{extension}"
    assert cloud.save(path, space) == path.stat().st_size
    read = read_points(path)
    check_same(read, cloud, extension)
    assert read.report["file"]["space"] == space.upper() and read.report["file"]["space_from"] == "file"
    assert read.report["file"]["warnings"] == []
    if not bare:
        assert read.report["iso_value_hu"] == 226.5
        assert read.report["certificate_lines"] == ["tilt_deg 18.5", "warning one"]
        assert read.describe("lps").certificate == cloud.describe("lps").certificate
    if extension in (".npz", ".vtp") and not bare:
        assert read.report["affine_ijk_to_lps_mm"] == AFFINE


@pytest.mark.parametrize("extension", EVERY)
def test_clouds_far_from_the_origin_keep_their_digits(extension, tmp_path):
    cloud = make_cloud(far=True)
    assert cloud.points.dtype == np.float64
    cloud.save(tmp_path / f"far{extension}")
    read = read_points(tmp_path / f"far{extension}").points
    assert read.dtype == np.float64
    assert np.abs(read - cloud.points).max() <= (tolerances.LAS_POINT_MM if extension == ".las" else 1e-9)


def test_a_ply_has_vertices_alone(tmp_path):
    make_cloud(7).save(tmp_path / "bone.ply")
    content = (tmp_path / "bone.ply").read_bytes()
    lines = content.split(b"end_header\n")[0].decode("ascii").splitlines()
    assert lines[:5] == [
        "ply",
        "format binary_little_endian 1.0",
        "comment SPACE=LPS",
        "comment UNIT=mm",
        "comment ISO_VALUE_HU=226.5",
    ]
    assert [line for line in lines if line.startswith("element")] == ["element vertex 7"]
    assert lines[-2:] == ["property float scalar_HU", "property int label"] and "property list" not in "".join(lines)
    assert len(content) == CLOUD_FORMATS[".ply"].code.estimate(make_cloud(7).describe("lps"))


def test_an_xyz_names_its_columns(tmp_path):
    cloud = make_cloud(3)
    cloud.save(tmp_path / "bone.xyz", "ras")
    lines = (tmp_path / "bone.xyz").read_text("ascii").splitlines()
    assert lines[:2] == ["# SPACE=RAS", "# UNIT=mm"] and lines[-4] == "# x y z hu"
    x, y, z, hu = map(float, lines[-1].split())
    assert [np.float32(-x), np.float32(-y), np.float32(z), hu] == [*cloud.points[2], cloud.hu[2]]
    assert not any(" -0 " in f" {line} " for line in lines)
    assert describe_cloud_losses(cloud.describe("lps"), ".xyz") == [
        "XYZ has no place for normals and labels: PLY, VTP, NPZ and LAS have"
    ]
    assert [describe_cloud_losses(cloud.describe("lps"), extension) for extension in KEEPS_ALL] == [[]] * 4


def test_npz_is_read_without_pickle(tmp_path):
    cloud = make_cloud().changed(ijk=np.arange(3000).reshape(1000, 3))
    cloud.save(tmp_path / "bone.npz")
    with np.load(tmp_path / "bone.npz", allow_pickle=False) as found:
        for name, own in (("points", cloud.points), ("normals", cloud.normals), ("hu", cloud.hu), ("ijk", cloud.ijk)):
            assert found[name].dtype == own.dtype
            np.testing.assert_array_equal(found[name], own)
        np.testing.assert_array_equal(found["labels"], cloud.labels)
        assert found["affine"].tolist() == AFFINE and str(found["space"]) == "LPS" and str(found["unit"]) == "mm"
        assert found["iso_value_hu"] == 226.5 and found["certificate"].tolist() == ["tilt_deg 18.5", "warning one"]
    np.testing.assert_array_equal(read_points(tmp_path / "bone.npz").ijk, cloud.ijk)


@pytest.mark.parametrize("extension", [".ply", ".vtp"])
def test_pyvista_reads_the_same_cloud(extension, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    cloud = make_cloud()
    cloud.save(tmp_path / f"bone{extension}", "ras")
    read = pyvista.read(tmp_path / f"bone{extension}")
    np.testing.assert_array_equal(read.points, cloud.points * SIGNS["ras"])
    np.testing.assert_array_equal(read.point_data["Normals"], cloud.normals * SIGNS["ras"])
    if extension == ".vtp":
        assert read.n_verts == read.n_cells == len(cloud)
        np.testing.assert_array_equal(read.point_data["HU"], cloud.hu)
        np.testing.assert_array_equal(read.point_data["label"], cloud.labels)
        assert list(read.field_data["SPACE"]) == ["RAS"] and list(read.field_data["CERTIFICATE"])[0] == "tilt_deg 18.5"


def test_trimesh_reads_the_same_cloud(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    cloud = make_cloud()
    cloud.save(tmp_path / "bone.ply")
    np.testing.assert_array_equal(np.float32(trimesh.load(tmp_path / "bone.ply").vertices), cloud.points)
    fields = trimesh.load(tmp_path / "bone.ply").metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(fields["scalar_HU"].ravel(), cloud.hu)


def test_laspy_reads_the_same_cloud(tmp_path):
    laspy = pytest.importorskip("laspy")
    cloud = make_cloud()
    cloud.save(tmp_path / "bone.las")
    las = laspy.read(tmp_path / "bone.las")
    assert np.abs(np.stack([las.x, las.y, las.z], 1) - cloud.points).max() <= tolerances.LAS_POINT_MM
    middle = (cloud.points.min(axis=0).astype(np.float64) + cloud.points.max(axis=0)) / 2.0
    np.testing.assert_array_equal(las.header.offsets, np.rint(middle))
    np.testing.assert_array_equal(las["HU"], cloud.hu)
    np.testing.assert_array_equal(las["label"], cloud.labels)
    np.testing.assert_array_equal(las["nz"], cloud.normals[:, 2])
    assert las.header.creation_date is None
    assert [(record.user_id, record.record_id) for record in las.header.vlrs.get_by_id("clrecon")] == [("clrecon", 1)]


def test_a_las_file_without_its_last_byte_is_refused(tmp_path):
    pytest.importorskip("laspy")
    size = make_cloud().save(tmp_path / "bone.las")
    content = (tmp_path / "bone.las").read_bytes()
    (tmp_path / "bone.las").write_bytes(content[:-1])
    with refused(RefusedInputError, 1000, 50, size - 1):
        read_points(tmp_path / "bone.las")


def test_hashes_of_identifiers_stay_out_of_files(tmp_path):
    cloud = PointCloud(np.eye(3), report={"certificate": {"frame_of_reference_hash": "0123456789abcdef"}})
    for extension in (".ply", ".vtp", ".xyz"):
        write_cloud(cloud, tmp_path / f"a{extension}")
        write_cloud(cloud, tmp_path / f"b{extension}", keep_ids=True)
        found = [b"0123456789abcdef" in (tmp_path / f"{name}{extension}").read_bytes() for name in "ab"]
        assert found == [False, True]


@pytest.mark.release
def test_open3d_reads_the_same_cloud(tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    cloud = make_cloud()
    cloud.save(tmp_path / "bone.ply")
    cloud.changed(hu=None).save(tmp_path / "bone.xyz")
    legacy = open3d.io.read_point_cloud(str(tmp_path / "bone.ply"))
    np.testing.assert_array_equal(np.float32(legacy.points), cloud.points)
    np.testing.assert_array_equal(np.float32(legacy.normals), cloud.normals)
    tensor = open3d.t.io.read_point_cloud(str(tmp_path / "bone.ply")).point
    np.testing.assert_array_equal(tensor["scalar_HU"].numpy().ravel(), cloud.hu)
    np.testing.assert_array_equal(tensor["label"].numpy().ravel(), cloud.labels)
    table = open3d.io.read_point_cloud(str(tmp_path / "bone.xyz"))
    np.testing.assert_array_equal(np.float32(table.points), cloud.points)
    own = cloud.to_open3d()
    np.testing.assert_array_equal(own.point["positions"].numpy(), cloud.points)
    np.testing.assert_array_equal(own.point["hu"].numpy().ravel(), cloud.hu)
    np.testing.assert_array_equal(own.point["label"].numpy().ravel(), cloud.labels)
    np.testing.assert_array_equal(np.float32(own.to_legacy().normals), cloud.normals)


@pytest.mark.release
def test_open3d_writes_what_we_read(tmp_path):
    open3d = pytest.importorskip("open3d", exc_type=ImportError)
    cloud = make_cloud()
    for form, ascii_text in (("binary", False), ("text", True)):
        path = str(tmp_path / f"{form}.ply")
        open3d.io.write_point_cloud(path, cloud.to_open3d().to_legacy(), write_ascii=ascii_text)
        read = read_points(path)
        np.testing.assert_allclose(
            read.points, cloud.points, rtol=0, atol=tolerances.SIX_DIGITS_MM if ascii_text else 0
        )
        np.testing.assert_allclose(read.normals, cloud.normals, rtol=0, atol=tolerances.MESH_UNIT_NORMAL)
        assert read.report["file"]["space_from"] == "assumed"


def test_to_pyvista_shares_the_arrays():
    pytest.importorskip("pyvista")
    cloud = make_cloud()
    polydata = cloud.to_pyvista()
    assert np.shares_memory(polydata.points, cloud.points) and polydata.n_verts == len(cloud)
    assert polydata.active_scalars_name == "HU" and np.shares_memory(polydata.point_data["label"], cloud.labels)
    assert polydata.active_normals is not None and list(polydata.field_data["SPACE"]) == ["LPS"]


def test_without_open3d_the_message_says_so(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "open3d", None)
    with refused(UsageError, "open3d"):
        make_cloud(2).to_open3d()


def test_without_laspy_the_message_says_how_to_install_it(tmp_path, monkeypatch):
    make_cloud(2).save(tmp_path / "bone.las")
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with refused(UsageError, "laspy"):
        make_cloud(2).save(tmp_path / "new.las")
    with refused(UsageError, "laspy"):
        read_points(tmp_path / "bone.las")
    assert [entry.name for entry in tmp_path.iterdir()] == ["bone.las"]


@pytest.mark.parametrize("extension", EVERY)
def test_two_runs_give_the_same_bytes_and_nothing_else_of_the_report(extension, tmp_path, monkeypatch):
    cloud = make_cloud(50)
    cloud.save(tmp_path / f"one{extension}")
    monkeypatch.setattr("time.time", lambda: 2.0e9)
    cloud.save(tmp_path / f"two{extension.upper()}")
    content = (tmp_path / f"one{extension}").read_bytes()
    assert content == (tmp_path / f"two{extension.upper()}").read_bytes()
    assert b"DOE" not in content and str(tmp_path).encode() not in content


@pytest.mark.parametrize("extension", EVERY)
def test_empty_cloud_writes_nothing(extension, tmp_path):
    with refused(NoSurfaceError, "cloud", "empty"):
        PointCloud([]).save(tmp_path / f"bone{extension}")
    assert list(tmp_path.iterdir()) == []


def test_unknown_extension_and_space_write_nothing(tmp_path):
    for name in ("bone.stl", "bone"):
        with refused(UsageError, "cloud", "extension"):
            make_cloud(3).save(tmp_path / name)
    with refused(UsageError, "space", "scanner"):
        make_cloud(3).save(tmp_path / "bone.ply", "scanner")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_stays_when_asked(tmp_path):
    (tmp_path / "bone.ply").write_bytes(b"older")
    with pytest.raises(OutputError):
        make_cloud(3).save(tmp_path / "bone.ply", no_clobber=True)
    assert (tmp_path / "bone.ply").read_bytes() == b"older"


class FullDisk(io.RawIOBase):
    """Takes some bytes and then says what a full disk says."""

    def __init__(self, room: int):
        self.room = room

    def writable(self):
        return True

    def write(self, data):
        self.room -= memoryview(data).nbytes
        if self.room < 0:
            raise OSError(28, "No space left on device")
        return memoryview(data).nbytes


@pytest.mark.faults
@pytest.mark.parametrize("extension", EVERY)
def test_every_writer_notices_a_full_disk(extension):
    with refused(OSError, 28):
        CLOUD_FORMATS[extension].code.write(FullDisk(900), make_cloud().describe("lps"))


@pytest.mark.faults
@pytest.mark.parametrize("extension", EVERY)
def test_a_file_that_was_cut_or_belongs_to_another_cloud_is_found(extension, tmp_path):
    cloud = make_cloud()
    path = tmp_path / f"bone{extension}"
    cloud.save(path)
    content = cloud.describe("lps")
    CLOUD_FORMATS[extension].code.verify(path, content)
    whole = path.read_bytes()
    for length in (len(whole) - 2, len(whole) // 2, 90):
        path.write_bytes(whole[:length])
        with pytest.raises(OutputError, match="did not arrive on the disk"):
            CLOUD_FORMATS[extension].code.verify(path, content)
    path.write_bytes(whole)
    with pytest.raises(OutputError, match="did not arrive on the disk"):
        CLOUD_FORMATS[extension].code.verify(path, cloud.select(np.arange(1, 1000)).describe("lps"))


@pytest.mark.faults
@pytest.mark.parametrize("extension", EVERY)
def test_an_older_file_survives_a_failed_check(extension, tmp_path, monkeypatch):
    path = tmp_path / f"bone{extension}"
    path.write_bytes(b"older")
    monkeypatch.setattr(CLOUD_FORMATS[extension].code, "write", lambda stream, content: stream.write(b"x" * 200))
    with refused(OutputError, "arrive"):
        make_cloud().save(path)
    assert path.read_bytes() == b"older" and [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("extension", EVERY)
def test_estimated_size_of_a_cloud_file_is_near_the_true_one(extension, tmp_path):
    cloud = make_cloud(40000)  # more than two pieces
    size = cloud.save(tmp_path / f"bone{extension}")
    estimate = CLOUD_FORMATS[extension].code.estimate(cloud.describe("lps"))
    assert (0.15 if extension == ".xyz" else 0.9) * size <= estimate <= size
    check_same(read_points(tmp_path / f"bone{extension}"), cloud, extension)


def test_a_cloud_longer_than_las_can_count_is_refused(tmp_path):
    with refused(OutputError, "LAS", 0.0001, 429497):
        PointCloud([[0.0, 0, 0], [1e6, 0, 0]]).save(tmp_path / "long.las")
    assert list(tmp_path.iterdir()) == []
