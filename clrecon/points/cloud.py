"""`PointCloud`: points in LPS mm with what is known of each of them, and `PointStep`: what a step made of a cloud."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clrecon.errors import UsageError
from clrecon.exchange.content import PointContent, checked_columns, facts_for_file
from clrecon.exchange.coordinates import as_array, as_stored, rows_of_three
from clrecon.exchange.formats import write_cloud
from clrecon.exchange.raw_content import turn_to_lps
from clrecon.geometry import Volume
from clrecon.geometry.affine import choose_space
from clrecon.system.arguments import Space, explains_arguments
from clrecon.system.base_classes import Message
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.packages import ShownAsHtml, install_command
from clrecon.system.paths import keep_existing

MOST_POINTS = 2**31 - 1
"""Most points of a cloud, so that their numbers fit a signed 32-bit integer."""


def _as_numbers(array: NDArray[Any], name: str, dtype: DTypeLike) -> NDArray[Any]:
    """Return an array in the type in which a cloud keeps it, which must hold its values."""
    if dtype is np.int32 and not (array.dtype.kind in "iu" and np.can_cast(array.dtype, np.int32)):
        with np.errstate(invalid="ignore"):
            if not np.array_equal(array.astype(np.int32), array):
                raise UsageError(f"{name} are whole numbers of 32 bits, some of these are not")
    return np.ascontiguousarray(array, dtype=dtype)


def _check_finite(points: NDArray[np.floating], name: str) -> None:
    wrong = ~np.isfinite(points).all(axis=1)
    if wrong.any():
        raise UsageError(
            f"{int(wrong.sum()):,} of {len(points):,} {name} are not finite, the first is number"
            f" {int(np.flatnonzero(wrong)[0]):,}: remove them first"
        )


def _take_values(values: NDArray[Any] | VoxelNumbers, numbers: NDArray[np.intp]) -> Any:
    return values.take(numbers) if isinstance(values, VoxelNumbers) else values.take(numbers, axis=0)


class PointCloud(Message, ShownAsHtml):
    """Points in the patient frame LPS, millimetres, with normals, HU, labels and voxel indices where they are known.

    Parameters
    ----------
    points : array_like, shape (n, 3) or (3,)
        LPS mm, finite; kept as float32, without a copy when they are C-contiguous float32.  Others that reach 4096 mm
        from the origin, where float32 would round them by more than 2e-4 mm, are kept as float64.
    normals : array_like, shape (n, 3), optional
        Unit vectors that point out of bone, LPS; kept as float32.
    hu : array_like, shape (n,), optional
        Hounsfield units; kept as float32.
    labels : array_like, shape (n,), optional
        Clusters or labels of a label map, whole numbers; -1 is noise.  Kept as int32.
    ijk : array_like, shape (n, 3), optional
        Voxel indices of points that are voxel centres; kept as int32.
    report : dict, optional
        Facts about the origin of this cloud, without patient data.  ``affine_ijk_to_lps_mm``, ``iso_value_hu`` and
        ``certificate`` (the report of the volume) are written to the formats that have a place for them, as with a
        `Mesh`.

    Raises
    ------
    UsageError
        A shape or type cannot be used, a coordinate is not finite, or an array has another length than `points`.
    """

    def __init__(
        self,
        points: ArrayLike,
        normals: ArrayLike | None = None,
        hu: ArrayLike | None = None,
        labels: ArrayLike | None = None,
        ijk: ArrayLike | None = None,
        report: dict[str, Any] | None = None,
    ):
        self._points = as_stored(rows_of_three(points, "points", one=True))
        if len(self._points) > MOST_POINTS:
            raise UsageError(f"a cloud has at most {MOST_POINTS:,} points, this one has {len(self._points):,}")
        _check_finite(self._points, "points")
        self._normals = self._checked("normals", normals)
        self._hu = self._checked("hu", hu)
        self._labels = self._checked("labels", labels)
        self._ijk: NDArray[np.int32] | VoxelNumbers | None = self._checked("ijk", ijk)
        self.report: dict[str, Any] = {} if report is None else report
        self.values: dict[str, NDArray[np.floating]] = {}
        """Numbers in mm at the points, (n,) each, by names that end in ``_mm``: on the cortex ``thickness_mm`` and
        ``error_mm``; written to PLY, VTP and NPZ."""

    @classmethod
    def of_known(
        cls,
        points: NDArray[np.floating],
        normals: NDArray[np.float32] | None = None,
        hu: NDArray[np.float32] | None = None,
        labels: NDArray[np.int32] | None = None,
        ijk: NDArray[np.int32] | VoxelNumbers | None = None,
        report: dict[str, Any] | None = None,
    ) -> PointCloud:
        """Make a cloud of arrays that an operator has made: they have the promised types and are finite.

        Nothing is checked or copied, which would take longer than making them.  Of ``VoxelNumbers`` the indices are
        made when they are first asked for.
        """
        cloud = cls.__new__(cls)
        cloud._points, cloud._normals = points, normals
        cloud._hu, cloud._labels = hu, labels
        cloud._ijk = ijk
        cloud.report = {} if report is None else report
        cloud.values = {}
        return cloud

    def _checked(self, name: str, values: ArrayLike | None) -> NDArray[Any] | None:
        """Return what is known of the points as it is kept, for example their `labels`."""
        if values is None:
            return None
        if name == "hu":
            return self._values(values, name, np.float32, "fiu")
        if name == "labels":
            return self._values(values, name, np.int32, "iu")
        dtype: DTypeLike = np.float32 if name == "normals" else np.int32
        vectors = _as_numbers(rows_of_three(values, name, one=True), name, dtype)
        if len(vectors) != len(self._points):
            raise UsageError(f"{len(vectors):,} {name} for {len(self._points):,} points: one a point is needed")
        if name == "normals":
            _check_finite(vectors, name)
        return vectors

    def _values(self, values: ArrayLike, name: str, dtype: DTypeLike, kinds: str) -> NDArray[Any]:
        array = as_array(values, name)
        if array.shape != (len(self._points),):
            raise UsageError(f"{name} have shape ({len(self._points)},), one value a point; these have {array.shape}")
        if array.size and array.dtype.kind not in kinds:
            raise UsageError(f"{name} are {'numbers' if 'f' in kinds else 'whole numbers'}, these are {array.dtype}")
        return _as_numbers(array, name, dtype)

    @property
    def points(self) -> NDArray[np.floating]:
        """Positions in LPS mm, shape (n, 3), float32; float64 where they lie far from the origin."""
        return self._points

    @property
    def normals(self) -> NDArray[np.float32] | None:
        """Unit vectors out of bone, LPS, shape (n, 3), or None."""
        return self._normals

    @property
    def hu(self) -> NDArray[np.float32] | None:
        """Hounsfield units, shape (n,), or None."""
        return self._hu

    @property
    def labels(self) -> NDArray[np.int32] | None:
        """Cluster or label of each point, shape (n,), -1 for noise; or None."""
        return self._labels

    @property
    def ijk(self) -> NDArray[np.int32] | None:
        """Voxel indices, shape (n, 3), of points that are voxel centres; or None."""
        if isinstance(self._ijk, VoxelNumbers):
            self._ijk = self._ijk.indices()
        return self._ijk

    @property
    def voxel_numbers(self) -> VoxelNumbers | None:
        """Voxels by number while nobody has asked for their indices, or None: for steps that need no indices."""
        return self._ijk if isinstance(self._ijk, VoxelNumbers) else None

    def voxel_slices(self) -> NDArray[Any] | None:
        """Return the slice k of each point that is a voxel centre, shape (n,), whole numbers; None for other points."""
        if isinstance(self._ijk, VoxelNumbers):
            return self._ijk.slices()
        return None if self._ijk is None else self._ijk[:, 2]

    @property
    def has_ijk(self) -> bool:
        """True where the points are voxel centres whose indices are known."""
        return self._ijk is not None

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the box around the points, shape (2, 3), LPS mm; NaN without points."""
        if not len(self):
            return np.full((2, 3), np.nan)
        return np.array([self._points.min(axis=0), self._points.max(axis=0)], np.float64)

    def __len__(self) -> int:
        return len(self._points)

    __iter__ = None  # without it Python would try cloud[0], cloud[1], ...

    def __getitem__(self, key: slice | ArrayLike) -> PointCloud:
        """Return the cloud of a range of points, of those that are true in a mask, or of those with these numbers."""
        if isinstance(key, slice):
            return self.select(np.arange(len(self))[key])
        if np.ndim(key) == 0:  # type: ignore[arg-type]
            raise UsageError(f"a part of a cloud is a range, a mask or numbers of points: one is cloud.points[{key}]")
        return self.select(key)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        array = self._points if dtype is None else self._points.astype(dtype, copy=False)
        return array.copy() if copy else array

    def changed(self, **arrays: ArrayLike | None) -> PointCloud:
        """Return a cloud with other `points`, `normals`, `hu`, `labels`, `ijk` or ``report``; all else stays.

        Points at other places have no ``values``.
        """
        known = ("points", "normals", "hu", "labels", "ijk", "report")
        unknown = arrays.keys() - set(known)
        if unknown:
            raise UsageError(f"a cloud has no {sorted(unknown)[0]}: it has {', '.join(known)}")
        if "points" in arrays or "report" in arrays:
            known_arrays = {name: getattr(self, name) for name in known}
            moved = PointCloud(**{**known_arrays, "report": dict(self.report), **arrays})
            moved.values = {} if "points" in arrays else dict(self.values)
            return moved
        # What stays was checked before.
        cloud = PointCloud.of_known(self._points, self._normals, self._hu, self._labels, self._ijk, dict(self.report))
        cloud.values = dict(self.values)
        for name, values in arrays.items():
            setattr(cloud, f"_{name}", cloud._checked(name, values))
        return cloud

    def select(self, mask: ArrayLike) -> PointCloud:
        """Return the cloud of some of the points.

        Parameters
        ----------
        mask : array_like, shape (n,) bool, or (m,) of integers
            Points to keep, or their numbers in the order wanted.

        Raises
        ------
        UsageError
            The mask does not fit the cloud.
        """
        chosen = np.asarray(mask)
        if chosen.dtype == bool:
            fits = chosen.shape == (len(self),)
        else:
            fits = chosen.ndim == 1 and (chosen.size == 0 or chosen.dtype.kind in "iu")
            fits = fits and (chosen.size == 0 or (chosen.min() >= 0 and chosen.max() < len(self)))
            chosen = chosen.astype(np.intp) if fits else chosen
        if not fits:
            raise UsageError(
                f"a selection of a cloud of {len(self):,} points is as many truth values or numbers of points below"
                f" that, this is {chosen.dtype} of shape {chosen.shape}"
            )
        numbers = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
        points = as_stored(self._points.take(numbers, axis=0))  # those far from the origin may be gone
        of_points = {"normals": self._normals, "hu": self._hu, "labels": self._labels, "ijk": self._ijk}
        arrays = {name: _take_values(values, numbers) for name, values in of_points.items() if values is not None}
        cloud = PointCloud.of_known(points, **arrays, report=dict(self.report))
        cloud.values = {name: values[numbers] for name, values in self.values.items()}
        return cloud

    @explains_arguments
    def sample(self, volume: Volume, order: int = 1, outside: float = float("nan")) -> PointCloud:
        """Return the cloud with the values of a volume at its points as `hu`; see `Volume.sample`."""
        return self.changed(hu=Volume.sample(volume, self.points, order=order, outside=outside))

    @explains_arguments
    def in_space(self, space: str) -> tuple[NDArray[np.floating], NDArray[np.float32] | None]:
        """Return points and normals in another patient frame; the cloud itself is always LPS.

        Parameters
        ----------
        space : {"lps", "ras"}
            RAS negates x and y.

        Returns
        -------
        points : ndarray, shape (n, 3), mm, of the type of `points`
        normals : ndarray, shape (n, 3), float32, or None
        """
        return turn_to_lps(space, self._points, self._normals)  # a half turn is its own inverse

    def describe(self, space: str, *, keep_ids: bool = False, with_ijk: bool = True) -> PointContent:
        """Return the contents of a file of the cloud in ``space``; nothing else of ``report`` is ever written.

        Only with ``keep_ids`` they have the hash of the frame of reference, and only with ``with_ijk`` voxel indices.
        """
        points, normals = self.in_space(space)
        facts = facts_for_file(self.report, space, keep_ids=keep_ids)
        ijk = self.ijk if with_ijk else None
        values = checked_columns("values", self.values, "point", len(self))
        if others := [name for name in values if not name.endswith("_mm")]:
            raise UsageError(f"values of a cloud are in mm and have names that end in _mm, not {others[0]!r}")
        return PointContent(
            vertices=points, normals=normals, hu=self._hu, labels=self._labels, ijk=ijk, values=values, **facts
        )

    @explains_arguments
    def save(
        self, path: str | os.PathLike[str], space: Space = "lps", *, no_clobber: bool = False, keep_ids: bool = False
    ) -> int:
        """Write the cloud to a file; its extension gives the format.

        The file is either complete or absent, and an older file of that name is replaced in one step.  It holds no
        patient data, date or path.  docs/clouds.md says what each format keeps.

        Parameters
        ----------
        path : str or path
            ``.ply``, ``.vtp``, ``.npz``, ``.xyz`` or ``.las`` (with the extra ``las``), upper or lower case.
        space : {"lps", "ras"}
            Patient frame of the coordinates in mm; the file names it.
        no_clobber : bool
            True: a file of that name stays and is an `OutputError`.
        keep_ids : bool
            True: the comments hold the hash of the frame of reference, by which files of one scan are told.

        Returns
        -------
        int
            Size of the file in bytes.

        Raises
        ------
        UsageError
            Unknown extension or space, or laspy is needed and not installed.
        NoSurfaceError
            The cloud has no point.
        OutputError
            The file cannot be written; an older one of that name is intact.
        """
        with keep_existing(keep=no_clobber):
            return write_cloud(self, path, space, keep_ids=keep_ids)

    def to_pyvista(self) -> Any:
        """Return the cloud as ``pyvista.PolyData`` in LPS mm, sharing the memory of the arrays.

        Each point is a cell.  The point arrays are ``HU`` (the active scalars), ``label`` and ``Normals`` (the active
        normals), those that are known; the field arrays ``SPACE`` and ``UNIT`` name frame and unit.
        """
        from clrecon.exchange.vtp import wrap_cloud

        return wrap_cloud(self._points, self._normals, self._hu, self._labels)

    @classmethod
    @explains_arguments
    def from_pyvista(cls, polydata: Any, space: Space | None = None) -> PointCloud:
        """Make a cloud of the points of a ``pyvista.PolyData``.

        Parameters
        ----------
        polydata : pyvista.PolyData or vtkPolyData
            In mm.  Its point arrays ``Normals``, ``HU`` and ``label`` are taken over, as `to_pyvista` names them.
        space : {"lps", "ras"}, optional
            Patient frame of the points; None: that of the field array ``SPACE``, else LPS.

        Raises
        ------
        UsageError
            It is no PolyData, or an array has a number that a cloud cannot have; or ``space`` is not that of the array.
        """
        from clrecon.exchange.vtp import unwrap_cloud

        arrays, named = unwrap_cloud(polydata)
        return cls._of_others(arrays, choose_space(space, named, "the PolyData"))

    @classmethod
    @explains_arguments
    def from_open3d(cls, cloud: Any, space: Space = "lps") -> PointCloud:
        """Make a cloud of an ``open3d.t.geometry.PointCloud``, or of one of ``open3d.geometry``.

        Parameters
        ----------
        cloud : open3d.t.geometry.PointCloud or open3d.geometry.PointCloud
            In mm.  The attributes ``normals``, ``hu`` and ``label`` are taken over, as `to_open3d` names them.
        space : {"lps", "ras"}
            Patient frame of the points, which Open3D does not know.

        Raises
        ------
        UsageError
            It is no cloud of Open3D, or an attribute has a number that a cloud cannot have.
        """
        if hasattr(cloud, "point"):
            arrays = {name: cloud.point[name].cpu().numpy() for name in cloud.point}
            given = {"points": arrays.get("positions"), "normals": arrays.get("normals")}
            given |= {"hu": arrays.get("hu"), "labels": arrays.get("label")}
        elif hasattr(cloud, "points") and hasattr(cloud, "has_normals"):
            given = {"points": np.asarray(cloud.points)}
            given["normals"] = np.asarray(cloud.normals) if cloud.has_normals() else None
        else:
            raise UsageError(f"a {type(cloud).__name__} is no cloud of Open3D")
        return cls._of_others(given, space)

    @classmethod
    def _of_others(cls, arrays: Mapping[str, NDArray[Any] | None], space: str) -> PointCloud:
        """Make a cloud of the arrays of another library, in `space`; a column counts as a list."""
        if (points_found := arrays.get("points")) is None:
            raise UsageError("there are no points")
        points, normals = turn_to_lps(space, points_found, arrays.get("normals"))
        hu, labels = (None if (each := arrays.get(name)) is None else np.ravel(each) for name in ("hu", "labels"))
        return cls(points, normals, hu, labels)

    def to_open3d(self) -> Any:
        """Return the cloud as ``open3d.t.geometry.PointCloud`` in LPS mm, with copies of the arrays.

        The attributes are ``positions``, ``normals``, ``hu`` (n, 1) and ``label`` (n, 1), those that are known;
        ``to_legacy()`` of the result gives the class that has positions and normals alone.

        Raises
        ------
        UsageError
            open3d is not installed, or cannot be loaded.
        """
        try:
            import open3d
        except ImportError as error:
            raise UsageError(f"open3d cannot be imported ({error}): {install_command('open3d')}") from error
        columns = {
            "positions": self._points,
            "normals": self._normals,
            "hu": None if self._hu is None else self._hu[:, None],
            "label": None if self._labels is None else self._labels[:, None],
        }
        cloud, make_tensor = open3d.t.geometry.PointCloud(), cast(Any, open3d.core.Tensor)
        for name, values in columns.items():
            if values is not None:
                cloud.point[name] = make_tensor(values)
        return cloud

    def __repr__(self) -> str:
        known = [name for name in ("normals", "hu", "labels", "ijk") if getattr(self, name) is not None]
        return f"PointCloud({len(self)} points{', with ' if known else ''}{', '.join(known)}, LPS mm)"


@dataclass(frozen=True, eq=False)
class VoxelNumbers:
    """Voxels of a volume by number, ``i + ni * (j + nj * k)``, shape (n,), uint32 or int64."""

    numbers: NDArray[Any]
    shape_ijk: tuple[int, int, int]

    def slices(self) -> NDArray[Any]:
        """Return the slice k of each voxel, shape (n,)."""
        ni, nj, _ = self.shape_ijk
        kind = self.numbers.dtype.type
        return self.numbers // kind(ni) // kind(nj)  # a slice may have 2^32 voxels, their product is no uint32 then

    def take(self, chosen: NDArray[np.intp]) -> VoxelNumbers:
        """Return some of the voxels, by their places in the list."""
        return VoxelNumbers(self.numbers.take(chosen), self.shape_ijk)

    def indices(self) -> NDArray[np.int32]:
        """Return the voxel indices (i, j, k), shape (n, 3)."""
        ni, nj, _ = self.shape_ijk
        ijk = np.empty((len(self.numbers), 3), np.int32)
        rows = self.numbers // self.numbers.dtype.type(ni)
        slices = rows // self.numbers.dtype.type(nj)
        ijk[:, 0] = self.numbers - rows * self.numbers.dtype.type(ni)
        ijk[:, 1] = rows - slices * self.numbers.dtype.type(nj)
        ijk[:, 2] = slices
        return ijk


def count_numbers(numbers: NDArray[np.uint8], reasons: Sequence[str]) -> dict[str, int]:
    """Return how many points have the number of each reason, from 1: a pass for each is faster than one for all."""
    return {reason: int(np.count_nonzero(numbers == number)) for number, reason in enumerate(reasons, 1)}


@dataclass(frozen=True, eq=False, repr=False)
class PointStep:
    """The result of a function that takes a cloud and gives another one.

    Attributes
    ----------
    cloud : PointCloud
        The new cloud: the points that are kept, in the order of the input.
    removed : ndarray, shape (n,), uint8
        For each point of the input 0 if it is kept, or the number of the reason why it was removed, from 1.
    reasons : tuple of str
        The reasons: number r is ``reasons[r - 1]``, for example "noise" or "sheet".
    facts : mapping
        Further entries of the step's report: parameters as they were used, figures measured, doubtful points.
    warnings : tuple of str
        A line each.
    """

    cloud: PointCloud
    removed: NDArray[np.uint8]
    reasons: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        counts = "".join(f", {count:,} as {reason}" for reason, count in self.counts.items())
        return f"{type(self).__name__}({self.cloud!r} of {len(self.removed):,}{counts})"

    @property
    def counts(self) -> dict[str, int]:
        """Number of removed points for each reason."""
        return count_numbers(self.removed, self.reasons)

    def as_dict(self) -> dict[str, Any]:
        """Return the entries of the step's report: points before and after, removed by reason, facts."""
        return {
            "points_before": len(self.removed),
            "points_after": len(self.cloud),
            "removed": self.counts,
            **self.facts,
        }
