"""Components of a triangle mesh, or of nodes joined in pairs, and fans around the vertices of a mesh: the host side of
cl/primitives/union_find.cl and fans.cl.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceError, DeviceMemoryError, UsageError
from clrecon.opencl import Device, Program
from clrecon.operators.primitives.scan import LARGEST_SCAN, Compacted, compact, exclusive_scan, prepare_compact

_LARGEST_MESH = 2**32 - 1
"""Most triangles, so that 32 bits can count them."""

_MOST_CORNERS = 2**32 - 1
"""Most corners of triangles: they are numbered in 32 bits, and `NO_CORNER` of fans.cl is the last number."""

_MOST_PASSES = 1000
"""Limit of passes, far above the need of 2^31 vertices: 62 rounds of at most 11 passes each."""


def prepare_components(device: Device) -> Program:
    """Build the kernels now, so that a later `label_components` does not wait for them."""
    with ocl.building_together(device):
        prepare_compact(device)
        ocl.load_program(device, "primitives/union_find.cl")
    return ocl.load_program(device, "primitives/union_find.cl")


def label_components(
    device: Device, triangles: ArrayLike, vertex_count: int, *, memory: int | None = None
) -> tuple[int, NDArray[np.int64]]:
    """Number the components of a mesh: triangles that share a vertex belong to one.

    Return their count, and the component of each vertex, (vertex_count,) int64, numbered in order of the first vertex,
    -1 where no triangle uses it: equal on every device, and to `clrecon.mesh.connectivity.label_components`.
    """
    faces = np.ascontiguousarray(triangles, dtype=np.uint32).reshape(-1, 3)
    _check_mesh(faces, vertex_count)
    if len(faces) == 0:
        return 0, np.full(vertex_count, -1, dtype=np.int64)
    search = _Search(device, faces, vertex_count, memory)
    search.hook_corners()
    return search.label()


def label_fans(
    device: Device, triangles: NDArray[np.uint32], vertex_count: int, *, memory: int | None = None
) -> tuple[tuple[int, NDArray[np.int64]], NDArray[np.uint32]]:
    """Number the components of at least one triangle as `label_components`, and look at the fan of each vertex.

    Returns:
    labelled: The result of `label_components`.
    irregular: ndarray, shape (k,), uint32. Used vertices whose triangles are not one closed fan, rising; and those of
        more than 16 triangles, or of two.
    """
    _check_mesh(triangles, vertex_count)
    if triangles.size > _MOST_CORNERS:
        raise DeviceMemoryError(
            f"fans are found in up to {_MOST_CORNERS // 3:,} triangles, the mesh has {len(triangles):,}"
        )
    search = _Search(device, triangles, vertex_count, memory, links=triangles.nbytes)
    irregular = search.hook_along_fans()
    return search.label(), ocl.download(device, np.empty(irregular.count, np.uint32), irregular.positions_d)


def join_parts(device: Device, labels_d: Any, spare_d: Any, n: int, links_d: Any, links: int) -> tuple[int, Any]:
    """Number the components of nodes, (n,) int32, that are joined within parts, once the parts are joined by pairs.

    labels_d, spare_d: buffer, (n,) uint32. The smallest node of each node's component within its part, a root, or of a
        lone node its own number; the same of roots, and anything else.  Overwritten.
    links_d: buffer, (links, 3) uint32. Pairs (a, b, b) of roots that belong together.
    """
    rounds = _Rounds(device, labels_d, spare_d, n)
    if links:
        rounds.start()
        rounds.join_roots(links_d, links)
        rounds.unite(labels_d)
    return rounds.number(labels_d, spare_d, n)


def hook_in_rounds(
    device: Device, labels_d: Any, other_d: Any, n: int, hook: Callable[[Any, Any, Any, int], None]
) -> tuple[Any, Any]:
    """Find components by a kernel that hooks roots to smaller ones, in rounds, until it hooks none.

    Return the same two buffers: labels that are all roots, the least node of each component, and a free one.

    labels_d: buffer, (n,) uint32. For each node a root, which is its own label, of its component and not above it; 2^32
        - 1 for nodes that take no part.
    other_d: buffer, (n,) uint32. Overwritten.
    hook: Called with the labels, all of them roots; with a copy, in which it lowers the label of a root by atomic_min()
        to another root of the same component; with two flags, of which it sets the second to the number that it is
        called with where it finds such a root; and with that number.
    """
    rounds = _Rounds(device, labels_d, other_d, n)
    rounds.start()
    return rounds.hook_by(hook)


def _check_mesh(triangles: NDArray[np.uint32], vertex_count: int) -> None:
    if not 0 <= vertex_count <= LARGEST_SCAN or len(triangles) > _LARGEST_MESH:
        raise UsageError(
            f"a mesh of {vertex_count:,} vertices and {len(triangles):,} triangles:"
            f" components are found in up to {LARGEST_SCAN:,} and {_LARGEST_MESH:,}"
        )
    if triangles.size and int(triangles.max()) >= vertex_count:
        raise UsageError(f"a triangle refers to vertex {int(triangles.max())}, the mesh has {vertex_count} vertices")


class _Rounds:
    """The rounds of cl/primitives/union_find.cl: two buffers of labels, one read and one written, and flags."""

    def __init__(self, device: Device, labels_d: Any, other_d: Any, nodes: int):
        self._device = device
        self.run = ocl.launcher(device, prepare_components(device))
        self._labels_d, self._other_d = labels_d, other_d
        self._nodes = nodes
        self._flags_d = ocl.allocate(device, 8)
        self._roots: Compacted | None = None
        self._passes = 0

    def start(self) -> None:
        self.run("clear_labels", 1, labels=ocl.allocate(self._device, 4), flags=self._flags_d, n=1)

    def number(self, labels_d: Any, spare_d: Any, n: int) -> tuple[int, Any]:
        """Number the components by their roots: their count, and a buffer, (n,) int32."""
        self.run("flag_roots", n, labels=labels_d, roots=spare_d, n=n)
        roots = exclusive_scan(self._device, spare_d, n)
        numbers_d = ocl.allocate(self._device, 4 * n)
        self.run("number_components", n, labels=labels_d, offsets=roots.offsets_d, numbers=numbers_d, n=n)
        return roots.total, numbers_d

    def join_roots(self, corners_d: Any, count: int) -> None:
        """Run all rounds after the first, on the roots that it left.  No other label changes any more."""
        self._roots = self.list_marked("mark_roots", self._nodes, labels=self._labels_d, n=self._nodes)
        # Roots are their own label in both buffers, and other labels lead to the same root, if not in one step.
        while self._hook(corners_d, count):
            self.jump("jump_roots", self._roots.count, roots=self._roots.positions_d, count=self._roots.count)

    def hook_by(self, hook: Callable[[Any, Any, Any, int], None]) -> tuple[Any, Any]:
        self.run(
            "jump_labels", self._nodes,
            labels=self._labels_d, jumped=self._other_d, flags=self._flags_d, n=self._nodes,
            pass_number=self._next_pass(),
        )  # fmt: skip  # a copy, since all labels are roots
        while True:
            number = self._next_pass()
            hook(self._labels_d, self._other_d, self._flags_d, number)
            if self._read_flags()[1] != number:
                return self._labels_d, self._other_d
            self.jump("jump_labels", self._nodes, n=self._nodes)

    def unite(self, labels_d: Any) -> None:
        """Bring the labels of the roots to one buffer, in which the label of each label is then a root."""
        if self._roots is not None and self._labels_d is not labels_d:
            self.run(
                "copy_roots", self._roots.count,
                roots=self._roots.positions_d, labels=self._labels_d, copy=labels_d, count=self._roots.count,
            )  # fmt: skip

    def _hook(self, corners_d: Any, count: int) -> bool:
        number = self._next_pass()
        self.run(
            "hook_roots", count,
            corners=corners_d, labels=self._labels_d, hooked=self._other_d, flags=self._flags_d, count=count,
            pass_number=number,
        )  # fmt: skip
        return bool(self._read_flags()[1] == number)

    def jump(self, kernel: str, items: int, **listed: Any) -> None:
        """Run passes of jumps, from `_other_d` to `_labels_d` and back, until all labels in `_labels_d` are roots."""
        while True:
            number = self._next_pass()
            self.run(
                kernel, items,
                labels=self._other_d, jumped=self._labels_d, flags=self._flags_d, pass_number=number, **listed,
            )  # fmt: skip
            if self._read_flags()[0] != number:
                return
            self._labels_d, self._other_d = self._other_d, self._labels_d

    def _next_pass(self) -> int:
        self._passes += 1
        if self._passes > _MOST_PASSES:
            raise DeviceError(
                f"{self._device.label} has not found the components after {_MOST_PASSES} passes: it computes wrongly,"
                " see `clrecon selftest` and try another device"
            )
        return self._passes

    def _read_flags(self) -> NDArray[np.uint32]:
        return ocl.download(self._device, np.empty(2, dtype=np.uint32), self._flags_d)

    def list_marked(self, kernel: str, size: int, **inputs: Any) -> Compacted:
        """List the elements that a kernel marks in a bit mask of `size` bits."""
        words = -(-size // 32)
        mask_d = ocl.allocate(self._device, 4 * words)
        self.run(kernel, words, mask=mask_d, **inputs)
        return compact(self._device, mask_d, words)


class _Search(_Rounds):
    def __init__(
        self, device: Device, triangles: NDArray[np.uint32], vertex_count: int, memory: int | None, links: int = 0
    ):
        self._limits = ocl.memory_limits(device, memory)
        self._faces, self._vertices = len(triangles), vertex_count
        labels = 4 * vertex_count
        self._buffers = {"triangles": triangles.nbytes, "labels": labels, "labels of the round before": labels}
        if links:
            self._check_budget({"links of corners": links})
        self._check_budget({"mixed triangles": 4 * self._faces, "roots of the first round": labels})
        self._check_budget({"component offsets": labels, "component numbers": labels})
        prepare_components(device)
        self._faces_d = ocl.upload(device, triangles)
        super().__init__(device, ocl.allocate(device, labels), ocl.allocate(device, labels), vertex_count)

    def _check_budget(self, more: dict[str, int]) -> None:
        ocl.require_room(self._limits, {**self._buffers, **more}, "the components of the mesh cannot be found")

    def hook_corners(self) -> None:
        """Run the first round: each vertex gets the smallest vertex in one triangle with it as label."""
        self._clear(self._other_d)
        self.run("hook_corners", self._faces, triangles=self._faces_d, labels=self._other_d, m=self._faces)

    def hook_along_fans(self) -> Compacted:
        """Do the same from the fans of the vertices; return those that are irregular."""
        run = ocl.launcher(self._device, ocl.load_program(self._device, "primitives/fans.cl"))
        heads_d, links_d = self._labels_d, ocl.allocate(self._device, 12 * self._faces)
        self._clear(heads_d)
        run("link_corners", self._faces, triangles=self._faces_d, heads=heads_d, links=links_d, m=self._faces)
        words = -(-self._vertices // 32)
        mask_d = ocl.allocate(self._device, 4 * words)
        run(
            "follow_fans", words, triangles=self._faces_d, heads=heads_d, links=links_d, labels=self._other_d,
            mask=mask_d, n=self._vertices,
        )  # fmt: skip
        return compact(self._device, mask_d, words)

    def _clear(self, labels_d: Any) -> None:
        self.run("clear_labels", self._vertices, labels=labels_d, flags=self._flags_d, n=self._vertices)

    def label(self) -> tuple[int, NDArray[np.int64]]:
        """Run all rounds after the first; return the result of `label_components`."""
        count, numbers_d = self.number(*self._find_roots(), self._vertices)
        numbers = ocl.download(self._device, np.empty(self._vertices, dtype=np.int32), numbers_d)
        return count, numbers.astype(np.int64)

    def _find_roots(self) -> tuple[Any, Any]:
        """Return labels whose labels are all roots, and a free buffer, both (n,) uint32."""
        self.jump("jump_labels", self._vertices, n=self._vertices)
        labels_d, spare_d = self._labels_d, self._other_d
        mixed = self.list_marked("mark_mixed", self._faces, triangles=self._faces_d, labels=labels_d, m=self._faces)
        if mixed.count:
            self._check_budget({"roots of mixed triangles": 16 * mixed.count})
            corners_d = ocl.allocate(self._device, 12 * mixed.count)
            self.run(
                "gather_roots", mixed.count,
                triangles=self._faces_d, mixed=mixed.positions_d, labels=labels_d, corners=corners_d,
                count=mixed.count,
            )  # fmt: skip
            self.join_roots(corners_d, mixed.count)
            self.unite(labels_d)
        return labels_d, spare_d
