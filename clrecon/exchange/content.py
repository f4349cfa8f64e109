"""The input of a writer: a mesh in the frame in which it is written, and the facts that the file may contain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError

__all__ = ["Content", "Writable", "refuse_file"]


@dataclass(frozen=True)
class Content:
    """A mesh as it goes into a file.

    Attributes
    ----------
    vertices : ndarray, shape (n, 3), float32, or float64 far from the origin
        mm in `space`.
    triangles : ndarray, shape (m, 3), uint32
    normals : ndarray, shape (n, 3), float32, or None
    space : str
        ``LPS`` or ``RAS``.
    to_lps : ndarray, shape (3, 3), float64
        Rotation from `space` to LPS.
    iso_value_hu : float or None
    affine : ndarray, shape (4, 4), float64, or None
        Index (i, j, k) of the volume to LPS mm, whatever `space` is.
    inside : str or None
        The values that the surface encloses, for example "below -400 HU"; None for those from the iso value on.
    certificate : tuple of str
        Facts about the volume, see `clrecon.exchange.certificate`; one printable ASCII line each.
    """

    vertices: NDArray[np.floating]
    triangles: NDArray[np.uint32]
    normals: NDArray[np.float32] | None
    space: str
    to_lps: NDArray[np.float64]
    iso_value_hu: float | None
    affine: NDArray[np.float64] | None
    certificate: tuple[str, ...] = ()
    inside: str | None = None

    @property
    def is_double(self) -> bool:
        """True where coordinates need more digits than float32 has."""
        return self.vertices.dtype == np.float64

    @property
    def number(self) -> str:
        """Format of a coordinate in text files: enough digits to get back the same float32, or 1e-9 mm at 1e5 mm."""
        return "%.15g" if self.is_double else "%.9g"

    @property
    def remarks(self) -> list[str]:
        """Facts for formats that have comments: space, unit and, if known, iso value and certificate."""
        remarks = [f"SPACE={self.space}", "UNIT=mm"]
        if self.iso_value_hu is not None:
            remarks.append(f"ISO_VALUE_HU={self.iso_value_hu:.9g}")
        if self.inside is not None:
            remarks.append(f"INSIDE={self.inside}")
        return remarks + [f"CERTIFICATE {line}" for line in self.certificate]


class Writable(Protocol):
    """Protocol of an object that can be written: a `Mesh`."""

    @property
    def triangle_count(self) -> int: ...
    @property
    def vertices(self) -> NDArray[np.floating]: ...
    def check(self) -> None: ...
    def describe(self, space: str, *, keep_ids: bool = False) -> Content: ...


def refuse_file(words: str, found: object, expected: object) -> OutputError:
    """Return the error for a file whose contents differ from what was written."""
    return OutputError(
        f"the file did not arrive on the disk as it was written: {found} {words}, {expected} expected; "
        "an older file is intact, check the disk and try again"
    )
