#!/usr/bin/env python3
"""Measure the error of the default ray step: SSIM of each preset's pictures against pictures with a tenth of the step.

    python scripts/proof/measure_ray_steps.py CT_FOLDER [DEVICE]

Prints a line per preset, for the view from the front and for an oblique view.  Each view has two figures: the SSIM of
the whole picture (grey values of 8 bits), and that of its pixels without the background.  It needs scikit-image.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import clrecon  # noqa: E402
from clrecon.rendering.looks.presets import PRESETS  # noqa: E402

SIZE = (512, 512)
VIEWS = ("anterior", (30.0, 20.0))
FINER = 10.0


def compare(coarse: np.ndarray, fine: np.ndarray) -> tuple[float, float]:
    """SSIM of the luminance of two pictures (h, w, 4), uint8: of all pixels, and of those not black in both."""
    from skimage.metrics import structural_similarity

    grey = [np.rint(picture[..., :3] @ (0.2126, 0.7152, 0.0722)) for picture in (coarse, fine)]
    whole, local = structural_similarity(*grey, data_range=255.0, full=True)
    shown = (grey[0] > 0.0) | (grey[1] > 0.0)
    return float(whole), float(local[shown].mean()) if shown.any() else 1.0


def main() -> None:
    """Print the SSIM of every preset for volume rendering."""
    if len(sys.argv) not in (2, 3):
        raise SystemExit(__doc__)
    volume = clrecon.read_volume(sys.argv[1])
    step = 0.5 * min(volume.spacing)
    with clrecon.VolumeRenderer(volume, device=sys.argv[2] if len(sys.argv) == 3 else None) as renderer:
        for name, preset in PRESETS.items():
            if preset.mode != "dvr":
                continue
            found = []
            for view in VIEWS:
                pictures = [
                    renderer.render(preset=name, view=view, size=SIZE, ray_step=ray_step).image  # type: ignore[arg-type]
                    for ray_step in (step, step / FINER)
                ]
                found.append("{:.4f} whole {:.4f} shown".format(*compare(*pictures)))
            print(f"{name:10s} {'; '.join(found)}", flush=True)


if __name__ == "__main__":
    main()
