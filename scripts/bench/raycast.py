"""Cases of pictures, beside VTK's volume mappers with the same camera, transfer function, light and ray step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from measure import Costs, alternate, medians, spread, summarise
from registry import Job, case

SIZE = (1024, 1024)
ZOOM = 1.0
"""Zoom of all pictures, the default of `Camera.fit`."""
VIEW_ANGLE = 30.0
GPU_PAIRS = 3
"""Number of pairs with frames of ten seconds and more."""
TIMED = {
    "clrecon": "VolumeRenderer.render: from the call to a picture (RGBA and depths) in the computer's memory",
    "fixed-point": "PerImageInitialization, PerVolumeInitialization, PerSubVolumeInitialization and RenderSubVolume"
    " of the mapper: to a picture (RGBA) in its memory; no texture, no window, no file",
    "gpu": "vtkRenderWindow.Render and WaitForCompletion off screen: to a picture in OpenGL's memory; no file",
    "first frame": "the same with everything made anew from voxels in memory: image and mapper, or VolumeRenderer;"
    " kernels are built, the OpenGL context is there",
}


@dataclass(frozen=True)
class Shot:
    """A named camera, with everything that both sides draw with."""

    name: str
    camera: Any
    function: Any
    lighting: Any
    ray_step: float

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `VolumeRenderer.render`."""
        return {
            "transfer_function": self.function,
            "camera": self.camera,
            "size": SIZE,
            "ray_step": self.ray_step,
            "lighting": self.lighting,
            "background": "black",
        }

    def scene(self, volume: Any) -> Any:
        """The same as a scene for VTK."""
        from peers.vtk_stage import scene_of

        return scene_of(volume, self.camera, self.function, self.lighting, size=SIZE, ray_step=self.ray_step)


def make_shots(volume: Any) -> list[Shot]:
    """Make two shots from the front, parallel and perspective: preset bone, half the smallest spacing, shaded."""
    from clrecon.rendering.looks.presets import find_preset
    from clrecon.rendering.views.camera import Camera

    preset, step = find_preset("bone"), 0.5 * min(volume.spacing)
    lighting = replace(preset.lighting, soft_gradient=0.0)  # as VTK's

    def fit(angle: float | None) -> Any:
        return Camera.fit(volume, "anterior", ZOOM, view_angle=angle, size=SIZE)

    return [
        Shot(name, fit(angle), preset.transfer_function, lighting, step)
        for name, angle in (("parallel", None), ("perspective", VIEW_ANGLE))
    ]


class OwnSide:
    """Runs of clrecon."""

    def __init__(self, draw: Callable[[], Any]):
        self._draw = draw
        self.costs = Costs()
        self.parts: list[dict[str, float]] = []
        self.picture: Any = None

    def run(self) -> float:
        """Seconds of one picture."""
        start = time.perf_counter()
        made = self.costs.measure(self._draw)
        seconds = time.perf_counter() - start
        self.parts.append(made.report.get("seconds", {}))
        self.picture = made
        return seconds

    def describe(self) -> dict[str, Any]:
        """Medians over all runs but the first, which warms up."""
        return {"seconds_by_part": medians(self.parts[1:]), "cost": self.costs.describe()}


class PeerSide:
    """Runs of a mapper of VTK."""

    def __init__(self, draw: Callable[[], float], **facts: Any):
        self._draw = draw
        self._facts = facts
        self.costs = Costs()

    def run(self) -> float:
        """Draw one picture; returns its seconds as the peer counts them."""
        return float(self.costs.measure(self._draw))

    def describe(self) -> dict[str, Any]:
        """Describe the peer and the costs of its runs."""
        return {**self._facts, "cost": self.costs.describe()}


def compare(own: OwnSide, peer: PeerSide, pairs: int, limit_s: float) -> dict[str, Any]:
    """Time both sides in turn."""
    ours, theirs = alternate(own.run, peer.run, pairs, limit_s=limit_s)
    rays = SIZE[0] * SIZE[1]
    summary = summarise(ours, theirs)
    return {
        **summary,
        "mrays_per_s": 1e-6 * rays / summary["clrecon_s"]["median"],
        "clrecon": own.describe(),
        "peer": peer.describe(),
        "ours": ours,
        "theirs": theirs,
    }


def likeness(ours: Any, theirs: Any) -> float:
    """SSIM of the luminance (8 bits) of two pictures before black, (h, w, 3 or 4) uint8."""
    import numpy as np
    from skimage.metrics import structural_similarity

    grey = [np.rint(np.asarray(each)[..., :3] @ (0.2126, 0.7152, 0.0722)) for each in (ours, theirs)]
    return float(structural_similarity(*grey, data_range=255.0))


def keep_pictures(folder: Path | None, name: str, **pictures: Any) -> None:
    """Write pictures as NAME-SIDE.png if a folder is given."""
    if folder is None:
        return
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for side, picture in pictures.items():
        Image.fromarray(picture[..., :3]).save(folder / f"{name}-{side}.png")


def measure_likeness(job: Job, volume: Any, renderer: Any, shot: Shot, peer: Any) -> dict[str, float]:
    """SSIM against the last picture of a peer, of the whole volume and of the part that VTK sees as well.

    VTK's rays end at the centres of the outermost voxels, clrecon's half a voxel further on.
    """
    import numpy as np

    from clrecon.rendering.views.clip import Clip

    inner = volume.ijk_to_lps([(0, 0, 0), np.array(volume.shape_ijk) - 1.0])
    whole = renderer.render(**shot.options()).image
    clipped = renderer.render(**shot.options(), clip=Clip.box(inner.min(axis=0), inner.max(axis=0))).image
    theirs = peer.picture()
    kind = "gpu" if peer.name.startswith("vtkOpenGL") else "fixed_point"
    keep_pictures(job.pictures, f"raycast-{job.input.name}-{shot.name}", **{"clrecon": clipped, kind: theirs})
    return {"same_box": likeness(clipped, theirs), "whole_volume": likeness(whole, theirs)}


@case("raycast-warm", "a further picture of a volume on the device, against VTK's fixed-point mapper with all cores")
def measure_warm(job: Job) -> dict[str, Any]:
    """Time warm pictures, parallel and in perspective, and the cost of another transfer function."""
    from peers.vtk_fixed_point import FixedPointPeer

    import clrecon

    volume = job.input.volume()
    shots = make_shots(volume)
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "ssim": {}, **describe_pictures(shots)}
    with clrecon.VolumeRenderer(volume, device=job.device) as renderer:
        for shot in shots:
            peer = FixedPointPeer(volume.voxels, shot.scene(volume), job.peer_threads)
            peer.first_frame()
            own = OwnSide(lambda shot=shot: renderer.render(**shot.options()))  # type: ignore[misc]
            theirs = PeerSide(peer.frame, name=peer.name, version=peer.version, threads=peer.threads)
            figures["sides"][shot.name] = compare(own, theirs, job.pairs, job.limit_s / len(shots))
            figures["ratios"][shot.name] = figures["sides"][shot.name]["ratio"]
            figures["ssim"][shot.name] = measure_likeness(job, volume, renderer, shot, peer)
        figures["transfer_change"] = measure_change(renderer, shots[0], job.pairs)
    return figures


def measure_change(renderer: Any, shot: Shot, pairs: int) -> dict[str, Any]:
    """Measure the additional time of a frame with another transfer function: seconds, and per cent of a frame.

    The functions differ by a thousandth of a HU, so that their pictures cost the same.  The time of the longest kernel,
    which casts the rays, is left out: its variation would hide the rest.
    """
    number = 0

    def draw(changed: bool) -> tuple[float, float]:
        nonlocal number
        number += changed
        options = {**shot.options(), "transfer_function": shot.function.shifted(1e-3 * number)}
        start = time.perf_counter()
        made = renderer.render(**options)
        seconds = time.perf_counter() - start
        return seconds, seconds - max(made.report["kernel_seconds"].values(), default=0.0)

    draw(False)
    frames = [(draw(False), draw(True)) for _ in range(max(pairs, 7))]
    (same, same_beside), (changed, changed_beside) = (zip(*side, strict=True) for side in zip(*frames, strict=True))
    more = [after - before for before, after in zip(same_beside, changed_beside, strict=True)]
    share = 100.0 * spread(more)["median"] / spread(same)["median"]
    return {"same_s": spread(same), "changed_s": spread(changed), "more_s": spread(more), "percent_of_frame": share}


@case("raycast-first", "the first picture of a volume in memory, bricks included, against the fixed-point mapper")
def measure_first(job: Job) -> dict[str, Any]:
    """Time first pictures: each pair has a new renderer and a new mapper; the kernels are already built."""
    from peers.vtk_fixed_point import FixedPointPeer

    import clrecon

    volume = job.input.volume()
    shots = make_shots(volume)
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, **describe_pictures(shots)}
    for shot in shots:

        def draw(shot: Shot = shot) -> Any:
            with clrecon.VolumeRenderer(volume, device=job.device) as renderer:
                return renderer.render(**shot.options())

        peer = FixedPointPeer(volume.voxels, shot.scene(volume), job.peer_threads)
        theirs = PeerSide(peer.first_frame, name=peer.name, version=peer.version, threads=peer.threads)
        figures["sides"][shot.name] = compare(OwnSide(draw), theirs, job.pairs, job.limit_s / len(shots))
        figures["ratios"][shot.name] = figures["sides"][shot.name]["ratio"]
    return figures


@case("raycast-gpu-mapper", "a further picture against VTK's GPU mapper on the OpenGL that is there (Mesa's llvmpipe)")
def measure_gpu_mapper(job: Job) -> dict[str, Any]:
    """Time pictures beside VTK's OpenGL mapper, whose process waits while clrecon draws."""
    from peers.vtk_gpu import GpuPeer

    import clrecon

    volume = job.input.volume()
    shots = make_shots(volume)
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "ssim": {}, **describe_pictures(shots)}
    with clrecon.VolumeRenderer(volume, device=job.device) as renderer:
        for shot in shots:
            with GpuPeer(volume.voxels, shot.scene(volume)) as peer:
                first = peer.first_frame()
                own = OwnSide(lambda shot=shot: renderer.render(**shot.options()))  # type: ignore[misc]
                theirs = PeerSide(peer.frame, name=peer.name, version=peer.version, renderer=peer.renderer)
                own.run()
                found = compare(own, theirs, min(job.pairs, GPU_PAIRS), job.limit_s / len(shots))
                figures["sides"][shot.name] = {**found, "peer_first_s": first}
                figures["ratios"][shot.name] = found["ratio"]
                figures["ssim"][shot.name] = measure_likeness(job, volume, renderer, shot, peer)
    return figures


def describe_pictures(shots: list[Shot]) -> dict[str, Any]:
    """Describe what was drawn and timed."""
    return {
        "size": SIZE,
        "ray_step_mm": shots[0].ray_step,
        "transfer_function": shots[0].function.points.tolist(),
        "unit_distance_mm": shots[0].function.unit_distance,
        "shaded": True,
        "timed": TIMED,
    }
