"""DBSCAN of the set voxels of a mask on a device: the host side of cl/points/voxel_clusters.cl."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.errors import UsageError
from clrecon.opencl import Device
from clrecon.operators.masks.runs import PARTS_PER_CORE, StencilTable, count_runs, join_runs, list_runs
from clrecon.operators.masks.voxel_mask import VoxelMask
from clrecon.points.stencil import Stencil

MOST_SAMPLES = 255
"""Largest min_samples: counters have 8 bits."""

_LARGEST_WORK = 1e11
"""Most visits of a row of the stencil at a row of the volume: some minutes."""


def checked_min_samples(min_samples: int) -> int:
    whole = isinstance(min_samples, (int, np.integer)) and not isinstance(min_samples, bool)
    if not whole or not 1 <= min_samples <= MOST_SAMPLES:
        raise UsageError(
            f"min_samples is {min_samples!r}: a core point has from 1 to {MOST_SAMPLES} points within"
            " eps, itself included"
        )
    return int(min_samples)


def pad_for(stencil: Stencil) -> int:
    """Return the words of zeros that a mask needs behind each row for this stencil."""
    return -(-stencil.reach // 32)


def search_bytes(mask_bytes: dict[str, int], stencil: Stencil, rows: int) -> dict[str, int]:
    """Return the bytes of what a search needs before it knows the number of points and runs, by description."""
    mask, extents = mask_bytes.values()
    return {
        **mask_bytes,
        "mask of core voxels": mask,
        "counts of rows": 3 * extents,
        "stencil": 2 * stencil.rows.nbytes + 2 * stencil.tables.nbytes,
    }


class ClusterSearch:
    """The clusters of the set voxels of a mask: `points` voxels, `runs` of core voxels along i, `count` clusters.

    mask: With `pad_for` words of zeros behind its rows.
    parts_per_core: Of CPU devices; the labels do not depend on it.
    numbers_d: buffer, (runs,) int32. Cluster of each run, numbered by their first core voxel in the order k, j, i.
    device_bytes: Most bytes on the device at a time.
    """

    def __init__(
        self,
        device: Device,
        mask: VoxelMask,
        stencil: Stencil,
        min_samples: int,
        *,
        memory: int | None = None,
        parts_per_core: int = PARTS_PER_CORE,
    ):
        self.device, self._mask = device, mask
        self._limits = ocl.memory_limits(device, memory)
        self._parts = parts_per_core
        self._samples = checked_min_samples(min_samples)
        self._stencil = stencil
        self._is_one = stencil.holds(mask.shape_ijk)
        """True where all voxels are within eps of each other: one cluster, or noise where they are too few."""
        if not self._is_one:
            self._check_work(stencil)
        self._needs = search_bytes(mask.needs(), stencil, mask.rows)
        self.device_bytes = 0
        self._check_budget({})
        program = ocl.load_program(device, "points/voxel_clusters.cl", {"LANES": device.kernel_variants["LANES"]})
        self._run = ocl.launcher(device, program)
        self._full, self._forward = StencilTable.of(device, stencil), StencilTable.of(device, stencil.forward())
        self._cores_d = mask.mask_d if self._samples == 1 or self._is_one else self._find_cores()
        self._count()
        self.count, self.numbers_d = self._join() if self.runs else (0, ocl.allocate(device, 4))

    @property
    def _is_cpu(self) -> bool:
        """True where a work-item is to do as much as a core can, not as little as a lane."""
        return self.device.has_long_items

    @property
    def _rows(self) -> dict[str, int]:
        return {"rows": self._mask.rows, "words": self._mask.words}

    @property
    def _slices(self) -> dict[str, int]:
        return {"nj": self._mask.shape_ijk[1], "nk": self._mask.shape_ijk[2]}

    def _check_work(self, stencil: Stencil) -> None:
        nj = self._mask.shape_ijk[1]
        work = float((stencil.tables[:, 1] - stencil.tables[:, 0]).sum(dtype=np.int64)) * nj
        if work > _LARGEST_WORK:
            raise UsageError(
                f"each voxel has up to {stencil.members[1]:,} voxels within eps, which makes {work:.1e} visits of rows"
                f" of the volume, {_LARGEST_WORK:.0e} are allowed: choose a smaller eps"
            )

    def _check_budget(self, more: dict[str, int]) -> None:
        needs = {**self._needs, **more}
        ocl.require_room(self._limits, needs, "the clusters of the voxels cannot be found")
        self.device_bytes = max(self.device_bytes, sum(needs.values()))

    def _find_cores(self) -> Any:
        mask = self._mask
        item_words = mask.words if self._is_cpu else 1
        planes = (self._samples - 1).bit_length()
        cores_d = ocl.allocate(self.device, 4 * mask.words * mask.rows)
        self._run(
            "find_cores", mask.rows * -(-mask.words // item_words), mask=mask.mask_d, row_extents=mask.row_extents_d,
            cores=cores_d, words=mask.words, item_words=item_words, planes=planes,
            start=2**planes - self._samples, **self._full.arguments, **self._slices,
        )  # fmt: skip
        return cores_d

    def _count(self) -> None:
        """Count runs and points, row by row."""
        counted = count_runs(self.device, self._mask, self._cores_d, lone=not self._stencil.joins_columns)
        self._counted, self._row_counts_d = counted, counted.row_counts_d
        self.runs, self.points = counted.count, counted.voxels
        if self._is_one and self.points < self._samples:
            nothing = np.zeros(self._mask.rows * self._mask.words, np.uint32)
            self._cores_d, self.runs = ocl.upload(self.device, nothing), 0
        self._needs |= {"runs of core voxels": 16 * self.runs, "labels": 4 * self.points}
        self._check_budget({})

    def _join(self) -> tuple[int, Any]:
        device, runs = self.device, self.runs
        listed = list_runs(device, self._mask, self._cores_d, self._counted)
        self._runs_d = listed.runs_d
        if self._is_one:
            return 1, ocl.upload(device, np.zeros(runs, np.int32))
        return join_runs(
            device, listed, self._mask.shape_ijk, self._forward,
            check=lambda links: self._check_budget({"pairs of runs": 12 * links, "roots": 5 * runs}),
            parts_per_core=self._parts,
        )  # fmt: skip

    def label(self, numbers: NDArray[np.int32] | None = None) -> NDArray[np.int32]:
        """Return the cluster of each point, or its `numbers` (runs,), order k, j, i, -1 for noise: (points,) int32."""
        labels, labels_d = ocl.empty_output(self.device, (self.points,), np.int32)
        if not self.runs:
            labels.fill(-1)
            return labels
        numbers_d = self.numbers_d if numbers is None else ocl.upload(self.device, numbers)
        self._run(
            "label_points", self._mask.rows, mask=self._mask.mask_d, cores=self._cores_d,
            row_extents=self._mask.row_extents_d, runs=self._runs_d, row_counts=self._row_counts_d,
            numbers=numbers_d, labels=labels_d, words=self._mask.words,
            **self._full.arguments, **self._slices,
        )  # fmt: skip
        return ocl.download(self.device, labels, labels_d)

    def run_numbers(self) -> NDArray[np.int32]:
        """Return the cluster of each run, shape (runs,), int32."""
        return ocl.download(self.device, np.empty(self.runs, np.int32), self.numbers_d)

    def flag_cores(self) -> NDArray[np.bool_]:
        """Return whether each point is a core point, in the order k, j, i, shape (points,), bool."""
        flags, flags_d = ocl.empty_output(self.device, (self.points,), np.uint8)
        if self.points:
            self._run(
                "flag_cores", self._mask.rows, mask=self._mask.mask_d, cores=self._cores_d,
                row_extents=self._mask.row_extents_d, row_counts=self._row_counts_d, flags=flags_d, **self._rows,
            )  # fmt: skip
            ocl.download(self.device, flags, flags_d)
        return flags.view(np.bool_)
