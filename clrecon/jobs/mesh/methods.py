"""Surfaces of a mesh job by methods other than the plain one, and the seeds that they grow from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from clrecon.jobs.mesh.growing import LABEL_SEED, is_label_seed
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device


def find_seeds(settings: MeshSettings, labels: LabelMap | None) -> list[Any] | None:
    """Return what the surfaces grow from, as `extract_isosurface` takes it; None where they are whole."""
    if settings.method_used != "i-mc":
        return None
    from clrecon.geometry import frame_from_lps

    seeds: list[Any] = []
    for seed in settings.grow_from or ("auto",):
        if isinstance(seed, str):
            seeds.append((labels, _label_of(seed)) if is_label_seed(seed) else seed)
        else:
            seeds.append((frame_from_lps(settings.space).T @ seed).tolist())
    return seeds


def _label_of(seed: str) -> str | int:
    """Return the name or the number of a label seed."""
    name = seed[len(LABEL_SEED) :].strip()
    return int(name) if name.isascii() and name.isdigit() else name


def extract_one(
    volume: Volume, level: Any, device: Device, settings: MeshSettings, labels: LabelMap | None, progress: Progress
) -> Mesh:
    """Extract one surface by a method other than the plain one; taking triangles away is another step."""
    from clrecon.operators.surface.extract import extract_isosurface
    from clrecon.operators.surface.methods import METHODS, extract_by_method

    if not METHODS[settings.method_used].on_device:
        return extract_by_method(volume, level, settings.method_used, closed=settings.closed)
    return extract_isosurface(
        volume, level, device=device, closed=settings.closed, topology=settings.topology,
        below=settings.below is not None, grow_from=find_seeds(settings, labels), vertex_rule=settings.vertex_rule,
        memory=settings.memory, progress=progress,
    )  # fmt: skip
