"""Labels through a device: all at once where there is room, else one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

from clrecon.errors import DeviceMemoryError
from clrecon.labels.solid import Box
from clrecon.opencl import MemoryLimits, describe_shortage

__all__ = ["each_label", "group_boxes"]

Held = TypeVar("Held")
Made = TypeVar("Made")


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
