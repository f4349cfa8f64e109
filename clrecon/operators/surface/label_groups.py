"""Labels through a device: all at once where there is room, else one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.labels import LabelMap
from clrecon.labels.solid import Box
from clrecon.opencl import MemoryLimits, describe_shortage
from clrecon.operators.surface.slabs import Slab

__all__ = ["Window", "choose_numbers", "each_label", "group_boxes"]

Held = TypeVar("Held")
Made = TypeVar("Made")


@dataclass(frozen=True)
class Window(Slab):
    """The slices of the sample grid that hold one label and a layer around it, of what the device holds."""

    held: tuple[int, int] = (0, 0)

    @property
    def voxel_slices(self) -> tuple[int, int]:
        """First and end of the slices of the volume that the device holds."""
        return self.held


def choose_numbers(labels: LabelMap, numbers: Sequence[int | str] | None) -> tuple[int, ...]:
    """The numbers of the labels that are asked for, each once; all that are there where none are named."""
    if numbers is None:
        return labels.numbers
    chosen = tuple(dict.fromkeys(labels.find(number) for number in numbers))
    if not chosen:
        raise UsageError("choose at least one label")
    return chosen


def group_boxes(boxes: dict[int, Box], needs: dict[str, int], scratch: int, room: MemoryLimits) -> list[dict[int, Box]]:
    """All labels at once where `needs`, and `scratch` as far as one buffer holds it, fit; else one by one."""
    if not describe_shortage(room, {**needs, "scratch": min(scratch, room.buffer_bytes)}):
        return [boxes]
    return [{number: box} for number, box in boxes.items()]


def each_label(
    groups: list[dict[int, Box]],
    hold: Callable[[dict[int, Box]], Held],
    extract: Callable[[Held, int, Box], Made],
    warnings: list[str],
) -> Iterator[tuple[int, Made]]:
    """Labels and what is made of them, in their order.

    Where the device has no room for a group, those of its labels that are not done go through one by one; a single
    label is tried once more, with nothing else on the device.

    Parameters
    ----------
    groups : list of dict of int to Box
        Labels that go through together.
    hold : callable
        Brings to the device what a group has in common.
    extract : callable
        Makes what is wanted of one label.
    warnings : list of str
        Gets a line for each time that the device had no room.
    """
    waiting, retried = list(groups), set[int]()
    while waiting:
        left = dict(waiting.pop(0))
        try:
            held = hold(left)
            for number, box in list(left.items()):
                made = extract(held, number, box)
                del left[number]
                yield number, made
        except DeviceMemoryError as error:
            if len(left) == 1:
                if not retried.isdisjoint(left):
                    raise
                retried.update(left)
            waiting[:0] = [{number: box} for number, box in left.items()]
            warnings.append(f"{error}: continued with one label at a time")
