"""The methods that are compared, one table in the order of the page, and the settings of the comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.options import InputSettings, closed_option, hu_option, iso_preset_option, parse_hu
from clrecon.system.arguments import name_parameter
from clrecon.system.options import option

MESH = "mesh"
CLOUD = "cloud"
PICTURE = "picture"


@dataclass(frozen=True)
class Compared:
    """A method that is compared, by a `module` of others or clrecon, on the device or not: makes `MESH` or others."""

    name: str
    title: str
    what: str
    makes: str = MESH
    on_device: bool = True
    module: str = ""


COMPARED = {
    method.name: method
    for method in (
        Compared("t-mc", "T-MC", "marching cubes, every cell, shared vertices"),
        Compared("t-mc-soup", "T-MC, soup", "every cell, triangles welded afterwards (numpy)", on_device=False),
        Compared("skimage", "scikit-image", "marching cubes of scikit-image", on_device=False, module="skimage"),
        Compared("vtk-mc", "VTK MC", "vtkMarchingCubes", on_device=False, module="vtkmodules"),
        Compared("vtk-fe", "VTK FE", "vtkFlyingEdges3D", on_device=False, module="vtkmodules"),
        Compared("i-mc", "I-MC", "cells grown from the large parts, linear vertices"),
        Compared("i-mc-golden", "I-MC, golden", "the same, vertices at the golden section of their edge"),
        Compared("g-mc", "G-MC", "T-MC, then quadric collapse without a bound"),
        Compared("s-mc", "S-MC", "T-MC, then decimation within a bound, topology kept"),
        Compared("cortex", "Fitted", "T-MC, each vertex moved onto the bone, read from the HU across its wall"),
        Compared("cloud-surface", "Cloud surface", "closed surface around the points of the cloud"),
        Compared("cloud", "Cloud", "voxels at the border of those at the level and above, placed by the affine", CLOUD),
        Compared("rays", "Ray casting", "samples along rays, preset bone, with light", PICTURE),
        Compared("rays-cpu", "Ray casting, CPU", "the same in plain numpy", PICTURE, on_device=False),
    )
}


def choose_methods(names: Sequence[str], reference: str) -> tuple[Compared, ...]:
    """Return the methods that run, all if there are no names, in the order of the table, the reference among them."""
    for name in (*names, reference):
        if name not in COMPARED:
            raise UsageError(f"there is no method {name!r:.60} to compare: they are {', '.join(COMPARED)}")
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise UsageError(f"a method is named twice: {', '.join(doubled)}")
    if COMPARED[reference].makes != MESH:
        meshes = ", ".join(name for name, method in COMPARED.items() if method.makes == MESH)
        raise UsageError(
            f"{name_parameter('reference', reference)} makes no mesh to compare with: take one of {meshes}"
        )
    wanted = {*(names or COMPARED), reference}
    return tuple(method for name, method in COMPARED.items() if name in wanted)


_MOST_REPEATS = 100


def _parse_names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip().lower() for name in text.split(","))
    if not all(names):
        raise ValueError(f"{text!r} has an empty name: write methods with single commas between them")
    return names


_comparison_option = partial(option, group="comparison")


@dataclass(frozen=True)
class CompareSettings(InputSettings):
    """Settings of the compare job; the reference always runs, at one level, above which is inside."""

    methods: Sequence[str] = _comparison_option(
        "--methods M[,M...]", "methods to compare; see below (default: all)", default=(), parse=_parse_names, first=True
    )
    reference: str = _comparison_option(
        "--reference M", "method to compare with (default: t-mc)", default="t-mc", parse=str.lower
    )
    truth: str | Path | None = _comparison_option(
        "--truth FILE", "truth.json of a phantom: errors against its true surface are measured too", first=True
    )
    paper: bool = _comparison_option(
        "--paper",
        "also compare a picture of each method with the middle slice by SSIM and MSE, as a paper does, and controls"
        " that show how little these figures mean",
        first=True,
    )
    repeat: int = _comparison_option(
        "--repeat N", "warm runs of each method; the median counts (default: 3)", default=3, first=True
    )
    iso_value: float | None = hu_option(
        "iso value in HU, inside is N and above; auto: half way between bone and the tissue beside it, measured in the"
        " scan; half:BONE,TISSUE: half way between these two",
        "N|auto|half:B,T",
        group="level",
        parse=parse_hu,
        first=True,
    )
    preset: str | None = iso_preset_option()
    half_way: str | Sequence[float] | None = None
    closed: bool = closed_option()

    def __post_init__(self) -> None:
        super().__post_init__()
        choose_methods(self.methods, self.reference)
        if not 1 <= self.repeat <= _MOST_REPEATS:
            raise UsageError(f"the number of warm runs lies between 1 and {_MOST_REPEATS}, not at {self.repeat}")
        if isinstance(self.iso_value, Sequence):
            raise UsageError("methods are compared at one iso value: give one number of HU, and no range")
        if len(self.as_mesh().levels) != 1:
            raise UsageError("methods are compared at one iso value")

    def as_mesh(self) -> MeshSettings:
        """Return the settings of a mesh job with the same input and level."""
        shared = {field.name: getattr(self, field.name) for field in fields(InputSettings)}
        return MeshSettings(
            **shared, iso_value=self.iso_value, preset=self.preset, half_way=self.half_way, closed=self.closed
        )
