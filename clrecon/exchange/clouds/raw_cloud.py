"""What a reader found in a file of a cloud, and which of its columns are normals, HU and labels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.system.text import escape_text, join_names

HU_NAMES = ("hu", "scalar_hu", "ct", "scalar", "intensity", "scalar_intensity")
LABEL_NAMES = ("label", "labels", "scalar_label", "cluster", "scalar_cluster", "classification")
NORMAL_NAMES = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"))
UNIT_TOLERANCE = 1e-3
"""Largest difference of a normal's length from 1 that rounding in text files explains."""


@dataclass
class RawCloud:
    """A file's points, in the file's own frame.

    kind: "PLY", "XYZ", "NPZ", "VTP" or "LAS".
    points: ndarray, shape (n, 3), of any real type. mm; perhaps not finite.
    columns: dict of str to ndarray, shape (n,). Further values of each point by the name that the file gives them, in
        the order of the file.
    space: Frame that the file names.
    affine: ndarray, shape (4, 4), or None
    """

    kind: str
    points: NDArray[Any]
    columns: dict[str, NDArray[Any]]
    space: str | None = None
    affine: NDArray[Any] | None = None
    iso_value_hu: float | None = None
    certificate: Sequence[str] = ()
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._by_name = {name.strip().lower(): name for name in reversed(self.columns)}
        self._used: set[str] = set()

    def _take(self, names: Iterable[str]) -> list[NDArray[Any]] | None:
        """Return the columns of these names, or None unless all are there."""
        own = [self._by_name.get(name) for name in names]
        if None in own:
            return None
        self._used |= set(own)  # type: ignore[arg-type]
        return [self.columns[name] for name in own if name is not None]

    def normals(self) -> NDArray[np.float32] | None:
        """Return unit normals, shape (n, 3), or None where the file has none that can be used."""
        found = next((columns for names in NORMAL_NAMES if (columns := self._take(names))), None)
        if found is None:
            return None
        with np.errstate(all="ignore"):  # harmed bits
            normals = np.stack(found, axis=1).astype(np.float64)
        wrong = int((~np.isfinite(normals).all(axis=1)).sum())
        if wrong:
            self.warnings.append(f"{wrong:,} normals are not finite: the normals are left out")
            return None
        length = np.linalg.norm(normals, axis=1)
        off = (np.abs(length - 1.0) > UNIT_TOLERANCE) & (length > 0)
        if off.any():
            self.warnings.append(f"{int(off.sum()):,} normals are not of length 1: they are scaled")
            normals[off] /= length[off, None]
        if none := int((length == 0).sum()):
            self.warnings.append(f"{none:,} normals are zero: these points have none")
        return normals.astype(np.float32)

    def hu(self) -> NDArray[np.float32] | None:
        """Return the HU, shape (n,), or None."""
        for place, name in enumerate(HU_NAMES):
            found = self._take([name])
            if found is not None:
                if place >= HU_NAMES.index("scalar"):
                    self.warnings.append(f"HU is taken from the column '{escape_text(self._by_name[name])}'")
                with np.errstate(all="ignore"):
                    return found[0].astype(np.float32)
        return None

    def labels(self) -> NDArray[np.int32] | None:
        """Return the labels, shape (n,), or None where there are none or they are no whole numbers of 32 bits."""
        for name in LABEL_NAMES:
            found = self._take([name])
            if found is not None:
                values = found[0]
                whole = np.isfinite(values) & (np.abs(values.astype(np.float64)) < 2**31)
                if not (whole.all() and (values == np.rint(values)).all()):
                    self.warnings.append(
                        f"the column '{escape_text(self._by_name[name])}' has values that are no labels: left out"
                    )
                    return None
                return values.astype(np.int32)
        return None

    def ijk(self) -> NDArray[np.int32] | None:
        """Return voxel indices, shape (n, 3), or None; only our own NPZ has them."""
        found = self._take(("i", "j", "k")) if self.kind == "NPZ" else None
        return None if found is None else np.stack(found, axis=1).astype(np.int32)

    def unused(self) -> list[str]:
        """Return the warning about columns that were not taken, if there are any."""
        others = [escape_text(name) for name in self.columns if name not in self._used]
        return [f"columns left out: {join_names(others)}"] if others else []


def columns_of(values: NDArray[Any], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return the columns of an array of shape (n, k) by their names."""
    return {name: values[:, place] for place, name in enumerate(names)}


def read_remarks(lines: Iterable[str]) -> dict[str, Any]:
    """Return what comments say: ``space``, ``iso_value_hu`` and ``certificate``, as entries of a `RawCloud`."""
    found: dict[str, Any] = {"certificate": []}
    for line in lines:
        text = line.strip()
        if text.startswith("SPACE=") and "space" not in found:
            found["space"] = text.removeprefix("SPACE=").strip()
        elif text.startswith("ISO_VALUE_HU="):
            try:
                found["iso_value_hu"] = float(text.removeprefix("ISO_VALUE_HU="))
            except ValueError:
                continue
        elif text.startswith("CERTIFICATE "):
            found["certificate"].append(text.removeprefix("CERTIFICATE "))
    return found


def say_cut(name: str, error: object) -> RefusedInputError:
    """Return the error for a file that ends early or holds what its format forbids."""
    return RefusedInputError(f"{name} is cut or corrupt: {escape_text(str(error) or type(error).__name__, 120)}")
