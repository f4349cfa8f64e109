"""`Stage`: scans and label maps on the device, and the parts of scans, for all views of a process."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.labels.resample import ResampledLabels
from clrecon.opencl import Device, take_device
from clrecon.operators.rays.point_pictures import PointPictures
from clrecon.operators.rays.volume_renderer import VolumeRenderer
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.system.base_classes import Closing
from clrecon.system.progress import Progress
from clrecon.viewer.drawing.looks import LabelledLook
from clrecon.viewer.model.objects import ShownLabels, ShownObject, ShownScan
from clrecon.viewer.model.parts import FoundParts, find_clusters
from clrecon.viewer.model.state import Point, ViewState

MOST_FOUND, MOST_FOUND_BYTES = 6, 1 << 29
"""Sets of parts that are kept, of all views together, and the bytes of their label maps; two are kept whatever their
size."""


class Stage(Closing):
    """What is on the device; safe for several threads.

    objects, device, memory: See `clrecon.viewer.drawing.painter.Painter`.

    lock: Held while the device works for a view.
    """

    def __init__(
        self, objects: Sequence[ShownObject], *, device: Device | str | int | None = None, memory: int | None = None
    ):
        self.objects = tuple(objects)
        self.memory = memory
        self.lock = threading.RLock()
        self._device = take_device(device)
        self._bare: dict[int, Volume] = {}
        self._residents: dict[tuple[int, bool], DeviceVolume] = {}
        self._solid: dict[int, tuple[DeviceVolume, ResampledLabels]] = {}
        self._takers: dict[int, VolumeRenderer | PointPictures] = {}
        self._found: OrderedDict[tuple[int, float, bool], FoundParts] = OrderedDict()
        self._blank: dict[int, LabelledLook] = {}

    def close(self) -> None:
        """Free everything on the device."""
        with self.lock:
            for taker in self._takers.values():
                taker.close()
            for resident in (*self._residents.values(), *(each for each, _ in self._solid.values())):
                resident.close()
            for kept in (self._takers, self._residents, self._solid):
                kept.clear()  # type: ignore[attr-defined]

    @property
    def device(self) -> Device:
        """The device that works."""
        return self._device.current

    # Parts

    def find_parts(self, state: ViewState, progress: Progress | None = None) -> list[FoundParts]:
        """Find the parts of all scans at the iso value; those that were found before are taken again.

        Scans with a label map have its labels as parts.
        """
        made = []
        for scan in self._clustered():
            key = (scan.number, state.iso_value, state.table)
            with self.lock:
                known = self._found.get(key)
                if known is None:
                    resident = self._resident(scan, state.table)
            if known is None:  # most of the time is numpy's: other pictures are taken meanwhile
                known = find_clusters(resident, *key, progress, lock=self.lock)
            with self.lock:
                self._found[key] = known
                self._found.move_to_end(key)
                self._drop_found()
            made.append(known)
        return made

    def _drop_found(self) -> None:
        """Drop the parts that were asked for longest ago, where there are many."""

        def too_many() -> bool:
            taken = sum(each.labels.voxels.nbytes for each in self._found.values())
            return len(self._found) > MOST_FOUND or taken > MOST_FOUND_BYTES

        while len(self._found) > 2 and too_many():
            self._found.popitem(last=False)

    def has_parts(self, state: ViewState) -> bool:
        """True where the label maps of the parts that the state knows are there."""
        return all(self._found_for(scan, state) is not None for scan in self._clustered())

    def remove_table(self, progress: Progress | None = None) -> dict[int, dict[str, Any]]:
        """Make the scans without table and blankets, once; returns what was taken from each, by number."""
        from clrecon.anatomy.body import remove_table

        said = {}
        for scan in self.objects:
            if not isinstance(scan, ShownScan):
                continue
            if scan.number not in self._bare:
                bare = remove_table(scan.volume, progress=progress)
                with self.lock:
                    self._bare[scan.number] = bare
            said[scan.number] = dict(self._bare[scan.number].report["remove_table"])
        return said

    @property
    def knows_table(self) -> bool:
        """True once `remove_table` is done."""
        return all(each.number in self._bare for each in self.objects if isinstance(each, ShownScan))

    # What is drawn

    def resident(self, number: int, state: ViewState) -> DeviceVolume:
        """Return a scan on the device, as the state shows it."""
        scan = next(each for each in self.objects if each.number == number and isinstance(each, ShownScan))
        with self.lock:
            return self._resident(scan, state.table)

    def labelled(self, number: int, state: ViewState) -> LabelledLook | None:
        """Return the label map by which a scan is divided, None where its parts are not known."""
        scan = next(each for each in self.objects if each.number == number and isinstance(each, ShownScan))
        with self.lock:
            return self._labelled(scan, state)

    def labels_on(self, resident: DeviceVolume, labelled: LabelledLook) -> NDArray[Any]:
        """Return the numbers of a label map on the grid of a scan; hold `lock`."""
        self.place(resident, labelled)
        return resident.bring(labelled.labels).voxels

    def _clustered(self) -> list[ShownScan]:
        """Return the scans that are divided into clusters."""
        return [each for each in self.objects if isinstance(each, ShownScan) and self._map_of(each.number) is None]

    def _map_of(self, scan: int) -> ShownLabels | None:
        return next((each for each in self.objects if isinstance(each, ShownLabels) and each.within == scan), None)

    def _resident(self, scan: ShownScan, table: bool) -> DeviceVolume:
        bare = not table and scan.number in self._bare
        key = (scan.number, bare)
        if key not in self._residents:
            volume = self._bare[scan.number] if bare else scan.volume
            self._residents[key] = DeviceVolume(volume, device=self._device, memory=self.memory)
        return self._residents[key]

    def renderer(self, resident: DeviceVolume) -> VolumeRenderer:
        """Return what takes pictures of a scan; hold `lock` while it works."""
        known = self._takers.get(id(resident))
        if known is None:
            known = self._takers[id(resident)] = VolumeRenderer(resident)
        assert isinstance(known, VolumeRenderer)
        return known

    def _found_for(self, scan: ShownScan, state: ViewState) -> FoundParts | None:
        if state.parts_at is None:
            return None
        return self._found.get((scan.number, state.parts_at, state.parts_table))

    def _labelled(self, scan: ShownScan, state: ViewState) -> LabelledLook | None:
        own = self._map_of(scan.number)
        if own is not None:
            return LabelledLook(own.labels, None, tuple(state.parts_of(own.number)))
        found = self._found_for(scan, state)
        return None if found is None else LabelledLook(found.labels, found.placed, tuple(state.parts_of(scan.number)))

    def hu_at(self, point: Point) -> float | None:
        """Return the HU of the first scan, trilinear; None outside of it."""
        scan = next((each for each in self.objects if isinstance(each, ShownScan)), None)
        if scan is None:
            return None
        volume = scan.volume
        at = volume.lps_to_ijk([point])[0]
        last = np.array(volume.shape_ijk) - 1
        if (at < -0.5).any() or (at > last + 0.5).any():
            return None
        at = np.clip(at, 0, last)
        low = np.minimum(at.astype(np.int64), np.maximum(last - 1, 0))
        share = at - low
        i, j, k = low
        block = volume.voxels[k : k + 2, j : j + 2, i : i + 2].astype(np.float64)
        for part in share[::-1]:
            block = block[0] + (block[1] - block[0]) * part if len(block) > 1 else block[0]
        return float(block)

    def blank_labels(self, number: int, volume: Volume) -> LabelledLook:
        """Return a map without a label, by which a whole scan is made translucent."""
        if number not in self._blank:
            labels = LabelMap(np.zeros(volume.voxels.shape, np.uint8), volume.affine.copy())
            self._blank[number] = LabelledLook(labels, ResampledLabels(labels.voxels, True, {}, ()), ())
        return self._blank[number]

    def place(self, resident: DeviceVolume, labelled: LabelledLook | None) -> None:
        """Tell a scan where the label map lies that is drawn next; hold `lock`."""
        if labelled is not None and labelled.placed is not None:
            resident.place(labelled.labels, labelled.placed)
