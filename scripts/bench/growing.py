"""Case of growing: parts of a surface that hang together with seeds, beside the ways to the same without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from measure import time_in_turns
from registry import Job, case


@case("growing", "surfaces grown from seeds (I-MC), against the whole (T-MC), T-MC with a choice after it, and cc3d")
def measure_growing(job: Job) -> dict[str, Any]:
    """Time meshes from the volume on the device to the mesh in memory, and components of cells from the inside mask.

    Meshes: I-MC with the largest parts ("auto"), and in phantoms with ``-vertebrae`` from the point of those parts that
    is nearest to the centre of each vertebra, which leaves out ribs and hollows; peers are T-MC, and T-MC whose
    components are then numbered on the device and chosen, as many as I-MC takes.  Components: all components of active
    cells, from bits on the device; peers are cc3d and scipy on the inside mask, and the flood of one seed on it by
    scikit-image and SimpleITK.  The time to make the mask is not counted on either side.
    """
    import numpy as np

    from clrecon.mesh import select_components
    from clrecon.operators.primitives.union_find import label_components
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.operators.surface.extract import SurfaceExtractor

    volume = job.input.volume()
    resident = DeviceVolume(volume, device=job.device)
    figures: dict[str, Any] = {"ratios": {}, "sides": {}}

    def compare(name: str, ours: Callable[[], Any], theirs: Callable[[], Any], rows: int) -> None:
        figures["sides"][name] = time_in_turns(ours, theirs, job.pairs, job.limit_s / rows)
        figures["ratios"][name] = figures["sides"][name]["ratio"]

    with SurfaceExtractor(resident) as extractor:
        grown = extractor.extract(job.hu, grow_from="auto")

        def choose_after() -> Any:
            mesh = extractor.extract(job.hu)
            labelled = label_components(job.device, mesh.triangles, mesh.vertex_count)
            return select_components(mesh, grown.report["growing"]["components_taken"], labelled=labelled)

        compare("t_mc", lambda: extractor.extract(job.hu, grow_from="auto"), lambda: extractor.extract(job.hu), 7)
        compare("t_mc_and_choice", lambda: extractor.extract(job.hu, grow_from="auto"), choose_after, 7)
        centres = job.input.vertebrae()
        if centres is not None and len(centres):
            seeds = _nearest(grown.vertices, centres)
            few = extractor.extract(job.hu, grow_from=seeds)
            figures["vertebrae"] = {"seeds": len(seeds), "cells": few.report["cells"], "triangles": few.triangle_count}
            compare(
                "t_mc-vertebrae", lambda: extractor.extract(job.hu, grow_from=seeds),
                lambda: extractor.extract(job.hu), 7,
            )  # fmt: skip
        compare(
            "golden_search", lambda: extractor.extract(job.hu),
            lambda: extractor.extract(job.hu, vertex_rule="golden-search"), 7,
        )  # fmt: skip

    own, voxels = _compare_components(job, resident, compare)
    return {
        **figures,
        "cells": grown.report["cells"],
        "growing": grown.report["growing"],
        "components": {"cells": own[0], "voxels": voxels},
        "triangles": grown.triangle_count,
        "kernel_seconds": dict(grown.report["kernel_seconds"]),
        "equal": bool(np.array_equal(own[1], grown.report["cells"]["active"])),
    }


def _compare_components(
    job: Job, resident: Any, compare: Callable[[str, Callable[[], Any], Callable[[], Any], int], None]
) -> tuple[tuple[int, int], int]:
    """Compare the components of all active cells; return their number and that of cells, and cc3d's of voxels."""
    import cc3d
    from scipy import ndimage

    from clrecon.geometry.iso_rule import choose_iso_rule
    from clrecon.opencl import Stopwatch
    from clrecon.operators.surface.growing import find_components
    from clrecon.operators.surface.marching_cubes import Classifier
    from clrecon.operators.surface.slabs import SampleGrid, Slab

    volume = resident.volume
    rule = choose_iso_rule(volume, job.hu)
    grid, watch = SampleGrid(volume, rule), Stopwatch()
    level = volume.voxels.dtype.type(rule.lowest_inside)
    slab = Slab(grid, 0, grid.shape[2])
    with watch.running(job.device):
        classified = Classifier(job.device, slab, (level,)).mark_rest(resident.whole(watch))
    mask = volume.voxels >= job.hu
    own = find_components(resident, grid, classified, watch)
    peers: dict[str, Callable[[], Any]] = {
        "cc3d_6": lambda: cc3d.connected_components(mask, connectivity=6, return_N=True)[1],
        "ndimage_6": lambda: ndimage.label(mask)[1],
        **_floods(mask),
    }
    for name, peer in peers.items():
        compare(name, lambda: find_components(resident, grid, classified, Stopwatch()), peer, 7)
    return own, int(peers["cc3d_6"]())


def _floods(mask: Any) -> dict[str, Callable[[], Any]]:
    """Floods from one voxel of the largest solid, by those programs that are there."""
    import cc3d
    import numpy as np

    numbers = cc3d.connected_components(mask, connectivity=6)
    largest = int(np.bincount(numbers[mask]).argmax())
    seed = tuple(int(n) for n in np.argwhere(numbers == largest)[0])
    found: dict[str, Callable[[], Any]] = {}
    try:
        from skimage.segmentation import flood

        found["skimage_flood"] = lambda: flood(mask, seed, connectivity=1)
    except ImportError:
        pass
    try:
        import SimpleITK as sitk

        image = sitk.GetImageFromArray(mask.astype(np.uint8))
        found["simpleitk_connected"] = lambda: sitk.ConnectedThreshold(image, [seed[::-1]], 1, 1)
    except ImportError:
        pass
    return found


def _nearest(vertices: Any, points: Any) -> Any:
    """Return the vertex nearest to each point."""
    from scipy.spatial import cKDTree

    return vertices[cKDTree(vertices).query(points)[1]]
