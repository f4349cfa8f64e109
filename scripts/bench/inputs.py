"""Inputs of cases: synthetic volumes by name, or CT folders.

| name       | what                                                                    |
|------------|-------------------------------------------------------------------------|
| spineN     | spine phantom, 512 x 512 x N, 0.7 x 0.7 x 1 mm, with noise              |
| cleanN     | the same without noise                                                  |
| tiesN      | the same in steps of 32 HU: many voxels hold the iso value itself       |
| thickN     | the same with slices of 4 mm, 512 x 512 x N                             |
| cubeN      | sphere in N x N x N voxels: small ones show what launches cost          |
| noiseN     | white noise in N x N x N voxels: the densest surface that there is      |
| NAME=PATH  | CT folder, called NAME in the results; without NAME= the folder's name  |

Phantoms are made once and kept in the work folder.
"""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_MADE_UP = re.compile(r"(spine|clean|ties|thick|cube|noise)(\d+)")
_SIZE = 512


@dataclass(frozen=True)
class BenchInput:
    """A named input; `folder` is None for a synthetic one."""

    name: str
    work: Path
    folder: Path | None = None

    def arrays(self) -> tuple[Path, Path]:
        """Return the paths of voxels (nk, nj, ni) and affine (4, 4) as .npy; missing files are made."""
        self.work.mkdir(mode=0o700, parents=True, exist_ok=True)
        voxels, affine = self.work / f"{self.name}-voxels.npy", self.work / f"{self.name}-affine.npy"
        if self.folder is not None or not (voxels.is_file() and affine.is_file()):
            volume = self._make()
            _save(affine, volume.affine)
            _save(voxels, volume.voxels)
        return voxels, affine

    def volume(self) -> Any:
        """The input as `clrecon.Volume` in memory."""
        from clrecon.geometry import Volume

        if self.folder is not None:
            return self._make()
        voxels, affine = self.arrays()
        return Volume(np.load(voxels), np.load(affine))

    def vertebrae(self) -> Any:
        """The centres of the vertebrae that lie in a phantom, shape (n, 3), LPS mm; None for other inputs."""
        settings = _phantom_settings(self.name) if self.folder is None else None
        if settings is None:
            return None
        kept = self.work / f"{self.name}-vertebrae.npy"
        if not kept.is_file():
            from clrecon.proof.phantom import make_phantom

            self.work.mkdir(mode=0o700, parents=True, exist_ok=True)
            known = make_phantom(settings)[2]["spine"]["vertebrae"]
            _save(kept, np.array([each["center_lps_mm"] for each in known if each["inside"]]).reshape(-1, 3))
        return np.load(kept)

    def ct_folder(self) -> Path:
        """The input as a folder of CT slices."""
        from clrecon.errors import UsageError

        if self.folder is not None:
            return self.folder
        settings = _phantom_settings(self.name)
        if settings is None or self.name.startswith("ties"):
            raise UsageError(f"input {self.name} is no CT series: use spineN or a CT folder for this case")
        folder = self.work / f"{self.name}-ct"
        if not (folder / "truth.json").is_file():
            from clrecon.proof.phantom import write_phantom

            print(f"making {self.name} as CT series ...", file=sys.stderr)
            self.work.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_phantom(folder, settings)
        return folder

    def _make(self) -> Any:
        from clrecon.geometry import Volume

        if self.folder is not None:
            from clrecon.reading import read_volume

            return read_volume(self.folder)
        print(f"making {self.name} ...", file=sys.stderr)
        kind, number = _split(self.name)
        settings = _phantom_settings(self.name)
        if settings is not None:
            from clrecon.proof.phantom import make_phantom

            voxels, affine, _ = make_phantom(settings)
            return Volume(voxels // 32 * 32 + 2 if kind == "ties" else voxels, affine)
        affine = np.diag((0.7, 0.5, 2.5, 1.0))
        if kind == "noise":
            noise = np.random.default_rng(0).normal(226.0, 100.0, (number, number, number))
            return Volume(np.rint(noise).astype(np.int16), affine)
        axis = np.arange(number) - (number - 1) / 2
        distance = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
        return Volume(np.rint(226 + 300 * (number * 0.35 - distance)).clip(-1000, 1500).astype(np.int16), affine)


def _save(path: Path, array: Any) -> None:
    """Save under another name first, so that an interrupted run leaves no incomplete array."""
    half = path.with_name(f"half-{os.getpid()}-{path.name}")
    np.save(half, array)
    half.replace(path)


def _split(name: str) -> tuple[str, int]:
    match = _MADE_UP.fullmatch(name)
    assert match is not None, name
    return match[1], int(match[2])


def _phantom_settings(name: str) -> Any:
    """Return the settings of the spine phantom of a name; None for other inputs."""
    from clrecon.proof.phantom import PhantomSettings

    kind, slices = _split(name)
    if kind not in ("spine", "clean", "ties", "thick"):
        return None
    return PhantomSettings(
        kind="spine",
        size=(_SIZE, _SIZE),
        slices=slices,
        spacing=(0.7, 0.7, 4.0 if kind == "thick" else 1.0),
        noise=0.0 if kind == "clean" else None,  # type: ignore[arg-type]  # None: the phantom's own
    )


def parse_input(text: str, work: Path) -> BenchInput:
    """Read one ``--input``."""
    from clrecon.errors import UsageError

    if _MADE_UP.fullmatch(text):
        return BenchInput(text, work)
    name, _, path = text.rpartition("=")
    folder = Path(path).expanduser()
    if not folder.is_dir():
        raise UsageError(f"input {text!r} is neither a made-up one (spine149, cube64, ...) nor a folder")
    name = re.sub(r"[^\w.]+", "_", name or folder.resolve().name)
    return BenchInput(name, work, folder)
