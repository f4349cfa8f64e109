"""A small volume for clouds of its points, and the command that makes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.cli.main import main

AFFINE = np.array([[0.8, 0.1, 0.0, -20.0], [-0.1, 0.8, 0.0, 30.0], [0.0, 0.0, 1.0, 100.0], [0.0, 0.0, 0.0, 1.0]])
BAND = "200,3000"
LARGE_BALL_LPS, SMALL_BALL_LPS = AFFINE[:3] @ (15, 16, 14, 1), AFFINE[:3] @ (34, 16, 26, 1)
"""Centres in mm; the surfaces at 200 HU have radii of 9.3 and 5.2 voxels, of 0.8 to 1 mm."""


def make_voxels() -> np.ndarray:
    """Two balls of 9 and 5 voxels, a plate without thickness below them, and lone voxels around."""
    k, j, i = np.indices((40, 44, 48))
    balls = [9.3 - np.sqrt((k - 14) ** 2 + (j - 16) ** 2 + (i - 15) ** 2)]
    balls.append(5.2 - np.sqrt((k - 26) ** 2 + (j - 16) ** 2 + (i - 34) ** 2))
    voxels = np.clip(np.rint(100.0 * np.max(balls, axis=0) + 200.0), -1000, 900).astype(np.int16)
    voxels[4:36, 38, 4:44] = 600
    for place in ((36, 5, 5), (2, 30, 44), (37, 30, 40)):
        voxels[place] = 700
    return voxels


def run_with_report(folder: Path, device: Any, source: Path, *options: str) -> dict[str, Any]:
    """Write out.npz and r.json into an empty folder; return the report."""
    files = ["-o", str(folder / "out.npz"), "--report", str(folder / "r.json")]
    assert main(["cloud", str(source), *files, "--device", str(device.index), *options]) == 0
    return dict(json.loads((folder / "r.json").read_text()))
