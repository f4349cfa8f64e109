"""Each parameter of each public function is given what it is not: a `ClreconError`, or a TypeError that names it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.errors import ClreconError, UsageError
from clrecon.geometry import Volume
from clrecon.proof.phantom.settings import PhantomSettings
from clrecon.proof.phantom.truth import PhantomTruth
from clrecon.system.arguments import explains_arguments

pytestmark = pytest.mark.first_device

RESULTS = {
    "Clustering", "Device", "IsoChoice", "LabelFigures", "MeshQuality", "MiddlePlane", "Neighbours", "Noise",
    "PhantomTruth", "PointStep", "Rendering", "Vertebra", "VertebraSplit",
}  # fmt: skip
"""Classes that functions return and nobody makes."""
INNER = {
    "alike", "attempts", "bring", "changed", "clear", "describe", "describe_parts", "follow", "keep", "kept_bytes",
    "make_way", "of_known", "part", "pays_whole", "place", "plan", "program", "release_slices", "render_with_layers",
    "shortage", "slice_origins", "upload", "whole",
}  # fmt: skip
"""Methods of public classes for clrecon's own modules."""
WITH_METHODS = {
    "Camera", "Clip", "DeviceVolume", "LabelMap", "Mask", "Mesh", "PhantomTruth", "PointCloud", "Rendering",
    "SurfaceExtractor", "TransferFunction", "Volume", "VolumeRenderer",
}  # fmt: skip
FREE = {"memory", "progress", "report", "trusted"}


class Nothing:
    """What no parameter takes."""


@cache
def examples() -> dict[str, Any]:
    """One of each kind, a ball of bone in 10 slices."""
    k, j, i = np.indices((10, 11, 12))
    ball = np.where((k - 5) ** 2 + (j - 5) ** 2 + (i - 6) ** 2 < 12, 700, -1000).astype(np.int16)
    volume = clrecon.Volume(ball, np.diag([1.0, 1.0, 1.5, 1.0]))
    return {
        "Volume": volume,
        "DeviceVolume": clrecon.DeviceVolume(volume),
        "LabelMap": clrecon.LabelMap((ball > 0).astype(np.uint8), volume.affine, {1: "bone"}),
        "Mesh": clrecon.extract_isosurface(volume, 200),
        "PhantomTruth": PhantomTruth(PhantomSettings(kind="sphere")),
        "PointCloud": clrecon.extract_points(volume, hu=(200, 3000)),
        "Mask": clrecon.Mask.from_band(volume, (200, 3000)),
        "Camera": clrecon.Camera.fit(volume),
        "Clip": clrecon.Clip.box(low=(0, 0, 0), high=(5, 5, 5)),
        "Rendering": clrecon.render(volume, size=(16, 16)),
        "TransferFunction": clrecon.TransferFunction.from_window(0, 1000),
        "SurfaceExtractor": clrecon.SurfaceExtractor(volume),
        "VolumeRenderer": clrecon.VolumeRenderer(volume),
    }


def wrong_values() -> list[Any]:
    odd = [
        None,
        True,
        -1,
        float("nan"),
        10**400,
        "nonsense",
        b"x",
        [],
        [None, "a"],
        {},
        Nothing(),
        2j,
        int,
        (200, None),
    ]
    arrays = [np.zeros(3), np.zeros((2, 2), object)]
    return [*odd, *arrays, *(examples()[name] for name in ("Volume", "Mesh", "LabelMap", "PointCloud", "Camera"))]


def public_callables() -> list[str]:
    """Names of functions and classes, and ``Class.method`` of what `examples` has."""
    found = [name for name in dir(clrecon) if not name.startswith("_") and name not in RESULTS]
    found = [name for name in found if callable(getattr(clrecon, name)) and is_own(getattr(clrecon, name))]
    classes = [name for name in found if inspect.isclass(getattr(clrecon, name))]
    methods = [f"{name}.{method}" for name in classes for method in methods_of(getattr(clrecon, name))]
    return found + methods


def is_own(thing: Any) -> bool:
    return thing.__module__.startswith("clrecon") and not (inspect.isclass(thing) and issubclass(thing, Exception))


def methods_of(kind: type) -> list[str]:
    if kind.__name__ not in WITH_METHODS:
        return []
    own = [each for base in kind.__mro__ if base.__module__.startswith("clrecon") for each in vars(base)]
    chosen = dict.fromkeys(name for name in own if not name.startswith("_") and name not in INNER)
    return [name for name in chosen if callable(getattr(kind, name)) and parameters(getattr(kind, name))]


def parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """The parameters that are tried: by name, and with a meaning of their own."""
    named = inspect.signature(function).parameters.values()
    tried = [each for each in named if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)]
    return [each for each in tried if each.name not in FREE | {"self"}]


def sound_arguments(function: Callable[..., Any], folder: Path) -> dict[str, Any]:
    """What the function needs, as far as it follows from names and annotations."""
    volume, mesh = examples()["Volume"], examples()["Mesh"]
    known = {
        "hu": (200, 3000), "iso_value": 200, "iso_values": [200], "label": 1,
        "voxels": examples()["LabelMap"].voxels,
        "affine": volume.affine, "points": examples()["PointCloud"].points, "vertices": mesh.vertices,
        "triangles": mesh.triangles, "path": folder / "new.nii.gz", "name": "median", "method": "t-mc", "mm": 1.0,
        "rules": "largest:1", "fraction": 0.5, "frames": [examples()["Rendering"]] * 2, "room": examples()["Mask"],
    }  # fmt: skip
    found = {}
    for each in parameters(function):
        if each.default is each.empty:
            of_kind = [thing for name, thing in examples().items() if name in str(each.annotation)]
            found[each.name] = known.get(each.name, of_kind[0] if of_kind else 3)
    return found


def find_faults(function: Callable[..., Any], folder: Path) -> Iterator[str]:
    sound = sound_arguments(function, folder)
    small = {"samples": 50, "size": (16, 16)}  # what runs all the same is to be quick
    sound |= {name: value for name, value in small.items() if name in inspect.signature(function).parameters}
    for parameter in parameters(function):
        for value in wrong_values():
            try:
                made = function(**{**sound, parameter.name: value})
                if function is clrecon.time_limit:
                    with made:
                        pass
            except ClreconError:
                pass
            except Exception as error:
                if not isinstance(error, TypeError) or parameter.name not in str(error):
                    shown = type(value).__name__ if not isinstance(value, str | float | None) else repr(value)
                    yield f"{parameter.name}={shown}: {type(error).__name__}: {error}"


@pytest.mark.untraced
@pytest.mark.parametrize("name", public_callables())
def test_wrong_argument_of_a_public_function_is_refused_with_the_name_of_the_parameter(
    name: str, device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kind, _, method = name.partition(".")
    function = getattr(examples()[kind] if method else clrecon, method or kind)
    assert list(find_faults(function, tmp_path)) == []


@explains_arguments
def sample(
    volume: Volume, count: int = 1, share: float | None = None, names: tuple[str, str] = ("a", "b")
) -> tuple[int, ...]:
    return volume.shape[0] + range(100)[count], round(share or 0.0), len(names[1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            {"volume": np.zeros((2, 2, 2)).tolist()},
            "volume must be a Volume, not list: see clrecon.read_volume and clrecon.Volume(voxels, affine)",
        ),
        ({"count": 1.5}, "count must be a whole number, not 1.5"),
        ({"count": 10**400}, "count must be a whole number, not one of 1329 bits"),
        ({"share": "x"}, "share must be a number or None, not 'x'"),
        ({"share": int}, "share must be a number or None, not the class int"),
        ({"names": ("a",)}, "names must be 2 values, not tuple"),
    ],
)
def test_message_about_a_wrong_argument_says_what_is_expected_and_what_was_given(
    arguments: dict[str, Any], words: str
) -> None:
    with pytest.raises(UsageError) as caught:
        sample(**{"volume": examples()["Volume"], **arguments})
    assert str(caught.value) == words
    assert caught.value.__cause__ is not None  # the error that the wrong argument has led to


def test_arguments_of_numpy_types_and_a_list_in_place_of_a_tuple_are_accepted() -> None:
    ten_slices = examples()["Volume"]
    result = sample(ten_slices, np.uint8(3), np.float32(0.5), ["a", "b"])  # type: ignore[arg-type]
    assert result == (10 + 3, round(0.5), len("b"))


def test_missing_argument_raises_the_error_of_python() -> None:
    with refused(TypeError, "volume"):
        sample()  # type: ignore[call-arg]


def test_error_of_right_arguments_is_raised_as_it_is() -> None:
    with refused(IndexError, "range"):
        sample(examples()["Volume"], count=100)  # of a range of 100


def test_function_that_checks_no_argument_is_found(tmp_path: Path) -> None:
    def count_vertices(mesh: Any) -> int:
        return len(mesh.vertices)

    assert any("AttributeError" in each for each in find_faults(count_vertices, tmp_path))


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (clrecon.cluster_points, "cloud must be a PointCloud, a Volume or a DeviceVolume, not ndarray: see clr"),
        (clrecon.Camera.fit, "volume must be a Volume, not ndarray: see clrecon.read_volume"),
        (clrecon.fill_ghost_slices, "found must be a GhostSlices, not ndarray: see clrecon.find_ghost_slices"),
    ],
)
def test_message_about_a_wrong_argument_names_the_public_class_and_how_to_make_it(
    function: Callable[..., Any], words: str
) -> None:
    first = (examples()["Volume"],) if function is clrecon.fill_ghost_slices else ()
    with pytest.raises(UsageError) as caught:
        function(*first, np.zeros((5, 3)))
    assert str(caught.value).startswith(words)
