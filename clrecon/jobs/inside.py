"""The job that looks into vertebrae: a CT series and its labels in, meshes of the parts and their volumes out."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.jobs.outputs import MeshFiles, check_files, check_kept, check_outputs, name_outputs, refuse_files
from clrecon.jobs.run import DeviceOpening, Run, RunReport, trial_cube
from clrecon.jobs.settings import InsideSettings
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.log import get_logger
from clrecon.system.paths import extension_of

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.operators.vertebrae.inside import VertebraInside
    from clrecon.rendering import Rendering


COLORS = {
    "solid": (0.93, 0.88, 0.76),
    "dense": (0.93, 0.88, 0.76),
    "trabecular": (0.80, 0.42, 0.32),
    "canal": (0.25, 0.55, 0.90),
}

_FADED = {"solid": ("canal",), "dense": ("canal",), "trabecular": ("solid", "canal"), "canal": ("solid",)}
"""Parts that are seen faded beside each opaque one: those that it does not hide."""

_FADED_OPACITY = 0.15


def check_pictures(picture: str | Path, view: str) -> None:
    """Refuse pictures that cannot be made, before any work is done."""
    from clrecon.rendering.pictures.picture import check_image_path
    from clrecon.rendering.pictures.pillow import load_pillow
    from clrecon.rendering.views.directions import find_view, read_view

    load_pillow()
    check_image_path(picture)
    find_view(read_view(view))


def draw_parts(
    meshes: Mapping[str, Mesh], view: str, device: Device, memory: int | None = None
) -> dict[str, Rendering]:
    """Draw each part (by the names of `PARTS`) opaque, with others faded, all from one camera."""
    from clrecon.operators.rays.mesh_pictures import box_around, mesh_corners
    from clrecon.operators.rays.scene import ScenePictures
    from clrecon.rendering.pictures.object_looks import MeshLook
    from clrecon.rendering.views.camera import Camera
    from clrecon.rendering.views.directions import DEFAULT_SIZE, read_view

    camera = Camera.fit(box_around([mesh_corners(mesh) for mesh in meshes.values()]), read_view(view))
    pictures = {}
    for part, mesh in meshes.items():
        shown = [(mesh, MeshLook(COLORS[part]))]
        shown += [
            (meshes[other], MeshLook(COLORS[other], opacity=_FADED_OPACITY))
            for other in _FADED[part]
            if other in meshes
        ]
        with ScenePictures(shown, device=device, memory=memory) as scene:
            pictures[part] = scene.take(camera, DEFAULT_SIZE, "white")
    return pictures


log = get_logger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class InsideReport(RunReport):
    SCHEMA = "inside"

    vertebrae: list[dict[str, Any]]
    close_mm: float
    space: str
    unit: str = "mm"


def make_inside(source: str | Path, files: MeshFiles, settings: InsideSettings, **how: Any) -> InsideReport:
    """Read a CT series and its labels, look into vertebrae, and write the surfaces of their parts, a file each."""
    from clrecon.labels import file_suffixes
    from clrecon.operators.vertebrae.inside import PARTS
    from clrecon.operators.vertebrae.solid import CLOSE_MM

    with Run(settings, **how) as run:
        with run.keeping():
            _check_files(source, files, settings)
        run.progress("device", 0, 0)
        with DeviceOpening(settings.device, _try_masks) as opening:
            volume, labels = run.read_labelled(source)
            device = opening.wait()
        numbers = list(dict.fromkeys(labels.find(one) for one in settings.label))
        suffixes = list(file_suffixes({number: labels.name(number) for number in numbers}).values())
        several = len(suffixes) > 1
        if run.no_clobber:
            names = [name_part(suffix, part, several=several) for suffix, part in product(suffixes, PARTS)]
            refuse_files([*chain(*(name_outputs(path, names) for path in (files.output, files.picture) if path))])
        run.lap("read")
        items: list[_FoundVertebra] = []
        for number, suffix in zip(numbers, suffixes, strict=True):
            run.progress("inside", len(items), len(suffixes) if several else 0)
            inside = _look_inside(volume, labels, number, settings, device)
            items.append(_FoundVertebra(suffix, inside, inside.extract_meshes(memory=settings.memory)))
        run.lap("inside")
        if files.picture is not None:
            for order, item in enumerate(items):
                run.progress("render", order, len(items) if several else 0)
                item.pictures = draw_parts(item.meshes, settings.view, device, settings.memory)
            run.lap("render")
        vertebrae = [_write_vertebra(run, one, files, several=several) for one in items]
        run.lap("write")
        warnings = [
            f"{vertebra['name']}: {warning}" if several else warning
            for vertebra in vertebrae
            for warning in vertebra["warnings"]
        ]
        report = run.report(
            InsideReport,
            [*device.current.warnings, *warnings],
            volume,
            on=device.current,
            affine_ijk_to_lps_mm=volume.affine.tolist(),
            vertebrae=vertebrae,
            close_mm=settings.close_mm or CLOSE_MM,
            space=settings.space.lower(),
        )
        run.finish(report, files.report)
    log.info("%d vertebrae looked into, on %s in %.3f s", len(items), report.device, report.seconds["total"])
    return report


@dataclass
class _FoundVertebra:
    """One vertebra: its name in files, its parts, their surfaces and their pictures."""

    suffix: str
    inside: VertebraInside
    meshes: dict[str, Mesh]
    pictures: dict[str, Rendering] = field(default_factory=dict)


def _check_files(source: str | Path, files: MeshFiles, settings: InsideSettings) -> None:
    """Refuse outputs that cannot be written or would replace an input."""
    from clrecon.operators.vertebrae.inside import PARTS

    # names of several vertebrae are those of the label map, which is not read yet: their number stands for them
    first = [part if len(settings.label) == 1 else f"{len(settings.label)}_{part}" for part in PARTS]
    assert files.output is not None
    outputs = check_outputs(files.output, files.report, first)
    if files.picture is not None:
        check_pictures(files.picture, settings.view)
        outputs += [("the picture", path) for path in name_outputs(files.picture, first)]
        check_files(outputs)
    check_kept(outputs, source, settings.labels)


def _try_masks(device: Device) -> None:
    """Build the kernels by extracting the label of a small cube."""
    from clrecon.labels import LabelMap
    from clrecon.operators.surface.label_masks import extract_label_masks

    cube = trial_cube()
    extract_label_masks(LabelMap((cube.voxels >= 0).astype("uint8"), cube.affine), device=device)


def name_part(suffix: str, part: str, *, several: bool) -> str:
    """Return the name of a part in those of its files; of several vertebrae with that of its own."""
    return f"{suffix}_{part}" if several else part


def _look_inside(
    volume: Volume, labels: LabelMap, number: int, settings: InsideSettings, device: Device
) -> VertebraInside:
    from clrecon.operators.vertebrae.inside import vertebra_inside

    given = {name: getattr(settings, name) for name in ("dense", "close_mm") if getattr(settings, name) is not None}
    return vertebra_inside(
        volume, labels, number, settings.solid_from, surface=settings.surface, grow_mm=settings.grow_mm, device=device,
        memory=settings.memory, **given,
    )  # fmt: skip


def _write_vertebra(run: Run, vertebra: _FoundVertebra, files: MeshFiles, *, several: bool) -> dict[str, Any]:
    entry: dict[str, Any] = {**vertebra.inside.as_dict(), "name": vertebra.suffix, "pictures": []}
    assert files.output is not None
    names = [name_part(vertebra.suffix, part, several=several) for part in vertebra.meshes]
    paths = name_outputs(files.output, names, files.report)
    written = run.write_meshes(list(vertebra.meshes.values()), paths)
    entry["meshes"] = [
        {
            "part": part,
            "vertices": mesh.vertex_count,
            "triangles": mesh.triangle_count,
            "format": extension_of(path)[1:],
            "bytes": file.size,
        }
        for (part, mesh), path, file in zip(vertebra.meshes.items(), paths, written, strict=True)
    ]
    for part, drawn in vertebra.pictures.items():
        assert files.picture is not None
        (path,) = name_outputs(files.picture, [name_part(vertebra.suffix, part, several=several)])
        size = run.write_picture(path, drawn).size
        of_picture = {"part": part, "faded": list(_FADED[part]), "size": list(drawn.size)}
        entry["pictures"].append(of_picture | {"format": extension_of(path)[1:], "bytes": size})
        entry["warnings"] += drawn.report["warnings"]
    return entry
