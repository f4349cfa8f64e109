"""Numbers that tell of missing slices although the positions of the others leave no hole.

A stack without its ends, or without every second slice, is as evenly spaced as a whole one.  Its headers may tell:
InstanceNumber leaves out numbers or begins late, and ImagesInAcquisition or NumberOfSeriesRelatedInstances count more
than there is.  Numbers alone prove nothing, because writers are free to number in steps, from 0, downwards, or from
where another series ended.  So a step of numbers counts only where the positions or the thickness agree with it, or
where no thickness contradicts it and the gaps are wide.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.reading.dicom.headers.slice_header import OtherImage, SliceHeader
from clrecon.reading.dicom.stack.fit import Stack, median, median_thickness
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.records import Gate, none_of, unmeasured

LOCALIZERS = 3
"""So many numbers before the first slice may be those of localizers in a series of their own."""
WIDER = 1.05
"""Where numbers go up in steps, a gap over this many thicknesses means that the slices between are missing: scanners
make slices that touch or overlap.  With a gap of one thickness, numbers in steps are only odd."""
CLOSEST = 0.25
"""Least distance in thicknesses that the slices between would have: numbers in larger steps are only odd.  Where no
thickness is stated, the slices between would lie at least a pixel apart, and the steps are at most 1 / `CLOSEST`."""
_PROPORTIONAL = 0.05
"""Largest relative difference of the distances for one number where positions follow the numbers."""


@dataclass(frozen=True)
class Census:
    """Numbers and counts in the files of one SeriesInstanceUID, localizers and all phases included.

    numbers: InstanceNumber of its images.
    stated_images, stated_files: ImagesInAcquisition and NumberOfSeriesRelatedInstances, the largest value of each.
    ends_before: Last numbers of the other series of the study, from where this one may be numbered on.
    """

    numbers: frozenset[int] = frozenset()
    images: int = 0
    files: int = 0
    stated_images: int | None = None
    stated_files: int | None = None
    ends_before: frozenset[int] = frozenset()


def take_census(
    slices: Mapping[str, Sequence[SliceHeader]], others: Mapping[str, Sequence[OtherImage]]
) -> dict[str, Census]:
    censuses: dict[str, Census] = {}
    studies: dict[str, list[str]] = defaultdict(list)
    for key in {**slices, **others}:
        own_slices, beside = slices.get(key, ()), others.get(key, ())
        studies[(own_slices or beside)[0].series.study].append(key)
        censuses[key] = Census(
            frozenset(header.instance_number for header in own_slices if header.instance_number is not None),
            len(own_slices) + sum(image.frames for image in beside),
            len({header.file for header in own_slices}) + len(beside),
            max((header.stated_images for header in own_slices if header.stated_images is not None), default=None),
            max((header.stated_files for header in own_slices if header.stated_files is not None), default=None),
        )
    for keys in studies.values():
        ends = {key: max(censuses[key].numbers, default=0) for key in keys}
        shared: dict[int | None, int] = defaultdict(int)
        for key in keys:
            shared[censuses[key].stated_images] += censuses[key].images
        for key in keys:
            before = frozenset(end for other, end in ends.items() if other != key)
            stated = censuses[key].stated_images
            accounted = stated is not None and shared[stated] == stated  # an acquisition reconstructed several times
            censuses[key] = replace(censuses[key], ends_before=before, stated_images=None if accounted else stated)
    return censuses


def judge_numbers(census: Census, stack: Stack, copies: int) -> Gate:
    """Judge the gate ``complete_series`` of the slices that are or would be read; `copies` of its images are copies."""
    words = "slices missing according to the numbers and counts in the headers"
    numbers = _ordered_numbers(stack)
    if numbers is None and census.stated_images is None and census.stated_files is None:
        return unmeasured("complete_series", 0, None, f"{words}: no count, and no numbers in the order of the slices")
    absences = [] if numbers is None else [_judge_steps(census, stack, numbers), _judge_start(census, numbers)]
    for keyword, stated, there in (
        ("ImagesInAcquisition", census.stated_images, census.images),
        ("NumberOfSeriesRelatedInstances", census.stated_files, census.files),
    ):
        if stated is not None:
            there -= copies if there > stated else 0  # else the copies may be among those that were counted
            absent = max(stated - there, 0)
            absences.append((absent, f"{keyword} says {stated}, there {'is' if there == 1 else 'are'} {there}"))
    reasons = [(count, text) for count, text in absences if count]
    shown = f" ({'; '.join(text for _, text in reasons)})" if reasons else ""
    return none_of("complete_series", max((count for count, _ in reasons), default=0), words + shown)


def facts_of_numbers(census: Census, stack: Stack) -> dict[str, Any]:
    """Return the numbers and counts for the certificate, None where the files do not tell."""
    numbers = _ordered_numbers(stack)
    first = last = step = None
    if numbers is not None:
        first, last = int(numbers.min()), int(numbers.max())
        step = int(np.abs(np.diff(numbers)).min())
    return {
        "first": first,
        "last": last,
        "step": step,
        "images": census.images,
        "images_stated": census.stated_images,
        "files": census.files,
        "files_stated": census.stated_files,
    }


def _ordered_numbers(stack: Stack) -> NDArray[np.int64] | None:
    """Return InstanceNumber along the stack; None unless all slices have one and they rise, or fall, all along."""
    known = [header.instance_number for header in stack.slices if header.instance_number is not None]
    if len(known) < max(len(stack.slices), 2):
        return None
    numbers = np.array(known, dtype=np.int64)
    steps = np.diff(numbers)
    return numbers if (steps > 0).all() or (steps < 0).all() else None


def _judge_steps(census: Census, stack: Stack, numbers: NDArray[np.int64]) -> tuple[int, str]:
    """Return how many slices are missing between the others by their numbers, and why."""
    steps = np.abs(np.diff(numbers))
    unit = int(np.gcd.reduce(steps))
    gaps = np.diff(stack.distances_mm)
    if (steps == unit).all():
        thickness = median_thickness(stack.slices)
        gap = stack.line.gap_median_mm or median(gaps)  # where positions are rounded, not that of the numbers
        if thickness is None:
            touches = unit * CLOSEST > 1.0 or gap < unit * max(stack.slices[0].di_mm, stack.slices[0].dj_mm)
            why = f"step {unit}, slices lie {gap:.4g} mm apart, and no SliceThickness says that none is between them"
        else:
            touches = gap <= WIDER * thickness or gap < unit * CLOSEST * thickness
            why = f"step {unit}, and slices of {thickness:g} mm lie {gap:.4g} mm apart"
        if unit == 1 or touches:
            return 0, ""
        unit = 1
    else:
        slice_steps = gaps * unit / steps
        if float(np.ptp(slice_steps)) > _PROPORTIONAL * float(slice_steps.min()):
            return 0, ""
        why = "their positions leave room for more"
    low, high = int(numbers.min()), int(numbers.max())
    there = sum(low <= number <= high and (number - low) % unit == 0 for number in census.numbers)
    absent = (high - low) // unit + 1 - there
    return absent, f"InstanceNumber leaves out {absent} of {low} to {high}: {why}"


def _judge_start(census: Census, numbers: NDArray[np.int64]) -> tuple[int, str]:
    """Return how many slices are missing before the first number, and why; none if most are: numbered on, or a part."""
    low = int(numbers.min())
    absent = low - 1 - sum(1 <= number < low for number in census.numbers)
    in_ones = int(np.gcd.reduce(np.abs(np.diff(numbers)))) == 1
    if not in_ones or not LOCALIZERS < absent < len(numbers) or low - 1 in census.ends_before:
        return 0, ""
    return absent, f"InstanceNumber begins with {low}, and no image has the {absent} numbers before it"
