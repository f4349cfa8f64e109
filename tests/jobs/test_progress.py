"""What takes long without a device tells how far it is, never goes back, and ends where it is told to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from label_files import make_labels, write_nifti
from sample_meshes import torus
from variants import daily

import clrecon
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.proof.phantom import PhantomSettings, make_phantom
from clrecon.system.progress import Progress

Work = Callable[..., Any]


@pytest.fixture(scope="module")
def works(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, Work]]:
    """By name: the stage that is told, and the work, which takes `progress`."""
    voxels, affine, _ = make_phantom(PhantomSettings(size=(160, 144), slices=60, spacing=(1.9, 1.8, 2.5)))
    volume = Volume(voxels, affine)
    vertices, triangles = torus(rings=60, sides=32)
    mesh = Mesh(vertices, triangles, report={"affine_ijk_to_lps_mm": np.eye(4).tolist()})
    other = Mesh(vertices + 0.1, triangles)
    labels = write_nifti(tmp_path_factory.mktemp("labels") / "labels.nii", make_labels(), np.eye(4))
    return {
        "choose_iso_value": ("choose", lambda **own: clrecon.choose_iso_value(volume, **own)),
        "find_spine_line": ("curve", lambda **own: clrecon.find_spine_line(volume, **own)),
        "mask_field_of_view": ("mask", lambda **own: clrecon.mask_field_of_view(volume, 90.0, **own)),
        "remove_table": ("mask", lambda **own: clrecon.remove_table(volume, **own)),
        "smooth_mesh": ("smooth", lambda **own: clrecon.smooth_mesh(mesh, 5, **own)),
        "decimate_mesh": ("decimate", lambda **own: clrecon.decimate_mesh(mesh, 0.5, **own)),
        "collapse_quadric": ("decimate", lambda **own: clrecon.collapse_quadric(mesh, 0.5, **own)),
        "compare_meshes": ("compare", lambda **own: clrecon.compare_meshes(mesh, other, 2000, **own)),
        "read_labels": ("read", lambda **own: clrecon.read_labels(labels, **own)),
    }


NAMES = (
    "choose_iso_value", "find_spine_line", "mask_field_of_view", "remove_table", "smooth_mesh", "decimate_mesh",
    "collapse_quadric", "compare_meshes", "read_labels",
)  # fmt: skip


@pytest.mark.parametrize("name", daily(2, NAMES))
def test_progress_of_a_function_names_its_stage_and_rises_to_its_total(
    works: dict[str, tuple[str, Work]], name: str
) -> None:
    stage, work = works[name]
    calls: list[tuple[str, int, int]] = []

    work(progress=lambda *call: calls.append(call))

    assert {called for called, _, _ in calls} == {stage}
    done = [done for _, done, _ in calls]
    (total,) = {total for _, _, total in calls}
    assert done == sorted(done)
    assert len(set(done)) > 1
    assert done[-1] == total


@pytest.mark.parametrize("name", daily(2, NAMES))
def test_result_of_a_function_with_progress_is_that_without_it(works: dict[str, tuple[str, Work]], name: str) -> None:
    _, work = works[name]

    watched, alone = work(progress=lambda *call: None), work()

    arrays = [name for name in ("voxels", "vertices", "points") if hasattr(alone, name)]
    for name in arrays:
        assert np.array_equal(getattr(watched, name), getattr(alone, name))
    assert arrays or watched == alone  # a record of figures


@pytest.mark.parametrize("name", NAMES)
def test_error_raised_by_progress_ends_a_function_at_once_and_arrives_as_it_is(
    works: dict[str, tuple[str, Work]], name: str
) -> None:
    _, work = works[name]
    calls: list[int] = []
    raised = clrecon.Cancelled("enough")

    def progress(stage: str, done: int, total: int) -> None:
        calls.append(done)
        if len(calls) == 2:
            raise raised

    takes: Progress = progress
    with pytest.raises(clrecon.Cancelled) as error:
        work(progress=takes)

    assert error.value is raised
    assert len(calls) == 2
