"""The written DICOM series against its truth, re-derived from the files alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pydicom
import pytest
import tolerances
from refusals import refused
from variants import daily

from clrecon.errors import OutputError, UsageError
from clrecon.proof.phantom import PhantomSettings, build, make_phantom, write_phantom

FLOAT64 = 1e-9
AWKWARD = {"size": (38, 30), "slices": 14, "spacing": (0.7, 0.5, 2.5)}


def read_back(folder: Path) -> tuple[np.ndarray, np.ndarray, list[pydicom.Dataset]]:
    """HU, affine and headers of the files, by the DICOM formulas alone."""
    headers = [pydicom.dcmread(path) for path in sorted(folder.glob("*.dcm"))]
    first = headers[0]
    row, column = np.array(first.ImageOrientationPatient, float).reshape(2, 3)
    positions = np.array([header.ImagePositionPatient for header in headers], float)
    affine = np.eye(4)
    affine[:3, 0] = row * float(first.PixelSpacing[1])
    affine[:3, 1] = column * float(first.PixelSpacing[0])
    affine[:3, 2] = np.polyfit(np.arange(len(positions)), positions, 1)[0]
    affine[:3, 3] = positions[0]
    hu = np.stack([h.pixel_array * float(h.RescaleSlope) + float(h.RescaleIntercept) for h in headers])
    return hu, affine, headers


@pytest.fixture(
    scope="module",
    params=[{}, {"tilt": 18.5}, {"tilt": -12.0, "oblique": (10.0, -5.0, 33.0), "transfer_syntax": "implicit"}],
    ids=["straight", "tilted", "tilted-oblique-implicit"],
)
def extra(request: pytest.FixtureRequest) -> dict:
    """What a phantom has beside `AWKWARD`."""
    return request.param


@pytest.fixture(scope="module", params=daily(1, ["sphere", "spine"]))
def series(request: pytest.FixtureRequest, extra: dict, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A phantom as asked for, as told by its truth, and as its files hold it."""
    folder = tmp_path_factory.mktemp("phantom") / "ct"
    settings = PhantomSettings(kind=request.param, **AWKWARD, **extra)
    truth = write_phantom(folder, settings)
    hu, affine, headers = read_back(folder)
    return SimpleNamespace(folder=folder, settings=settings, truth=truth, hu=hu, affine=affine, headers=headers)


def test_written_series_has_the_affine_and_voxels_of_its_truth(series: SimpleNamespace) -> None:
    voxels, affine, truth = make_phantom(series.settings)
    assert series.truth == truth == json.loads((series.folder / "truth.json").read_text())
    assert np.array_equal(series.hu, voxels)
    assert np.array_equal(affine, truth["affine_ijk_to_lps_mm"])
    assert series.affine == pytest.approx(affine, abs=tolerances.PHANTOM_POSITION_MM)


def test_written_series_has_the_size_spacing_and_tilt_of_its_settings(series: SimpleNamespace, extra: dict) -> None:
    row, column, step = series.affine[:3, :3].T
    normal = np.cross(row, column)
    assert list(series.hu.shape[::-1]) == series.truth["shape_ijk"] == [*AWKWARD["size"], AWKWARD["slices"]]
    along_column, along_row, gap = AWKWARD["spacing"]
    assert [np.linalg.norm(row), np.linalg.norm(column)] == pytest.approx([along_row, along_column])
    assert step @ normal / np.linalg.norm(normal) == pytest.approx(gap, abs=FLOAT64)
    assert series.truth["tilt_deg"] == pytest.approx(extra.get("tilt", 0.0), abs=FLOAT64)


def test_headers_of_a_phantom_are_those_of_a_ct(series: SimpleNamespace, extra: dict) -> None:
    first = series.headers[0]
    assert first.file_meta.TransferSyntaxUID.is_implicit_VR == (extra.get("transfer_syntax") == "implicit")
    assert first.SOPClassUID == pydicom.uid.CTImageStorage
    assert first.PatientPosition == "HFS"
    assert (first.BitsStored, first.PixelRepresentation, first.RescaleIntercept) == (16, 1, -1024)
    assert ("GantryDetectorTilt" in first) == ("tilt" in extra)


def test_slices_of_a_phantom_are_of_one_series_and_have_names_of_their_own(series: SimpleNamespace) -> None:
    assert len({header.SOPInstanceUID for header in series.headers}) == AWKWARD["slices"]
    assert len({header.SeriesInstanceUID for header in series.headers}) == 1


def test_decimal_strings_of_a_written_series_have_at_most_16_characters(tmp_path: Path) -> None:
    settings = PhantomSettings(
        kind="sphere", size=(20, 21), slices=19, spacing=(0.7 / 3.0, 0.123456789, 0.2), oblique=(1.0, 2.0, 3.0)
    )
    write_phantom(tmp_path / "ct", settings)
    for path in (tmp_path / "ct").glob("*.dcm"):
        header = pydicom.dcmread(path)
        for name in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing"):
            texts = header.get_item(name).value.decode().split("\\")
            assert all(0 < len(text.strip()) <= 16 for text in texts), texts


def affine_of(**extra: object) -> np.ndarray:
    return make_phantom(PhantomSettings(kind="sphere", **AWKWARD, **extra))[1]  # type: ignore[arg-type]


def directions_of(affine: np.ndarray) -> np.ndarray:
    """Unit vectors along i, j and k as columns."""
    return affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)


@pytest.mark.parametrize("extra", [{}, {"oblique": (30.0, -20.0, 10.0)}], ids=["straight", "oblique"])
def test_axes_of_a_straight_or_oblique_phantom_are_at_right_angles(extra: dict) -> None:
    directions = directions_of(affine_of(**extra))
    assert directions.T @ directions == pytest.approx(np.eye(3), abs=FLOAT64)


def test_gantry_tilt_leans_the_columns_against_a_couch_that_moves_along_z() -> None:
    along_i, along_j, along_k = directions_of(affine_of(tilt=20.0)).T
    assert along_k == pytest.approx((0.0, 0.0, 1.0), abs=FLOAT64)
    assert along_j @ along_k == pytest.approx(-np.sin(np.radians(20.0)), abs=FLOAT64)
    assert along_i @ along_k == pytest.approx(0.0, abs=FLOAT64)


def test_gantry_tilt_keeps_the_volume_of_a_voxel() -> None:
    """The gap of slices is along their normal."""
    straight, tilted = (np.linalg.det(affine_of(**extra)[:3, :3]) for extra in ({}, {"tilt": 20.0}))
    assert tilted == pytest.approx(straight, rel=FLOAT64)


def test_oblique_angles_turn_about_x_then_y_then_z() -> None:
    along_i = directions_of(affine_of(oblique=(30.0, -20.0, 10.0)))[:, 0]
    y, z = np.radians((20.0, 10.0))  # a turn about x leaves the rows where they are
    assert along_i == pytest.approx((np.cos(y) * np.cos(z), np.cos(y) * np.sin(z), np.sin(y)), abs=FLOAT64)


OUTSIDE_HU, INSIDE_HU = -900, 700


@pytest.fixture(scope="module", params=["sphere", "torus", "cylinder", "plane"])
def shape(request: pytest.FixtureRequest) -> SimpleNamespace:
    """An analytic body in tilted and oblique slices without noise."""
    settings = PhantomSettings(
        kind=request.param, size=(61, 44), slices=29, spacing=(0.8, 0.6, 1.3), tilt=15.0, oblique=(5.0, 8.0, -20.0),
        inside_hu=INSIDE_HU, outside_hu=OUTSIDE_HU,
    )  # fmt: skip
    voxels, affine, truth = make_phantom(settings)
    share_inside = (voxels.astype(np.float64) - OUTSIDE_HU) / (INSIDE_HU - OUTSIDE_HU)
    return SimpleNamespace(voxels=voxels, affine=affine, truth=truth, share_inside=share_inside)


def test_voxels_of_a_shape_have_its_size_and_run_from_the_outer_to_the_inner_value(shape: SimpleNamespace) -> None:
    assert (shape.voxels.dtype, shape.voxels.shape) == (np.int16, (29, 44, 61))
    assert (shape.voxels.min(), shape.voxels.max()) == (OUTSIDE_HU, INSIDE_HU)


def test_iso_value_of_a_shape_is_half_way_between_its_values(shape: SimpleNamespace) -> None:
    half_way = (OUTSIDE_HU + INSIDE_HU) / 2
    assert shape.truth["half_maximum_hu"] == shape.truth["iso_value_hu"] == half_way


def test_partial_volumes_of_a_shape_add_up_to_its_stated_volume(shape: SimpleNamespace) -> None:
    voxel_ml = abs(np.linalg.det(shape.affine[:3, :3])) / 1000.0
    stated_ml = shape.truth["surface"]["volume_ml"]
    assert shape.share_inside.sum() * voxel_ml == pytest.approx(stated_ml, rel=tolerances.PHANTOM_VOLUME_RATIO)


def test_centroid_of_the_partial_volumes_of_a_shape_is_its_stated_centre(shape: SimpleNamespace) -> None:
    kji = np.indices(shape.voxels.shape).reshape(3, -1)
    k, j, i = kji @ shape.share_inside.ravel() / shape.share_inside.sum()
    centroid = shape.affine[:3, :3] @ (i, j, k) + shape.affine[:3, 3]
    assert centroid == pytest.approx(shape.truth["surface"]["center_lps_mm"], abs=0.002)  # mm; measured 0.0006


def test_shape_does_not_touch_the_border_of_its_volume(shape: SimpleNamespace) -> None:
    sides = [shape.voxels.take(end, axis) for axis in range(3) for end in (0, -1)]
    assert max(side.max() for side in sides) == OUTSIDE_HU


@pytest.fixture(scope="module")
def spines_by_seed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """The files of three spines, two of them with the same seed."""
    folder = tmp_path_factory.mktemp("seeds")
    for name, seed in (("seed 3", 3), ("seed 3 again", 3), ("seed 4", 4)):
        write_phantom(folder / name, PhantomSettings(kind="spine", **AWKWARD, seed=seed))
    return {each.name: {path.name: path.read_bytes() for path in each.iterdir()} for each in folder.iterdir()}


@pytest.mark.release
def test_files_of_a_phantom_are_its_numbered_slices_and_its_truth(spines_by_seed: dict) -> None:
    assert sorted(spines_by_seed["seed 3"]) == [
        *(f"IM{n:04d}.dcm" for n in range(1, AWKWARD["slices"] + 1)),
        "truth.json",
    ]


@pytest.mark.release
def test_phantom_has_the_same_bytes_with_the_same_seed(spines_by_seed: dict) -> None:
    assert spines_by_seed["seed 3"] == spines_by_seed["seed 3 again"]


@pytest.mark.release
def test_every_file_of_a_phantom_is_another_one_with_another_seed(spines_by_seed: dict) -> None:
    seed_3, seed_4 = spines_by_seed["seed 3"], spines_by_seed["seed 4"]
    assert [name for name in seed_3 if seed_3[name] == seed_4[name]] == []


def test_noise_of_a_sphere_depends_on_the_seed() -> None:
    seed_3, seed_4 = (make_phantom(PhantomSettings(kind="sphere", **AWKWARD, seed=seed))[0] for seed in (3, 4))
    assert not np.array_equal(seed_3, seed_4)


SPHERE = PhantomSettings(kind="sphere", **AWKWARD)


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty folder."""
    (tmp_path / "ct").mkdir()
    return tmp_path / "ct"


def test_earlier_phantom_is_replaced_by_one_of_fewer_slices(folder: Path) -> None:
    write_phantom(folder, SPHERE)
    write_phantom(folder, PhantomSettings(kind="sphere", **{**AWKWARD, "slices": 12}))
    assert len(list(folder.glob("*.dcm"))) == 12


def test_earlier_phantom_with_another_file_beside_it_is_left_and_that_file_named(folder: Path) -> None:
    write_phantom(folder, SPHERE)
    (folder / "notes.txt").write_text("mine")
    before = files_in(folder)
    with refused(UsageError, "notes.txt"):
        write_phantom(folder, SPHERE)
    assert files_in(folder) == before


@pytest.mark.parametrize(
    ("files", "facts"),
    [
        ({"truth.json": '{"generator": "someone"}'}, ("truth.json", "phantom")),
        ({"IM0001.dcm": "a scan of somebody"}, (1, "file", "IM0001.dcm")),
        ({"IM0001.dcm": "a scan of somebody", "IM0002.dcm": "another"}, (2, "files", "IM0001.dcm")),
    ],
    ids=["truth of another program", "one slice", "two slices"],
)
def test_folder_with_files_that_are_no_phantom_is_refused_and_left(
    files: dict[str, str], facts: tuple, folder: Path
) -> None:
    for name, text in files.items():
        (folder / name).write_text(text)
    before = files_in(folder)
    with refused(UsageError, *facts):
        write_phantom(folder, SPHERE)
    assert files_in(folder) == before


def test_phantom_below_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with refused(OutputError, str(tmp_path / "missing" / "ct"), "exist"):
        write_phantom(tmp_path / "missing" / "ct", SPHERE)
    assert list(tmp_path.iterdir()) == []


def test_phantom_in_place_of_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with refused(OutputError, "notes.txt", "file"):
        write_phantom(tmp_path / "notes.txt", SPHERE)
    assert files_in(tmp_path) == {"notes.txt": b"mine"}


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Fills the disk: the first slice of a series is half written, and there is an error."""

    def fail(folder: Path, *rest: object) -> None:
        (folder / "IM0001.dcm").write_bytes(b"half")
        raise OSError(28, "No space left on device")

    return lambda: monkeypatch.setattr(build, "write_series", fail)


def test_earlier_phantom_stays_when_writing_another_fails(folder: Path, full_disk: Callable[[], None]) -> None:
    write_phantom(folder, SPHERE)
    before = files_in(folder)
    full_disk()
    with refused(OutputError, "space"):
        write_phantom(folder, PhantomSettings(kind="sphere", **AWKWARD, seed=5))
    assert files_in(folder) == before


def test_no_folder_is_left_when_writing_a_new_phantom_fails(tmp_path: Path, full_disk: Callable[[], None]) -> None:
    full_disk()
    with refused(OutputError, "space"):
        write_phantom(tmp_path / "new", SPHERE)
    assert list(tmp_path.iterdir()) == []


def test_slice_that_reads_back_differently_is_an_error_and_leaves_no_series(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = pydicom.FileDataset.save_as

    def spoil(self: pydicom.FileDataset, path: Path, **options: object) -> None:
        save(self, path, **options)
        data = bytearray(path.read_bytes())
        data[-1] ^= 1
        path.write_bytes(bytes(data))

    monkeypatch.setattr(pydicom.FileDataset, "save_as", spoil)
    with refused(OutputError, "IM0001.dcm"):
        write_phantom(tmp_path / "ct", PhantomSettings(kind="sphere", **AWKWARD))
    assert list(tmp_path.iterdir()) == []
