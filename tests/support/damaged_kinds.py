"""Phantoms of kinds of scan whose headers or pixels are damaged, what is said of each, and the table of the page."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from made_once import make_once

from clrecon.proof.phantom import PhantomSettings, write_phantom

SLICES = {"jaw": 24, "longbone": 30, "hand": 64, "pair": 30, "hip": 64, "mouse": 40}
"""Slices in the middle of each kind: a part is as true as the whole; of the hip those without metal are at the ends."""


def make_scan(folder: Path, kind: str) -> tuple[Path, PhantomSettings]:
    """Write a part of the phantom of a kind, once for all tests."""
    settings = PhantomSettings(kind=kind, slices=SLICES[kind])
    return make_once(folder, f"scan-{kind}", lambda path: write_phantom(path, settings)), settings


def rescale(*, slope: float = 1.0, intercept: float = 0.0) -> Callable[[Any], None]:
    """Change what HU follow: they become `slope` times what they were, plus `intercept`."""

    def change(ds: Any) -> None:
        ds.RescaleIntercept = slope * float(ds.RescaleIntercept) + intercept
        ds.RescaleSlope = slope * float(ds.RescaleSlope)

    return change


def without_rescale(ds: Any) -> None:
    del ds.RescaleIntercept, ds.RescaleSlope


def without_unit(ds: Any) -> None:
    ds.RescaleType = "US"


def blank(ds: Any) -> None:
    ds.PixelData = bytes(len(ds.PixelData))


LOST, BLANK = "a slice in the middle is missing", "a slice in the middle is blank"
DAMAGES: dict[str, Callable[[Any], None]] = {
    "undamaged": lambda ds: None,
    "no slope and intercept": without_rescale,
    "intercept + 1024": rescale(intercept=1024.0),
    "intercept - 1024": rescale(intercept=-1024.0),
    "intercept + 400": rescale(intercept=400.0),
    "0.6 of the values + 400": rescale(slope=0.6, intercept=400.0),
    "half the values": rescale(slope=0.5),
    "RescaleType US": without_unit,
    LOST: lambda ds: None,
    BLANK: blank,
}

KNOWN, SCALE, BOTH, REFUSED, WARNED = "hu_known", "hu_scale", "hu_known, hu_scale", "refused", "warned"
SAID = {
    "undamaged": (SCALE, KNOWN, "", "", "", ""),
    "no slope and intercept": (KNOWN, KNOWN, BOTH, BOTH, BOTH, BOTH),
    "intercept + 1024": (SCALE, KNOWN, SCALE, SCALE, SCALE, SCALE),
    "intercept - 1024": (SCALE, KNOWN, SCALE, SCALE, SCALE, SCALE),
    "intercept + 400": (SCALE, KNOWN, SCALE, SCALE, SCALE, SCALE),
    "0.6 of the values + 400": (SCALE, KNOWN, SCALE, SCALE, SCALE, SCALE),
    "half the values": (SCALE, KNOWN, SCALE, SCALE, SCALE, SCALE),
    "RescaleType US": (KNOWN, KNOWN, KNOWN, KNOWN, KNOWN, KNOWN),
    LOST: (REFUSED,) * 6,
    BLANK: (f"{WARNED}, {SCALE}", f"{WARNED}, {KNOWN}", WARNED, WARNED, WARNED, WARNED),
}
"""What is said of each damage, by kind in the order of `SLICES`: failed gates, a warning, or a refusal."""


def damage(scan: Path, folder: Path, name: str) -> Path:
    """Write the slices of a scan with a damage."""
    import pydicom

    folder.mkdir()
    files = sorted(scan.glob("*.dcm"))
    for k, path in enumerate(files):
        middle = k == len(files) // 2
        if name == LOST or (name == BLANK and not middle):
            if not (name == LOST and middle):
                shutil.copy(path, folder)
            continue
        ds = pydicom.dcmread(path)
        DAMAGES[name](ds)
        ds.save_as(folder / path.name)
    return folder


def list_damages() -> str:
    """Return the table of the page."""
    lines = [f"| damage | {' | '.join(SLICES)} |", "|---|" + "---|" * len(SLICES)]
    named = {KNOWN: f"`{KNOWN}`", SCALE: f"`{SCALE}`"}
    for name, said in SAID.items():
        cells = [", ".join(named.get(word, word) for word in cell.split(", ")) for cell in said]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)
