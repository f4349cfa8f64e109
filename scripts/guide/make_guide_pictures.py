#!/usr/bin/env python3
"""Make the pictures of the Guide again, from a phantom: those of the commands, and those of its gallery.

    python scripts/guide/make_guide_pictures.py [NAME...]

NAME: only those; default: all.  The commands stand in `PICTURES`; the gallery's are what its scripts write.
command-view.png is a screenshot, in a browser of 1000 x 640, of `clrecon view ct --html page.html --labels
ct/levels.nrrd`.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / "docs" / "images"
GALLERY = ROOT / "docs" / "guide" / "gallery"

SERIES = "phantom ct --levels T12-L4 --size 256 --spacing 0.8 0.8 1.0"
PICTURES = {
    "command-mesh": "mesh ct -o bone.stl; render bone.stl -o {} --view 35,15 --size 720x480 --letters",
    "command-cloud": "cloud ct -o bone.ply --hu 226 --spacing 1.5; render bone.ply -o {} --view 35,15 --size 720x480",
    "command-inside": "inside ct --labels ct/levels.nrrd --label L3 -o inside.stl --picture {}",
    "command-render": "render ct -o {} --preset spine --view 35,15 --size 720x480 --letters --scale-bar",
    "command-export": "export ct -o loin.nii.gz --between=-450,-390; "
    "render loin.nii.gz -o {} --mode slice --view sagittal",
    "command-vertebrae": "vertebrae ct -o spine.nii.gz --picture {}",
    "command-corridor": "corridor ct --labels ct/levels.nrrd --label L3 --picture {}",
    "command-stats": "render ct -o {} --mode slice --view sagittal --labels ct/levels.nrrd",
    "command-distance": "mesh ct -o fine.stl; mesh ct -o few.stl --decimate 0.9; "
    "distance few.stl fine.stl --picture {}",
    "command-phantom": "phantom skull --kind skull --size 200; render skull -o {} --view 35,10 --size 720x480",
    "command-demo": "demo demo; render demo/ct -o {} --view 25,10 --size 720x480",
    "print": "mesh ct -o print.3mf --for print --labels ct/levels.nrrd --label L3; "
    "mesh ct -o l3.stl --for print --labels ct/levels.nrrd --label L3; render l3.stl -o {} --view 60,35 --size 720x480",
    "labels": "mesh ct -o levels.glb --labels ct/levels.nrrd; "
    "render ct -o {} --mode surface --labels ct/levels.nrrd --view 60,15 --size 720x480",
}
"""Commands in a folder that holds the series `SERIES`; ``{}`` is the picture."""


def shrink(pictures: list[Path], name: str) -> None:
    """Write a picture of the Guide, of several two beside each other: 255 colours, a quarter of the bytes."""
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    from PIL import Image

    images = [Image.open(picture).convert("RGB") for picture in pictures]
    width, height = images[0].size
    columns = min(2, len(images))
    image = Image.new("RGB", (columns * width, (len(images) + 1) // 2 * height))
    for number, tile in enumerate(images):
        image.paste(tile, (number % columns * width, number // columns * height))
    image.thumbnail((900, 900))
    image.convert("P", palette=Image.Palette.ADAPTIVE, colors=255).save(IMAGES / f"{name}.png", optimize=True)


def run_commands(commands: str, picture: str) -> None:
    """Run commands in this folder, with what they say on the console."""
    for command in commands.split(";"):
        words = [picture if word == "{}" else word for word in command.split()]
        subprocess.run([sys.executable, "-m", "clrecon.cli.main", *words], check=True)


def main() -> None:
    """Make all pictures, or those named."""
    scripts = {f"gallery-{path.stem}": path for path in sorted(GALLERY.glob("*.py"))}
    names = sys.argv[1:] or [*PICTURES, *scripts]
    if unknown := set(names) - {*PICTURES, *scripts}:
        raise SystemExit(f"no picture is called {', '.join(sorted(unknown))}")
    with tempfile.TemporaryDirectory(prefix="clrecon-pictures-") as folder:
        os.chdir(folder)
        run_commands(SERIES, "")
        for name in names:
            print(f"== {name}", flush=True)
            if name in scripts:
                runpy.run_path(str(scripts[name]), run_name="__main__")
            else:
                run_commands(PICTURES[name], "picture.png")
            pictures = sorted(Path().glob("picture*.png"))
            shrink(pictures, name)
            for picture in pictures:
                picture.unlink()
        os.chdir(ROOT)


if __name__ == "__main__":
    main()
