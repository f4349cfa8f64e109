"""OME-Zarr: the volume of its voxels and metadata; damage, missing chunks and metadata that place nothing."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_files import write_nifti
from refusals import assert_facts, refused
from volume_files import make_axes, make_ct, write_ome_zarr

import clrecon
from clrecon.errors import RefusedInputError, UsageError
from clrecon.reading.grids import open_grid
from clrecon.reading.grids.zarr_store import ZarrChunks
from clrecon.system import memory

pytest.importorskip("zarr")

SHAPE = (9, 6, 7)
"""Whole chunks of 4 slices and one more, and cut chunks along each axis."""

STORES: dict[str, dict[str, Any]] = {
    "Zarr 2": {"version": 2},
    "Zarr 3": {},
    "shards of chunks": {"shards": (8, 8, 8)},
    "one chunk": {"chunks": SHAPE},
    "no compression": {"compressors": None},
}
MOVED = [{"type": "scale", "scale": [2.5, 0.75, 0.5]}, {"type": "translation", "translation": [-84.0, -30.0, -25.0]}]
AFFINE = np.array([[0.5, 0, 0, -25], [0, 0.75, 0, -30], [0, 0, 2.5, -84], [0, 0, 0, 1]])
"""Of `MOVED`; NIfTI holds all numbers exactly."""


@pytest.mark.parametrize("store", STORES)
def test_ome_zarr_is_the_volume_of_a_nifti_of_its_voxels(tmp_path: Path, store: str) -> None:
    voxels = make_ct(SHAPE)
    volume = clrecon.read_volume(write_ome_zarr(tmp_path / "a.zarr", voxels, place=MOVED, **STORES[store]))
    expected = clrecon.read_volume(write_nifti(tmp_path / "a.nii", voxels, AFFINE))
    assert volume.voxels.dtype == expected.voxels.dtype
    assert np.array_equal(volume.voxels, expected.voxels)
    assert np.array_equal(volume.affine, expected.affine)
    for name in ("warnings", "gates", "hu_range", "spacing_mm"):
        assert volume.report[name] == expected.report[name], name


def test_axes_in_another_order_and_direction_place_the_voxels_where_the_patient_is(tmp_path: Path) -> None:
    axes = make_axes("xzy", unit="micrometer")
    axes[0]["orientation"]["value"] = "left-to-right"
    place = [{"type": "scale", "scale": [500, 2500, 750]}, {"type": "translation", "translation": [1000, 2000, 3000]}]
    volume = clrecon.read_volume(write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE), axes=axes, place=place))
    i, j, k = [0, 0.75, 0, 0], [0, 0, 2.5, 0], [-0.5, 0, 0, 0]  # k is the first axis, x, which runs to the right
    assert np.allclose(volume.affine, np.transpose([i, j, k, [-1, 3, 2, 1]]), rtol=1e-15)


def test_axes_without_an_orientation_are_taken_as_lps_with_a_failed_gate(tmp_path: Path) -> None:
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE), axes=make_axes(orientation=False), place=MOVED)
    volume = clrecon.read_volume(path)
    assert np.array_equal(volume.affine, AFFINE)
    assert_facts(volume.report["warnings"][-1], "x", "y", "z", "LPS")
    assert [gate["name"] for gate in volume.report["gates"] if gate["ok"] is False] == ["header_clear"]


def test_time_and_channel_of_one_entry_are_left_out(tmp_path: Path) -> None:
    voxels = make_ct(SHAPE)
    place = [{"type": "scale", "scale": [1, 1, 2.5, 0.75, 0.5]}]
    path = write_ome_zarr(tmp_path / "a.zarr", voxels[None, None], axes=make_axes("tczyx"), place=place)
    volume = clrecon.read_volume(path)
    assert np.array_equal(volume.voxels, voxels)
    assert np.allclose(volume.spacing, (0.5, 0.75, 2.5), rtol=1e-15)


def test_missing_file_of_a_chunk_is_a_warning_with_the_value_that_its_voxels_get(tmp_path: Path) -> None:
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE), fill_value=-77)
    (path / "0/c/1/0/1").unlink()
    volume = clrecon.read_volume(path)
    assert (volume.voxels[4:8, :4, 4:] == -77).all()
    assert_facts(volume.report["warnings"][-1], 1, -77)


def leave_out(*keys: str) -> Callable[[dict[str, Any]], None]:
    def change(image: dict[str, Any]) -> None:
        for key in keys:
            del image[key]

    return change


def set_axis(**fields: Any) -> Callable[[dict[str, Any]], None]:
    return lambda image: image["axes"][2].update(fields)


def set_place(*transformations: dict[str, Any]) -> Callable[[dict[str, Any]], None]:
    return lambda image: image["datasets"][0].update(coordinateTransformations=transformations)


ODD: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "no unit": (lambda image: image["axes"][2].pop("unit"), "voxel_size"),
    "unknown unit": (set_axis(unit="parsec"), "parsec"),
    "no axes, as before 0.4": (leave_out("axes"), "axes"),
    "axes that are none": (lambda image: image.update(axes=[1, 2, 3]), "0"),
    "two axes": (lambda image: image["axes"].pop(), "2"),
    "a plane": (set_axis(type="channel", name="c"), "2"),
    "two axes of one direction": (set_axis(orientation={"value": "superior-to-inferior"}), "direction"),
    "axis of another name": (set_axis(name="w", orientation=None), "w"),
    "no scale": (set_place({"type": "translation", "translation": [1, 2, 3]}), "scale"),
    "scale of two axes": (set_place({"type": "scale", "scale": [1, 2]}), "2"),
    "scale of 0": (set_place({"type": "scale", "scale": [1, 0, 1]}), "placed"),
    "words for a scale": (set_place({"type": "scale", "scale": ["a", "b", "c"]}), "metadata"),
    "rotation": (set_place({"type": "rotation", "rotation": []}), "rotation"),
    "no levels": (lambda image: image.update(datasets=[]), "metadata"),
    "level that is missing": (lambda image: image["datasets"][0].update(path="9"), "metadata"),
    "level outside": (lambda image: image["datasets"][0].update(path="../other/0"), "metadata"),
}


@pytest.mark.parametrize("odd", ODD)
def test_metadata_that_place_no_volume_are_refused(tmp_path: Path, odd: str) -> None:
    change, fact = ODD[odd]
    write_ome_zarr(tmp_path / "other", make_ct(SHAPE))
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE))
    metadata = json.loads((path / "zarr.json").read_text())
    change(metadata["attributes"]["ome"]["multiscales"][0])
    (path / "zarr.json").write_text(json.dumps(metadata))
    with refused(RefusedInputError, "a.zarr", fact):
        clrecon.read_volume(path)


@pytest.mark.parametrize("version", [2, 3])
def test_array_without_metadata_is_read_with_a_given_voxel_size_and_a_failed_gate(tmp_path: Path, version: int) -> None:
    voxels = make_ct(SHAPE)
    path = write_ome_zarr(tmp_path / "a.zarr", voxels, version=version) / "0"
    volume = clrecon.read_volume(path, voxel_size=(0.5, 0.75, 2.5))
    assert np.array_equal(volume.voxels, voxels)
    assert np.array_equal(volume.affine, np.diag([0.5, 0.75, 2.5, 1.0]))
    assert_facts(volume.report["warnings"][-1], 0.5, 0.75, 2.5, "given")
    assert [gate["name"] for gate in volume.report["gates"] if gate["ok"] is False] == ["header_clear"]


def test_given_voxel_size_is_the_step_of_axes_without_a_unit_and_their_origin_is_in_these_steps(tmp_path: Path) -> None:
    axes = [{"name": name, "type": "space"} for name in "zyx"]
    place = [{"type": "scale", "scale": [1, 1, 2]}, {"type": "translation", "translation": [-3, 0, 10]}]
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE), axes=axes, place=place)
    affine = clrecon.read_volume(path, voxel_size=(0.5, 0.75, 2.5)).affine
    assert np.array_equal(affine[:3, :3], np.diag([0.5, 0.75, 2.5]))
    assert affine[:3, 3].tolist() == [2.5, 0.0, -7.5]  # 10 units of x are 5 of its steps, -3 of z 3


def test_voxel_size_is_refused_where_the_metadata_have_one(tmp_path: Path) -> None:
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE))
    with refused(UsageError, "a.zarr", "voxel_size"):
        clrecon.read_volume(path, voxel_size=(1, 1, 1))


def test_voxel_size_of_another_format_is_refused(tmp_path: Path) -> None:
    path = write_nifti(tmp_path / "a.nii", make_ct(SHAPE), AFFINE)
    with refused(UsageError, "voxel_size", "Zarr"):
        clrecon.read_volume(path, voxel_size=(1, 1, 1))


@pytest.mark.parametrize("size", [(1, 1), (1, 1, 0), (1, 1, np.inf)], ids=["two", "zero", "infinite"])
def test_voxel_size_that_is_none_is_refused(tmp_path: Path, size: Any) -> None:
    with refused(UsageError, "voxel_size", "mm"):
        clrecon.read_volume(tmp_path, voxel_size=size)


def test_several_volumes_along_an_axis_are_refused_with_their_number(tmp_path: Path) -> None:
    place = [{"type": "scale", "scale": [1, 1, 1, 1]}]
    path = write_ome_zarr(tmp_path / "a.zarr", np.stack([make_ct(SHAPE)] * 3), axes=make_axes("czyx"), place=place)
    with refused(RefusedInputError, "c", 3):
        clrecon.read_volume(path)


@pytest.mark.parametrize("version", [2, 3])
def test_array_without_metadata_of_an_image_is_refused(tmp_path: Path, version: int) -> None:
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE), version=version) / "0"
    with refused(RefusedInputError, "multiscales", "voxel_size"):
        clrecon.read_volume(path)


def test_folder_named_zarr_without_its_metadata_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.zarr").mkdir()
    with refused(RefusedInputError, "a.zarr", "OME-Zarr"):
        clrecon.read_volume(tmp_path / "a.zarr")


@pytest.mark.parametrize("store", STORES)
@pytest.mark.parametrize(
    "damage", [lambda content: content[: len(content) // 2], lambda content: b""], ids=["cut", "empty"]
)
def test_cut_file_of_chunks_is_refused(tmp_path: Path, store: str, damage: Callable[[bytes], bytes]) -> None:
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE), **STORES[store])
    file = max((path / "0").rglob("*"), key=lambda part: part.stat().st_size if part.is_file() else 0)
    file.write_bytes(damage(file.read_bytes()))
    with refused(RefusedInputError, "a.zarr"):
        clrecon.read_volume(path)


def test_store_with_a_link_is_refused(tmp_path: Path) -> None:
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE))
    chunk = path / "0/c/0/0/0"
    shutil.move(chunk, tmp_path / "chunk")
    chunk.symlink_to(tmp_path / "chunk")
    with refused(RefusedInputError, "link"):
        clrecon.read_volume(path)


def test_chunks_that_unpack_to_more_than_is_read_at_a_time_are_refused(tmp_path: Path) -> None:
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE))
    metadata = json.loads((path / "0/zarr.json").read_text())
    metadata["chunk_grid"]["configuration"]["chunk_shape"] = [4, 1 << 20, 1 << 20]
    (path / "0/zarr.json").write_text(json.dumps(metadata))
    with refused(RefusedInputError, 4, 1 << 20):
        clrecon.read_volume(path)


def test_ome_zarr_is_refused_where_zarr_is_missing_with_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE))
    monkeypatch.setitem(sys.modules, "zarr", None)
    with refused(UsageError, "zarr"):
        clrecon.read_volume(path)


class Greedy:
    """An array of which no part fits the memory."""

    shape, chunks, ndim, dtype = SHAPE, SHAPE, 3, np.dtype(np.int16)

    def __getitem__(self, selection: Any) -> np.ndarray:
        raise MemoryError("Unable to allocate 72 MiB")


def test_memory_that_is_too_small_for_a_layer_of_chunks_is_no_damage(tmp_path: Path) -> None:
    grid = open_grid(write_ome_zarr(tmp_path / "a.zarr", make_ct(SHAPE)), "OME-Zarr", "volume")
    greedy = replace(grid, voxel_bytes=ZarrChunks(tmp_path, Greedy(), (0, 1, 2), file_bytes=1000))
    with refused(RefusedInputError, "a.zarr", "memory", 72):
        next(greedy.iterate_slices())


@pytest.fixture
def too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, np.ndarray]:
    """A store and its voxels, of which half would fit the free memory."""
    voxels = make_ct(SHAPE)
    monkeypatch.setattr(memory, "available_memory_bytes", lambda: voxels.nbytes / 2)
    return write_ome_zarr(tmp_path / "a.zarr", voxels), voxels


def test_volume_larger_than_the_free_memory_is_mapped_from_a_file(too_large: tuple[Path, np.ndarray]) -> None:
    path, voxels = too_large
    volume = clrecon.read_volume(path)
    assert memory.find_mapping(volume.voxels) is not None
    assert np.array_equal(volume.voxels, voxels)


def test_volume_larger_than_the_free_memory_and_disk_is_refused(
    too_large: tuple[Path, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, voxels = too_large
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: shutil._ntuple_diskusage(1, 1, voxels.nbytes // 2))
    with refused(RefusedInputError, "a.zarr", "TMPDIR"):
        clrecon.read_volume(path)
