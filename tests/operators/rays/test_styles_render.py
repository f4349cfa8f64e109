"""Every style makes its picture, and keywords make the same one byte for byte."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import clrecon
from clrecon import (
    CurveCut,
    LabelMap,
    Lighting,
    PlaneCut,
    Projection,
    SlicesInSpace,
    Style,
    SurfaceLook,
    TransferFunction,
    UsageError,
    VolumeLook,
    VolumeRenderer,
)
from clrecon.geometry import Volume
from clrecon.operators.rays import ray_pictures
from clrecon.operators.reformat import sheets
from clrecon.rendering.pictures import styles
from clrecon.rendering.pictures.modes import MODES
from clrecon.rendering.pictures.styles import PresetSheet

pytestmark = pytest.mark.opencl

SIZE = (40, 32)
GLASS = TransferFunction([(0, 1, 1, 1, 0.1), (500, 1, 0.5, 0, 0.4)])
LINE = [(5.0, -8.0, 35.0), (8.0, -6.0, 45.0), (5.0, -8.0, 60.0)]
SIDE = Lighting(direction=(1.0, -1.0, 1.0))
AFFINE = np.array([[1.1, 0, 0, -10], [0, 0.9, 0, -20], [0, 0, 2.0, 30], [0, 0, 0, 1]])


def body() -> Volume:
    """Random HU from -200 to 1499 in air, in 20 slices."""
    voxels = np.full((20, 30, 34), -1000, np.int16)
    inner = voxels[3:-3, 5:-5, 6:-6]
    inner[...] = np.random.default_rng(3).integers(-200, 1500, inner.shape)
    return Volume(voxels, AFFINE)


def labels() -> LabelMap:
    voxels = np.zeros((20, 30, 34), np.uint8)
    voxels[5:10, 8:15, 8:20], voxels[10:15, 8:15, 8:20] = 1, 2
    return LabelMap(voxels, AFFINE, {1: "L1", 2: "L2"})


LABELS = labels()
SAME: dict[str, tuple[Style, dict[str, Any]]] = {
    "preset": (VolumeLook("skin"), {"preset": "skin"}),
    "function": (VolumeLook(GLASS, jitter=True, ray_step=0.7), {"transfer_function": GLASS, "jitter": True,
                                                                "ray_step": 0.7}),
    "labels": (
        VolumeLook(labels=LABELS, label_colors={"L1": "red"}, label_opacity={2: 0.2}, lighting=SIDE),
        {"labels": LABELS, "label_colors": {"L1": "red"}, "label_opacity": {2: 0.2}, "lighting": SIDE},
    ),
    "mip": (Projection("mip", window=(-100, 900)), {"mode": "mip", "window": (-100, 900)}),
    "minip": (Projection("minip"), {"mode": "minip"}),
    "mean": (Projection("mean", ray_step=1.0), {"mode": "mean", "ray_step": 1.0}),
    "drr": (Projection("drr"), {"preset": "x-ray"}),
    "surface": (
        SurfaceLook(300, color="red", depth_cue=0.4, shadows=True, lighting=SIDE),
        {"iso_value": 300, "color": "red", "depth_cue": 0.4, "shadows": True, "lighting": SIDE},
    ),
    "slices": (SlicesInSpace([7, 3], opacity=0.9), {"mode": "slices", "slices": [7, 3], "slice_opacity": 0.9}),
    "presets": (PresetSheet(ray_step=0.9), {"preset": "all", "ray_step": 0.9}),
    "slice": (
        PlaneCut(offset_mm=2.5, thickness=5.0, combine="max", window=(0, 900)),
        {"mode": "slice", "offset_mm": 2.5, "thickness": 5, "combine": "max", "window": (0, 900)},
    ),
    "cpr": (CurveCut(LINE, kind="stretched"), {"curve": LINE, "cpr": "stretched"}),
}  # fmt: skip


def test_table_of_styles_has_every_mode_of_volumes() -> None:
    of_others = {"points", "mesh"}  # tests/operators/rays/test_splats.py, test_triangles.py
    assert {style.mode for style, _ in SAME.values()} == set(MODES) - of_others


@pytest.mark.parametrize("name", SAME)
def test_a_style_and_keywords_make_the_same_picture(device: Any, name: str) -> None:
    style, look = SAME[name]
    size = (400, 300) if style.is_sheet else SIZE  # ten tiles of at least 64 pixels
    place: dict[str, Any] = {"view": (20, 30), "size": size}
    with VolumeRenderer(body(), device=device) as renderer:
        first, second = renderer.render(style, **place), renderer.render(**look, **place)
    third = clrecon.render(body(), style, device=device, **place)
    assert first.mode == style.mode and first.size == size
    assert first.image[..., :3].any()
    for other in (second, third):
        for array in ("image", "depth", "expected_depth", "values"):
            one, two = getattr(first, array), getattr(other, array)
            assert (one is None and two is None) or one.tobytes() == two.tobytes()


def test_cut_has_the_pixels_that_are_asked_for(device: Any) -> None:
    assert clrecon.render(body(), PlaneCut(pixel_mm=0.7), size=SIZE, device=device).pixel_mm == pytest.approx(0.7)


def test_curved_cut_is_as_wide_as_is_asked_for(device: Any) -> None:
    picture = clrecon.render(body(), CurveCut(LINE, width_mm=20.0, pixel_mm=0.5), view="left", device=device)
    width, _ = picture.size
    assert width == 20.0 / 0.5


def test_angle_of_a_curved_cut_changes_its_picture(device: Any) -> None:
    straight, turned = (
        clrecon.render(body(), CurveCut(LINE, angle=angle), view="left", device=device).values for angle in (0.0, 45.0)
    )
    assert straight is not None and turned is not None
    assert not np.array_equal(straight, turned, equal_nan=True)


@pytest.mark.parametrize(
    ("style", "keywords", "words"),
    [
        (SurfaceLook(), {"color": "red"}, "leave out color, or the style"),
        (PlaneCut(), {"view_angle": 20.0}, "view_angle does not apply to mode slice"),
        (CurveCut(LINE), {"camera": clrecon.Camera.fit(body())}, "a curved reformation has no camera"),
        (VolumeLook(ray_step=1e-4), {"size": SIZE}, "ray step is a length in mm, at least"),
        (SlicesInSpace([20]), {"size": SIZE}, "slices 0 to 19"),
    ],
    ids=["colour", "view angle", "camera", "ray step", "slices"],
)
def test_styles_and_keywords_that_do_not_go_together_are_refused(
    device: Any, style: Style, keywords: dict[str, Any], words: str
) -> None:
    with pytest.raises(UsageError, match=words):
        clrecon.render(body(), style, device=device, **keywords)


TOLD_STYLES = pytest.mark.parametrize("name", ["preset", "mip", "surface", "slices", "slice", "cpr"])


def style_without_shadows(name: str) -> Style:
    """Shadows need the whole volume."""
    style, _ = SAME[name]
    return replace(style, shadows=False) if isinstance(style, SurfaceLook) else style


@TOLD_STYLES
def test_progress_of_a_picture_is_told_in_slabs_up_to_all(device: Any, name: str) -> None:
    calls: list[tuple[str, int, int]] = []
    place: dict[str, Any] = {"view": (20, 30), "size": SIZE, "device": device}
    picture = clrecon.render(body(), style_without_shadows(name), **place, progress=lambda *call: calls.append(call))
    assert picture.image[..., :3].any()
    assert {stage for stage, _, _ in calls} == {"slabs"}
    assert [done for _, done, _ in calls] == sorted(done for _, done, _ in calls)
    _, done, total = calls[-1]
    assert done == total > 0


@TOLD_STYLES
def test_an_error_that_progress_raises_ends_the_picture(device: Any, name: str) -> None:
    raised = clrecon.Cancelled("enough")

    def progress(stage: str, done: int, total: int) -> None:
        if done == total:
            raise raised

    with pytest.raises(clrecon.Cancelled, match="enough") as error:
        clrecon.render(body(), style_without_shadows(name), view=(20, 30), size=SIZE, device=device, progress=progress)
    assert error.value is raised


def test_progress_of_a_picture_in_slabs_is_told_at_the_start_and_after_each(device: Any) -> None:
    calls, volume = [], body()
    picture = clrecon.render(
        volume, size=(8, 8), device=device, memory=90_000, progress=lambda stage, done, total: calls.append(done)
    )
    assert picture.report["slabs"] == len(calls) - 1 > 1
    assert calls == sorted(calls)
    assert calls[-1] == len(volume.voxels)  # slices


def test_projections_and_combinations_of_styles_are_those_of_the_kernels() -> None:
    assert tuple(ray_pictures.PROJECTIONS) == styles.PROJECTIONS
    assert tuple(sheets.COMBINATIONS) == styles.COMBINATIONS
