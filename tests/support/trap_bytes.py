"""Rows of the trap matrix whose files hold bytes that no writer meant."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dicom_series import edit_value, element_bytes, insert_after
from trap_plan import BACKGROUND_HU, REFUSED, WARNED, Marks, Size, add_case, add_simple, plan_for, write_slices


def _spoiled(
    name: str, spoil: Callable[[Path], None], *words: str, last: bool = False, plan: Mapping[str, Any] | None = None
) -> None:
    """All files, or the last one, are spoiled behind their writer's back; `plan` is what its plan is changed in."""

    @add_case(name, REFUSED, words)
    def write(folder: Path, size: Size) -> Marks:
        marks = write_slices(folder, plan_for(size, **(plan or {})))
        for file in sorted(folder.iterdir())[-1 if last else 0 :]:
            spoil(file)
        return marks


def damage(file: Path, *, place: int, data: bytes) -> None:
    """Write over bytes of a file."""
    with open(file, "r+b") as stream:
        stream.seek(place)
        stream.write(data)


def _send_as_text(file: Path) -> None:
    """What a transfer in text mode makes of the pixels: each LF becomes CRLF."""
    data = file.read_bytes()
    start = data.index(b"\xe0\x7f\x10\0OW") + 12
    file.write_bytes(data[:start] + data[start:].replace(b"\n", b"\r\n"))


def add_byte_cases() -> None:
    """Put the rows into `CASES`."""
    _spoiled(
        "NUL for the minus sign of x",
        lambda file: edit_value(file, "ImagePositionPatient", lambda value: b"\0" + value[1:]),
        "ImagePositionPatient (0020,0032) is '\\x00",
    )
    _spoiled(
        "NUL for the minus sign of the intercept",
        lambda file: edit_value(file, "RescaleIntercept", lambda value: b"\0" + value[1:]),
        "RescaleIntercept (0028,1052) is '\\x00",
    )
    _spoiled(
        "PixelSpacing twice, with two values",
        lambda file: insert_after(file, "PixelSpacing", element_bytes("PixelSpacing", b"7\\7 ")),
        "PixelSpacing (0028,0030) is there twice, with two values",
    )
    add_simple(
        "Columns one less than there are",
        REFUSED,
        ("more pixels than the header says",),
        change=lambda ds, k: setattr(ds, "Columns", ds.Columns - 1),
    )
    add_simple(
        "zeros after the pixel data",
        WARNED,
        ("the rest is zeros, taken as padding",),
        harmless=True,
        change=lambda ds, k: setattr(ds, "PixelData", ds.PixelData + bytes(512)),
    )
    media: dict[str, Any] = {"last": True, "plan": {"name": "IM{:04d}".format}}
    _spoiled("the last slice empty, no suffix", lambda file: os.truncate(file, 0), "but empty", **media)
    _spoiled(
        "the last slice without the letters DICM, no suffix",
        lambda file: damage(file, place=128, data=b"DIXM"),
        "DICOM by its header, but without the mark at byte 128",
        **media,
    )
    _spoiled(
        "the last slice zeroed, no suffix",
        lambda file: damage(file, place=0, data=bytes(file.stat().st_size)),
        "named like slices, but blank",
        **media,
    )
    _spoiled("pixels sent as text", _send_as_text, "it was sent as text", plan={"intercept": BACKGROUND_HU - 10})
