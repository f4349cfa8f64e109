"""Arguments of public functions: the words by which a message names them, and which one is of a wrong kind.

A parameter is named by Python's word, or on the command line by the option of the running command (`clrecon.cli.main`).

>>> name_parameter("keep_largest", "N")
'keep_largest=N'

Where a function fails on an argument of a wrong kind, the error names the parameter.  What is wanted is read from the
annotations, so that it stands once.  Only kinds are told apart (a number, a text, a `Volume`); what a function checks
by itself it says by itself, with ranges and shapes.
"""

from __future__ import annotations

import functools
import inspect
import math
import operator
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar, cast

from clrecon.errors import ClreconError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


Speaker = Callable[[str, object], str]
"""Function that takes a parameter and its value (None for the parameter alone) and returns the words."""


def in_python(parameter: str, value: object = None) -> str:
    """Return the words for a caller in Python; capital letters stand for a value: ``N``, ``(BONE, TISSUE)``."""
    if value is None:
        return parameter
    return f"{parameter}={value if isinstance(value, str) and value == value.upper() else repr(value)}"


_DESTINATIONS = {
    "color_by": "color",
    "direction": "light",
    "eps": "clusters",
    "half_way": "iso_value",
    "labels": "path",
    "iso_value": "hu",
    "kind": "points",
    "min_samples": "clusters",
    "picture": "output",
}
"""Other names of parameters, which count where a command has no option of the parameter's own name."""

_PARTS = {"eps": "eps=", "min_samples": "min="}
"""Parameters that are a part of an option's value."""


class OptionSpeaker:
    """Names parameters as options of a command, by `options` with their first flags; others as in Python."""

    def __init__(self, options: Mapping[str, str]):
        self.options = options

    def __call__(self, parameter: str, value: object = None) -> str:
        name = parameter
        while name not in self.options:
            if name not in _DESTINATIONS:
                return in_python(parameter, value)
            name = _DESTINATIONS[name]
        option = self.options[name]
        part = _PARTS.get(parameter, "")
        if part:
            unit = "MM" if parameter == "eps" else "N"
            return f"{option} {part}{unit if value is None else value}"
        if value is None or value is True or (parameter == "closed" and value is False):
            return option
        words = str(value).strip("()").replace(", ", ",")
        return f"{option} {'half:' if parameter == 'half_way' and value != 'auto' else ''}{words}"


_speaker: Speaker = in_python


def name_parameter(parameter: str, value: object = None) -> str:
    """Name a parameter in words of Python or the command line, with a value, or capitals such as ``"N"`` for one."""
    return _speaker(parameter, value)


def current_speaker() -> Speaker:
    return _speaker


@contextmanager
def spoken_by(speaker: Speaker) -> Iterator[None]:
    """Let `speaker` name parameters within a block; messages of other threads change with it during that time."""
    global _speaker
    before, _speaker = _speaker, speaker
    try:
        yield
    finally:
        _speaker = before


Space = Literal["lps", "ras", "LPS", "RAS"]
Topology = Literal["separated", "trilinear"]
VertexRule = Literal["linear", "golden", "golden-search"]
MethodName = Literal["t-mc", "i-mc", "g-mc", "s-mc", "t-mc-soup", "skimage"]
FilterName = Literal["median", "gaussian", "curvature-flow", "non-local-means"]
SurfaceKind = Literal["hu", "cortex"]
PointKind = Literal["surface", "cortex", "shell", "voxels"]
ProjectionKind = Literal["mip", "minip", "mean", "drr"]
Combination = Literal["mean", "max", "min"]
CurvedKind = Literal["straightened", "stretched"]
ModeName = Literal[
    "dvr", "mip", "minip", "mean", "drr", "surface", "slices", "slice", "cpr", "presets", "points", "mesh"
]  # fmt: skip
PresetName = Literal["bone", "spine", "skin", "lung", "vessels", "muscle", "metal", "x-ray", "mip", "minip"]
WindowName = Literal["bone", "soft", "lung", "abdomen", "mediastinum", "brain"]
DirectionName = Literal["anterior", "posterior", "left", "right", "superior", "inferior"]
ViewName = Literal["anterior", "posterior", "left", "right", "superior", "inferior", "axial", "coronal", "sagittal"]
Features = Literal["paper", "variation"]
"""Words of which only some are possible; the functions refuse others."""
_CHOICES = "Space Topology VertexRule MethodName FilterName PointKind Combination CurvedKind Features Literal".split()
_CHOICES += ["SurfaceKind", "ModeName", "PresetName", "WindowName", "ViewName", "DirectionName"]

_CLASSES = (
    "Volume", "DeviceVolume", "Mesh", "LabelMap", "PointCloud", "Mask", "Camera", "GridCells", "GhostSlices",
    "Lighting", "Clip", "TransferFunction", "Rendering", "Style", "PhantomSettings",
)  # fmt: skip
_LARGEST = 2**63

_MAKERS = {
    "a Volume": "see clrecon.read_volume and clrecon.Volume(voxels, affine)",
    "a Mesh": "see clrecon.read_mesh and clrecon.Mesh(vertices, triangles)",
    "a LabelMap": "see clrecon.read_labels and clrecon.LabelMap(voxels, affine)",
    "a PointCloud": "see clrecon.read_points and clrecon.PointCloud(points)",
    "a GhostSlices": "see clrecon.find_ghost_slices",
}

Given = ParamSpec("Given")
Made = TypeVar("Made")
Accepts = Callable[[Any], bool]


def _is_flag(value: Any) -> bool:
    return type(value).__name__ in ("bool", "bool_") or (isinstance(value, int) and value in (0, 1))


def _is_number(value: Any) -> bool:
    if isinstance(value, str | bytes) or getattr(value, "ndim", 0) != 0:
        return False
    try:
        return float(value) is not None
    except (TypeError, ValueError, OverflowError):
        return False


def _is_whole(value: Any) -> bool:
    try:
        return not isinstance(value, bool) and abs(operator.index(value)) < _LARGEST
    except TypeError:
        return False


def _is_sequence(value: Any) -> bool:
    if isinstance(value, str | bytes | dict | set):
        return False
    return hasattr(value, "__len__") and hasattr(value, "__getitem__") and _is_iterable(value)


def _is_iterable(value: Any) -> bool:
    return getattr(value, "__iter__", None) is not None and getattr(value, "ndim", 1) != 0


def _is_of_class(name: str, value: Any) -> bool:
    """Tell it by the names of the value's classes: the class itself may not be loaded."""
    return any(kind.__name__ == name and kind.__module__.startswith("clrecon") for kind in type(value).__mro__)


_KINDS: dict[str, tuple[str, Accepts]] = {
    "None": ("None", lambda value: value is None),
    "bool": ("True or False", _is_flag),
    "int": ("a whole number", _is_whole),
    "float": ("a number", _is_number),
    "str": ("a text", lambda value: isinstance(value, str)),
    "bytes": ("bytes", lambda value: isinstance(value, bytes | bytearray | memoryview)),
    "Path": ("a path", lambda value: hasattr(value, "__fspath__")),
    "os.PathLike": ("a path", lambda value: hasattr(value, "__fspath__")),
    "Progress": ("a function", callable),
    "Sequence": ("a sequence", _is_sequence),
    "Iterable": ("a sequence", _is_iterable),
    "Mapping": ("a mapping", lambda value: isinstance(value, Mapping)),
    **dict.fromkeys(_CHOICES, ("a text", lambda value: isinstance(value, str))),
    "Grid": ("a Volume", functools.partial(_is_of_class, "Grid")),
    "Bits": ("a Mask", functools.partial(_is_of_class, "Mask")),  # of `Mask` and what it is built on
    **{name: (f"a {name}", functools.partial(_is_of_class, name)) for name in _CLASSES},
}


def _read_kinds(annotation: Any) -> list[tuple[str, Accepts]] | None:
    """Return the kinds that an annotation allows; None where one of them is not known here."""
    if not isinstance(annotation, str):
        return None
    kinds = [_read_kind(*word.partition("[")[::2]) for word in _split_text(annotation, "|")]
    return None if None in kinds else cast("list[tuple[str, Accepts]]", kinds)


def _read_kind(name: str, inner: str) -> tuple[str, Accepts] | None:
    if name != "tuple":
        return _KINDS.get(name)
    count = 0 if "..." in inner else len(_split_text(inner[:-1], ","))
    return f"{count or 'some'} values", lambda value: _is_sequence(value) and count in (0, len(value))


def _split_text(text: str, separator: str) -> list[str]:
    """Split at the separators that stand in no brackets."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        if letter == separator and not depth:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def explains_arguments(function: Callable[Given, Made]) -> Callable[Given, Made]:
    """Turn the foreign error of a public function into a `UsageError` where an argument is not of the annotated kind.

    ``volume must be a Volume or a DeviceVolume, not ndarray`` in place of an AttributeError from deep within.
    """
    signature = inspect.signature(function)
    checked = {
        name: kinds
        for name, parameter in signature.parameters.items()
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        and (kinds := _read_kinds(parameter.annotation)) is not None
    }

    @functools.wraps(function)
    def call(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        try:
            return function(*args, **kwargs)
        except ClreconError:
            raise
        except Exception as error:
            try:
                given = signature.bind(*args, **kwargs).arguments
            except TypeError:  # an argument is missing or one too many: the error says so
                raise error from None
            for name, value in given.items():
                kinds = checked.get(name)
                if kinds is not None and not any(accepts(value) for _, accepts in kinds):
                    *others, last = dict.fromkeys(word for word, _ in kinds)
                    wanted = f"{', '.join(others)} or {last}" if others else last
                    maker = next((f": {_MAKERS[word]}" for word in (*others, last) if word in _MAKERS), "")
                    raise UsageError(f"{name} must be {wanted}, not {_name_value(value)}{maker}") from error
            raise

    return call


def number_or_nan(value: Any) -> float:
    """Return `value` as a float, NaN if it is not a number or has no float."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def array_or_empty(values: Any) -> NDArray[np.float64]:
    """Return `values` as an array of float64, an empty one where they hold anything else."""
    import numpy as np

    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


def as_numbers(name: str, values: Any) -> NDArray[np.float64]:
    """Return an argument as an array of float64; a `UsageError` with its name where it holds anything else."""
    import numpy as np

    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{name} must be numbers, not {_name_value(values)}") from None


def _name_value(value: Any) -> str:
    """Return a short value itself, of others the type."""
    if isinstance(value, int) and abs(value) >= _LARGEST:
        return f"one of {value.bit_length()} bits"
    if value is None or (isinstance(value, str | int | float | complex) and len(repr(value)) <= 40):
        return repr(value)
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__
