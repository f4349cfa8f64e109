"""`DeviceVolume`: a volume on a device, shared by all surfaces, pictures and slices made of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from numpy.typing import ArrayLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceMemoryError, DeviceStoppedError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import ValueRange
from clrecon.opencl import Attempt, Device, MemoryLimits, Program, Stopwatch
from clrecon.operators.resident.tables import StackTable, ray_variants
from clrecon.system.base_classes import Closing
from clrecon.system.light_dataclass import dataclass
from clrecon.system.log import get_logger
from clrecon.system.text import count_of

if TYPE_CHECKING:  # label maps load pydicom, which surfaces need not wait for
    from clrecon.labels import LabelMap, ResampledLabels

Made = TypeVar("Made")

log = get_logger(__name__)


@dataclass(frozen=True)
class _Kept:
    of: Hashable
    value: Any
    nbytes: int


class DeviceVolume(Closing, Volume):
    """A volume on a device: uploaded once, and used by every operator that it is given to; a `Volume` for all else.

    The voxels are uploaded when they are first needed.  If they do not fit as a whole beside an operator's other
    buffers, that operator processes them in slabs.  The results are the same.  Use it as a context manager, or `close`
    it.

    Parameters
    ----------
    volume : Volume
        Its voxels must not change while this object is open.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Most bytes taken on the device at a time, by the volume and everything made of it; None: all memory of the
        device.

    Attributes
    ----------
    volume : Volume
    device : Device
        Another one once the CPU device took over, see `with_fallback`.
    memory : int or None
    uploaded_bytes : int
        Bytes of voxels uploaded so far.  CPUs and their GPUs read the computer's own memory: nothing is copied.
    values : ValueRange
        Range of the voxels' values.
    most_slices : dict of str to int
        For each purpose, the number of slices in a slab that was processed after a larger slab had failed.

    Raises
    ------
    UsageError
        ``volume`` is not a Volume, or ``memory`` is not a number of bytes.
    DeviceError
        The device does not exist.

    Examples
    --------
    >>> with clrecon.DeviceVolume(volume) as resident:  # doctest: +SKIP
    ...     mesh = clrecon.extract_isosurface(resident, 200)
    ...     picture = clrecon.render(resident, preset="bone")
    ...     axial = clrecon.cut_slice(resident, "axial")
    """

    def __init__(self, volume: Volume, *, device: Device | str | int | None = None, memory: int | None = None):
        if not isinstance(volume, Volume):
            raise UsageError(f"a DeviceVolume is made of a Volume, not {type(volume).__name__}")
        ocl.check_memory(memory)
        vars(self).update(vars(volume))  # the same voxels, places and report
        self.volume: Volume = volume.volume if isinstance(volume, DeviceVolume) else volume
        self._taken_device = ocl.take_device(device)
        self.device = self._taken_device.current
        self.memory = memory
        self.uploaded_bytes = 0
        self.values = ValueRange(volume)
        self._lock = threading.RLock()
        self._context: Any = None
        self._whole_d: Any = None
        self._kept: dict[str, _Kept] = {}
        self._taken: tuple[LabelMap, ResampledLabels] | None = None
        self._part_bytes = 0
        self.surfaces = 0  # made of it so far
        self.most_slices: dict[str, int] = {}

    def close(self) -> None:
        """Free everything on the device.  Objects that are asked for later are uploaded again."""
        self.release()
        self._taken = None

    def alike(self, voxels: ArrayLike, affine: ArrayLike, *more: Any, **known: Any) -> DeviceVolume:
        return self.follow(Volume(voxels, affine, *more, **known))

    @property
    def report(self) -> dict[str, Any]:
        """That of ``volume``."""
        return self.volume.report

    @report.setter
    def report(self, report: dict[str, Any]) -> None:
        self.volume.report = report

    def __dir__(self) -> list[str]:
        """Leave out what clrecon's own operators call."""
        return sorted({*dir(Volume), "close", "device", "memory", "uploaded_bytes", "values", "volume"})

    def __repr__(self) -> str:
        return f"DeviceVolume({self.volume!r} on {self.device!r})"

    # Data on the device

    def __reduce__(self) -> NoReturn:
        """Refuse to be pickled or copied: buffers stay with their process."""
        raise TypeError("a DeviceVolume belongs to its process: send its volume, and make one there")

    def follow(self, volume: Volume, voxels_d: Any = None) -> DeviceVolume:
        """Return another volume on the same device, under the same limit of memory.

        voxels_d: Its voxels there, (nk, nj, ni); None: they are uploaded when they are first needed.
        """
        device_volume = DeviceVolume(volume, device=self._taken_device, memory=self.memory)
        device_volume.device = self.device
        if voxels_d is not None:
            device_volume._context, device_volume._whole_d = self.device.context, voxels_d
        return device_volume

    @property
    def is_held(self) -> bool:
        """True where all voxels are on the device."""
        self._check_context()
        return self._whole_d is not None

    def whole(self, stopwatch: Stopwatch, landed: ocl.Landed | None = None) -> Any:
        """Return all voxels on the device, (nk, nj, ni); they stay there."""
        with self._lock:
            self._check_context()
            if self._whole_d is None:
                self._whole_d = self.upload(self.volume.voxels, stopwatch, landed)
            return self._whole_d

    def part(self, first: int, end: int, stopwatch: Stopwatch, landed: ocl.Landed | None = None) -> Any:
        """Return slices ``first`` to ``end - 1`` on the device, replacing all other voxels there."""
        self.make_way()
        part_d = self.upload(self.volume.voxels[first:end], stopwatch, landed)
        self._part_bytes += self.volume.voxels[first:end].nbytes
        return part_d

    def make_way(self) -> None:
        """Drop the voxels on the device and everything made of them; small tables stay."""
        with self._lock:
            self._whole_d = None
            self._kept = {what: kept for what, kept in self._kept.items() if not kept.nbytes}

    def pays_whole(self, slices: int) -> bool:
        """True if all voxels should be uploaded for ``slices`` slices: with earlier uploads these are as many."""
        return self.is_held or self._part_bytes + slices * self.slice_bytes >= self.volume.voxels.nbytes

    @property
    def slice_bytes(self) -> int:
        """Bytes of a slice."""
        ni, nj, _ = self.volume.shape_ijk
        return ni * nj * int(self.dtype.itemsize)

    def upload(self, voxels: NDArray[Any], stopwatch: Stopwatch, landed: ocl.Landed | None = None) -> Any:
        """Upload voxels of this volume, in any order and number."""
        with stopwatch.timed("upload"):
            voxels_d = ocl.upload(self.device, voxels, landed=landed)
        self.uploaded_bytes += voxels.nbytes
        return voxels_d

    def keep(self, name: str, of: Hashable, nbytes: int, make: Callable[[], Made]) -> Made:
        """Return what an operator made of the volume and ``of``, and will need again; one object of each kind is kept.

        It is dropped when one of its kind for other inputs is asked for, when the voxels are dropped, or when another
        operator needs the room.

        name: Kind of the object, for messages about memory.
        nbytes: Its bytes on the device; 0 for small tables, which stay when the voxels are dropped.
        """
        with self._lock:
            self._check_context()
            entry = self._kept.get(name)
            if entry is None or entry.of != of:
                self._kept.pop(name, None)
                entry = self._kept[name] = _Kept(of, make(), nbytes)
            value: Made = entry.value
            return value

    def kept_bytes(self, name: str) -> int:
        """Bytes on the device of the kept object of a kind; 0 without one."""
        entry = self._kept.get(name)
        return 0 if entry is None else entry.nbytes

    @property
    def stack(self) -> StackTable:
        """Table of the places of the slices, on the device."""
        return self.keep("places of the slices", None, 0, lambda: StackTable.of(self.volume, self.device))

    @classmethod
    def _of(cls, *parts: Any) -> DeviceVolume:
        return cls(Volume(*parts))

    def program(self, name: str, **variants: str) -> Program:
        """Build a kernel file that samples this volume along rays."""
        extra = {"UNEVEN": "1"} if self.volume.uneven else {}
        return ocl.load_program(self.device, name, {**ray_variants(self.device, self.dtype), **extra, **variants})

    def release(self) -> None:
        """Free everything on the device."""
        with self._lock:
            ocl.keep_for_hung_commands(self._whole_d, self._kept)
            self._whole_d = None
            self._kept = {}

    def _check_context(self) -> None:
        """Forget all data on a device that failed: they are lost."""
        context = self.device.context
        if self._context is not context:
            self.release()
            self._context = context

    # Labels

    def bring(self, labels: LabelMap) -> ResampledLabels:
        """Return a label map on the grid of the volume, see `resample_labels`; the last one is kept."""
        from clrecon.labels import resample_labels

        with self._lock:
            if self._taken is None or self._taken[0] is not labels:
                self._taken = labels, resample_labels(labels, self.volume)
            return self._taken[1]

    def place(self, labels: LabelMap, placed: ResampledLabels) -> None:
        """Take a label map whose place on the grid of the volume is known: `bring` returns it until another comes."""
        with self._lock:
            self._taken = labels, placed

    # Slabs

    @property
    def limits(self) -> MemoryLimits:
        """Limits of the memory on the device."""
        return ocl.memory_limits(self.device, self.memory)

    def shortage(self, needs: Mapping[str, int], counted: tuple[str, ...] = ()) -> str:
        """Return why the device has no room for ``needs``; empty if it has.

        needs: Bytes of all buffers that an operator uses at a time, the voxels among them, by description.
        counted: Kinds of kept objects that ``needs`` counts already; others are added, and dropped if in the way.
        """
        with self._lock:
            others = {what: kept.nbytes for what, kept in self._kept.items() if what not in counted and kept.nbytes}
            shortage = ocl.describe_shortage(self.limits, {**needs, **others})
            if shortage and others:
                self._kept = {what: kept for what, kept in self._kept.items() if what not in others}
                shortage = ocl.describe_shortage(self.limits, needs)
            return shortage

    def plan(
        self,
        name: str,
        total: int,
        needs: Callable[[int], Mapping[str, int]],
        *,
        counted: tuple[str, ...] = (),
        most: int | None = None,
    ) -> int:
        """Return the number of slices in a slab: ``total`` if all fit, else as many as fit, or 0.

        name: Purpose of the slabs.  Thinner ones that were necessary for it before, see `attempts`, are planned again.
        needs: Function from a number of slices to bytes of every buffer, by description; ``counted`` as in `shortage`.
        most: Most slices that kernels can process together.
        """
        limits = self.limits
        most = min(total if most is None else most, self.most_slices.get(name, total))
        if total <= most and not self.shortage(needs(total), counted):
            return total
        low, high = 0, total  # of parts nothing is kept: others are dropped when the first one comes
        while high - low > 1:
            middle = (low + high) // 2
            fits = middle <= most and not ocl.describe_shortage(limits, needs(middle))
            low, high = (middle, high) if fits else (low, middle)
        return low

    def with_fallback(self) -> Iterator[Attempt[tuple[Device, list[str]]]]:
        """Yield attempts at the work of an operator, each anew on `device`."""
        for attempt in ocl.with_fallback(self._taken_device):
            current, _ = attempt.given
            with self._lock:
                if current is not self.device:
                    self.release()
                    self.device = current
                    self.most_slices.clear()
            yield attempt

    def attempts(
        self, name: str, slices: int, warnings: list[str] | None = None, *, fewest: int = 1
    ) -> Iterator[Attempt[int]]:
        """Yield attempts with ``slices`` in a slab, then with half as many as long as the device has no room, or is
        stopped: by a watchdog, which counts the seconds of a kernel, or where memory was missing.

            for attempt in resident.attempts("surface", planned, warnings):
                with attempt as slices:
                    made = ...

        The block makes all its buffers in functions that it calls: earlier ones are gone, and its own would stay.

        name: As in `plan`, whose result ``slices`` are.
        warnings: Gets a line for each halving.
        fewest: Fewest slices that are tried.
        """
        is_last = False
        while True:
            attempt = Attempt(slices, DeviceMemoryError, DeviceStoppedError)
            yield attempt
            error = attempt.take_error()
            if error is None:
                return
            ocl.settle(self.device, error)
            self.release()
            if is_last:
                raise error
            is_last = slices <= fewest  # once more, with nothing else on the device
            slices = self.most_slices[name] = max(fewest, -(-slices // 2))
            log.info("%s: no room on %s, continued with slabs of %d slices", name, self.device.label, slices)
            if warnings is not None:
                warnings.append(f"{error}: continued with slabs of {count_of(slices, 'slice')}")
            del error  # its frames hold buffers


class VolumeWorker(Closing):
    """Base of what works on a volume on a device, for `what`: a `DeviceVolume` that is given, or one of its own."""

    def __init__(self, volume: Volume | DeviceVolume, device: Device | str | int | None, memory: int | None, what: str):
        self._resident, self._is_own = take_volume(volume, device, memory, what)
        self.volume = self._resident.volume

    @property
    def device(self) -> Device:
        """The device that works."""
        return self._resident.device

    def close(self) -> None:
        """Free the volume on the device; a `DeviceVolume` that was given stays as it is."""
        if self._is_own:
            self._resident.close()


class DeviceWorker(Closing):
    """Base of what works on a device or its stand-in, with at most `memory` bytes."""

    def __init__(self, device: Device | str | int | None, memory: int | None):
        self._device, self.memory = ocl.take_device(device), memory

    @property
    def device(self) -> Device:
        """The device that works."""
        return self._device.current


@contextmanager
def open_volume(
    volume: Volume | DeviceVolume, device: Device | str | int | None, memory: int | None, action: str
) -> Iterator[DeviceVolume]:
    """Yield a volume on its device, for `action`: a given open one, or a new one that is closed at the end."""
    resident, is_new = take_volume(volume, device, memory, action)
    try:
        yield resident
    finally:
        if is_new:
            resident.close()


def take_volume(
    volume: Volume | DeviceVolume, device: Device | str | int | None, memory: int | None, action: str
) -> tuple[DeviceVolume, bool]:
    """Return the same volume, which the caller closes, and whether it is new."""
    if isinstance(volume, DeviceVolume):
        if device is not None or memory is not None:
            raise UsageError("a DeviceVolume has its device and its memory already: leave out device and memory")
        return volume, False
    if not isinstance(volume, Volume):
        raise UsageError(f"{action} needs a Volume, not {type(volume).__name__}: clrecon.Volume(voxels, affine)")
    return DeviceVolume(volume, device=device, memory=memory), True
