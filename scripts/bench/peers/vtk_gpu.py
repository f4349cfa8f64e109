"""The peer of pictures on OpenGL: vtkOpenGLGPUVolumeRayCastMapper, in a process of its own.

It draws on whatever OpenGL the machine has (Mesa's llvmpipe where there is no GPU) into an off-screen window.  A
context that cannot be made, or that dies, ends only that process.  The process is ``python -m peers.vtk_gpu FOLDER``;
it answers each line of its input with one of JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from peers.vtk_stage import Scene, Stage, vtk_version


class GpuPeer:
    """vtkOpenGLGPUVolumeRayCastMapper in a process of its own; a context manager.

    renderer: Name of the renderer as OpenGL reports it.
    """

    name = "vtkOpenGLGPUVolumeRayCastMapper"

    def __init__(self, voxels: NDArray[Any], scene: Scene):
        self._folder = tempfile.TemporaryDirectory(prefix="clrecon-peer-")
        folder = Path(self._folder.name)
        np.save(folder / "voxels.npy", voxels)
        (folder / "scene.json").write_text(json.dumps(asdict(scene)), encoding="utf-8")
        self._errors = (folder / "errors.txt").open("w+")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "peers.vtk_gpu", str(folder)],
            cwd=Path(__file__).resolve().parents[1],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        try:
            found = self._ask("open")
        except RuntimeError:
            self.close()
            raise
        self.renderer, self.version = str(found["renderer"]), str(found["version"])

    def __enter__(self) -> GpuPeer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def first_frame(self) -> float:
        """Seconds of the first picture of a volume in memory: upload, shader and picture; the context is ready."""
        return float(self._ask("first")["seconds"])

    def frame(self) -> float:
        """Seconds of a further picture, until OpenGL has finished it."""
        return float(self._ask("frame")["seconds"])

    def picture(self) -> NDArray[np.uint8]:
        """The last picture on black, shape (h, w, 3), uint8; row 0 is the top."""
        self._ask("picture")
        return np.asarray(np.load(Path(self._folder.name) / "picture.npy"), dtype=np.uint8)

    def close(self) -> None:
        """End the process."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()
        self._folder.cleanup()

    def _ask(self, what: str) -> dict[str, Any]:
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(what + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self._errors.seek(0)
            raise RuntimeError(f"{self.name}: its process died: {self._errors.read().strip()[-500:]}")
        return dict(json.loads(answer))


def serve(folder: Path) -> None:
    """Answer the lines of standard input until it ends; see `GpuPeer`."""
    import vtkmodules.vtkRenderingOpenGL2  # noqa: F401
    import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401

    voxels = np.load(folder / "voxels.npy")
    stage = Stage(Scene(**json.loads((folder / "scene.json").read_text(encoding="utf-8"))))
    for line in sys.stdin:
        answer: dict[str, Any] = {}
        what = line.strip()
        if what == "open":
            stage.window.Render()
            answer = {"renderer": _renderer_name(stage.window.ReportCapabilities()), "version": vtk_version()}
        elif what in ("first", "frame"):
            answer = {"seconds": _draw(stage, voxels if what == "first" else None)}
        elif what == "picture":
            np.save(folder / "picture.npy", _grab(stage.window))
        print(json.dumps(answer), flush=True)


def _renderer_name(capabilities: str) -> str:
    lines = [line for line in capabilities.splitlines() if "renderer string" in line]
    return lines[0].split(":", 1)[1].strip() if lines else "unknown"


def _draw(stage: Stage, voxels: NDArray[Any] | None) -> float:
    from vtkmodules.vtkRenderingVolumeOpenGL2 import vtkOpenGLGPUVolumeRayCastMapper

    start = perf_counter()
    if voxels is not None:
        mapper = vtkOpenGLGPUVolumeRayCastMapper()
        mapper.SetUseJittering(0)
        stage.load(voxels, mapper)
    stage.window.Render()
    stage.window.WaitForCompletion()
    return perf_counter() - start


def _grab(window: Any) -> NDArray[np.uint8]:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    capture = vtkWindowToImageFilter()
    capture.SetInput(window)
    capture.SetInputBufferTypeToRGB()
    capture.ReadFrontBufferOff()
    capture.ShouldRerenderOff()
    capture.Update()
    image = capture.GetOutput()
    columns, rows, _ = image.GetDimensions()
    return np.ascontiguousarray(vtk_to_numpy(image.GetPointData().GetScalars()).reshape(rows, columns, 3)[::-1])


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
