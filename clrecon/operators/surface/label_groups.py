"""Groups of labels on a device: all at once if there is room, else one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from clrecon.errors import DeviceMemoryError
from clrecon.labels.solid import Box
from clrecon.opencl import MemoryLimits, describe_shortage
from clrecon.operators.surface.slabs import Slab

Held = TypeVar("Held")
Made = TypeVar("Made")


@dataclass(frozen=True)
class Window(Slab):
    """The slices of the sample grid that hold one label and a layer around it, among those on the device."""

    held: tuple[int, int] = (0, 0)

    @property
    def voxel_slices(self) -> tuple[int, int]:
        """First and end of the slices of the volume on the device."""
        return self.held


def group_boxes(boxes: dict[int, Box], needs: dict[str, int], scratch: int, room: MemoryLimits) -> list[dict[int, Box]]:
    """Group all labels together if `needs` fits, and `scratch` fits one buffer; else one by one."""
    if not describe_shortage(room, {**needs, "scratch": min(scratch, room.buffer_bytes)}):
        return [boxes]
    return [{number: box} for number, box in boxes.items()]


def each_label(
    groups: list[dict[int, Box]],
    hold: Callable[[dict[int, Box]], Held],
    extract: Callable[[Held, int, Box], Made],
    warnings: list[str],
) -> Iterator[tuple[int, Made]]:
    """Yield labels with their results, in order.

    If the device has no room for a group, its remaining labels are processed one by one; a single label is tried once
    more, with nothing else on the device.

    groups: Labels that are processed together.
    hold: Uploads the data that a group shares.
    extract: Makes the result of one label.
    warnings: Gets a line each time that the device had no room.
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
