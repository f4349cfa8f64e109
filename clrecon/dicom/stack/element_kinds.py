"""What it means that an element alternates from slice to slice: several volumes, one volume, or nothing by itself.

Two volumes half a gap apart make one even stack, but so does one volume whose scanner turns to and fro.  So in an even
stack only elements that are constant within a volume, for the reason given here, make phases.  Of all others the pixels
decide.  docs/geometry.md has the same table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["phases", "pixels", "nothing"]


@dataclass(frozen=True)
class ElementKind:
    """Elements that alternate for one reason.

    verdict: {"phases", "pixels", "nothing"}. What follows from an alternation in an even stack: phases; phases if the
        pixels show two volumes, else a doubt; or nothing, since one volume alternates in it.
    """

    verdict: Verdict
    reason: str
    tags: frozenset[int]


ELEMENT_KINDS = (
    ElementKind(
        "phases",
        "each pass over the patient has its own time",
        frozenset({
            0x00080020, 0x00080021, 0x00080022, 0x00080023, 0x0008002A, 0x00080030, 0x00080031, 0x00080032, 0x00080033,
            0x00181060,
        }),
    ),
    ElementKind(
        "phases",
        "the writer numbers or names acquisitions with it",
        frozenset({0x00080017, 0x00083010, 0x00200012, 0x00200100, 0x00209056, 0x00209128, 0x00209156}),
    ),
    ElementKind(
        "phases",
        "contrast medium is there or not in a whole pass",
        frozenset({
            0x00180010, 0x00180012, 0x00181040, 0x00181041, 0x00181042, 0x00181043, 0x00181044, 0x00181046, 0x00181047,
            0x00181048, 0x00181049,
        }),
    ),
    ElementKind(
        "phases",
        "voltage and filter are set for a whole pass",
        frozenset({0x00180060, 0x00181160, 0x00187050}),
    ),
    ElementKind(
        "phases",
        "one reconstruction is one volume",
        frozenset({0x00080008, 0x00082111, 0x00180050, 0x00181100, 0x00181210, 0x00189315}),
    ),
    ElementKind(
        "phases",
        "people and consoles describe whole volumes with it",
        frozenset({0x00080070, 0x00081010, 0x00081030, 0x0008103E, 0x00181030, 0x00204000, 0x00400254}),
    ),
    ElementKind("pixels", "it says how a slice is displayed", frozenset({0x00281050, 0x00281051, 0x00281055})),
    ElementKind("pixels", "its order is the writer's", frozenset({0x00200013})),
    ElementKind("pixels", "it says when a file was written", frozenset({0x00080012, 0x00080013})),
    ElementKind(
        "pixels",
        "the dose follows the patient",
        frozenset({
            0x00181150, 0x00181151, 0x00181152, 0x00181153, 0x00181170, 0x00189330, 0x00189332, 0x00189345,
        }),
    ),
    ElementKind(
        "nothing",
        "each turn of the gantry has its own: scanners turn to and fro",
        frozenset({0x00181140, 0x00189305}),
    ),
)  # fmt: skip
_VERDICTS = {tag: kind.verdict for kind in ELEMENT_KINDS for tag in kind.tags}


def find_verdict(tag: int, even: bool) -> Verdict:
    """Return what follows where an element alternates; `even`: the stack has equal gaps.

    In an uneven stack two volumes overlap in part, and any standard element that alternates there makes phases.
    Private elements, whose meaning is unknown, never do so alone: the number of the detector row is one of them.
    """
    known = _VERDICTS.get(tag)
    if even:
        return known or "pixels"
    if known == "nothing":
        return "pixels"
    return known or ("pixels" if tag >> 16 & 1 else "phases")
