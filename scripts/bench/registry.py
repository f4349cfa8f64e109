"""The list of cases.  A decorator adds a function to it:

    @case("components", "components of the surface on the device, against scipy and cc3d")
    def measure_components(job: Job) -> dict[str, Any]: ...

Every module beside this one is imported by `load_cases`, so keep imports at module level light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from inputs import BenchInput

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Job:
    """Input, device and limits of one run of a case.

    input: ``input.volume()`` in memory, ``input.ct_folder()`` as DICOM, ``input.arrays()`` as .npy files.
    hu: Iso value.
    pairs: Timed pairs of clrecon and peer.
    peer_threads: Threads of VTK's flying edges.
    limit_s: Start no further pair after so many seconds; for `clrecon.proof.timing.alternate`.
    pictures: Folder where cases that draw keep what both sides drew.
    """

    input: BenchInput
    hu: float
    pairs: int
    device: Any
    peer_threads: int
    limit_s: float
    pictures: Path | None = None


@dataclass(frozen=True)
class Case:
    """A function that measures, with its description in one line.

    The function returns a dict of plain JSON types.  Its ``"ratios"`` is a dict of name -> `spread` of the ratios
    peer / clrecon (over 1: clrecon is better): these are compared, plotted and tabulated.  Everything else is kept.
    """

    name: str
    description: str
    measure: Callable[[Job], dict[str, Any]]


CASES: dict[str, Case] = {}


def case(name: str, description: str) -> Callable[[Callable[[Job], dict[str, Any]]], Callable[[Job], dict[str, Any]]]:
    """Enter the decorated function into `CASES`."""

    def enter(measure: Callable[[Job], dict[str, Any]]) -> Callable[[Job], dict[str, Any]]:
        if name in CASES and CASES[name].measure.__module__ != measure.__module__:
            raise ValueError(f"there are two cases {name!r}: in {CASES[name].measure.__module__} and here")
        CASES[name] = Case(name, description, measure)
        return measure

    return enter


def load_cases() -> dict[str, Case]:
    """Import every module of this folder and return all cases by name."""
    for path in sorted(HERE.glob("*.py")):
        if path.stem not in ("bench", "child"):
            import_module(path.stem)
    return dict(sorted(CASES.items()))
