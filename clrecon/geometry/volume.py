"""`Volume`: voxels and the affine that places them in the patient, its parts, and its ways to other libraries."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import map_points
from clrecon.geometry.blocks import CROPS, crop_box, crop_volume, find_extent, slice_volume
from clrecon.geometry.grid import BaseVolume
from clrecon.geometry.images import image_of, make_nibabel, make_sitk, take_nibabel, take_sitk
from clrecon.geometry.resample import resample_volume, sample_volume
from clrecon.system.arguments import Space, explains_arguments
from clrecon.system.packages import ShownAsHtml, public_function
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress

Own = TypeVar("Own", bound="Volume")


class Volume(BaseVolume, ShownAsHtml):
    """Voxels in HU with the affine that places them in the patient.

    ``np.asarray(volume)`` are its voxels, without a copy.  ``volume[k0:k1, j0:j1, i0:i1]`` is a part of it at its own
    place, in the axis order of ``shape`` and of the voxels.

    Parameters
    ----------
    voxels : array_like, shape (nk, nj, ni)
        One value a voxel, indexed ``voxels[k, j, i]``: i runs along a DICOM row (the column index), j over the
        rows, k over the slices.  int8, uint8, int16, uint16, int32 and float32 are kept as they are (and not
        copied when C-contiguous); bool becomes uint8, other floats float32, other integers int32.  An array of zarr,
        Dask or h5py is read by layers of its chunks, into a temporary file where the free memory is too small.
    affine : array_like, shape (4, 4)
        Index (i, j, k) to LPS mm, see ``clrecon.geometry.affine``.
    report : dict, optional
        What is known of the origin and the quality of this volume; `read_volume` gives a ``Certificate``.
    slice_positions : array_like, shape (nk, 3), optional
        LPS mm of voxel (0, 0, k), for slices that no single affine places.  Between two slices k runs linearly, beyond
        the ends in the steps of the ends.  The third column of ``affine`` is then only nominal.
    hu_range : (float, float), optional
        Lowest and highest value, if the caller knows them; else they are found when first asked for.

    Raises
    ------
    UsageError
        ``voxels`` is not three-dimensional, empty, or of a type that cannot be used; ``affine`` is not an affine;
        ``slice_positions`` do not match the affine.
    """

    __iter__ = None  # without it Python would try volume[0], volume[1], ...

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the box round the voxels' centres, shape (2, 3), LPS mm."""
        return np.array(find_extent(self))

    def __getitem__(self: Own, key: Any) -> Own:
        """Return the part of the volume between indices along k, j, i; its voxels keep their places in the patient.

        Ranges are taken as numpy takes them, steps and negative steps included, and never smoothed: ``volume[::2]``
        has every other slice and twice the spacing.  A single index is refused, as by nibabel's ``slicer``, since
        ``volume[7]`` would have no slice step; ``volume[7:8]`` has.  Uneven slices keep their own positions, and get an
        affine where those left are even (within 0.01 mm or 1 % of the gap, as on reading).  Voxels are shared where
        numpy can.

        The certificate stays, with shape, place and range of the part, its entry ``sliced`` and a warning; its gates
        are those of the scan as it was read.
        """
        return slice_volume(self, key)

    @explains_arguments
    def crop(
        self: Own,
        *,
        clip_box: Sequence[float | None] | None = None,
        between: Sequence[float | None] | None = None,
        around: Sequence[float] | None = None,
        margin: int = 0,
        space: Space = "lps",
    ) -> Own:
        """Return the smallest block of whole voxels that holds every voxel centre in a box of mm; see docs/export.md.

        The certificate stays, with shape, place and range of the part, its entry ``crop`` and a warning.

        Parameters
        ----------
        clip_box : (x0, x1, y0, y1, z0, z1), optional
            A box along the patient's axes, mm; None leaves a side open.
        between : (z0, z1), optional
            Two heights, mm; one of them may be None.
        around : (x, y, z, r), optional
            A cube, r mm from a point to each side.  Of several, what is in all of them stays.
        margin : int
            Voxels more on each side, as far as the volume goes.
        space : {"lps", "ras"}
            Patient frame of the numbers.

        Raises
        ------
        UsageError
            No box is given, one is none, or no voxel centre lies in it.
        """
        box = crop_box(clip_box, between, around)
        if box is None:
            raise UsageError(f"a crop needs a box: {', '.join(CROPS[:-1])} or {CROPS[-1]}")
        return crop_volume(self, *box, margin=margin, space=space)

    @explains_arguments
    def sample(self, points: ArrayLike, *, order: int = 1, outside: float = float("nan")) -> Any:
        """Return the HU at points of the patient; uneven and tilted slices are where they are.

        Parameters
        ----------
        points : array_like, shape (n, 3) or (3,)
            LPS mm, such as ``mesh.vertices``.
        order : {0, 1, 3}
            0 takes the nearest voxel, 1 is trilinear, 3 a cubic spline, which may exceed the values around it.
        outside : float
            Value more than half a voxel beyond the outer voxel centres, and where a point is not finite.

        Returns
        -------
        ndarray, shape (n,), float64, or float for one point

        Raises
        ------
        UsageError
            ``points`` are none, or the order is another.
        """
        return map_points(lambda lps: sample_volume(self, lps, order, outside), points)

    @explains_arguments
    def resample(self: Own, to: float | Sequence[float] | Volume, *, progress: Progress | None = None) -> Own:
        """Return a copy (trilinear) on a regular grid with other steps, or on the grid of another volume.

        Of a regular grid, i runs as in the volume, j within the plane of its slices, k along their normal, at right
        angles: uneven and tilted slices become even and straight.  Points beyond the voxels are ``AIR_HU``.  The
        certificate stays, with the new shape and place, its entry ``resampled`` and a warning.  Longer steps take
        single values and no means: smooth the volume first where that matters.

        Parameters
        ----------
        to : float, (float, float, float) or Volume
            One step in mm, or those along i, j and k; or a volume at whose voxel centres the values are taken.
        progress : callable, optional
            ``progress("resample", done, total)`` in slices.

        Raises
        ------
        UsageError
            A step is no length, or below 0.01 mm; or the two volumes have no place in common.
        RefusedInputError
            The result would have more than 2^31 voxels.
        """
        return resample_volume(self, to, progress=progress)

    @explains_arguments
    def save(
        self,
        path: str | os.PathLike[str],
        *,
        resample: float | None = None,
        no_clobber: bool = False,
        keep_ids: bool = False,
        progress: Progress | None = None,
    ) -> int:
        """Write the volume to .nii.gz, .nii, .nrrd or .mha, as `clrecon.write_volume` does: with its certificate.

        Parameters
        ----------
        path : str or path
        resample : float, optional
            Step in mm of a regular grid, which uneven slices need, and in .mha sheared axes.
        no_clobber : bool
            True: a file of that name stays and is an `OutputError`.
        keep_ids : bool
            True: the file holds the hash of the frame of reference.
        progress : callable, optional
            ``progress("write", done, total)`` in slices.

        Returns
        -------
        int
            Size of the file in bytes.

        Raises
        ------
        UsageError, OutputError
            As `clrecon.write_volume`.
        """
        with keep_existing(keep=no_clobber):
            write_volume = public_function("write_volume")
            return int(write_volume(self, path, resample=resample, keep_ids=keep_ids, progress=progress))

    @explains_arguments
    def to_pyvista(self, *, resample: bool = False) -> Any:
        """Return the volume as ``pyvista.ImageData`` in LPS mm, its HU as the active point data ``HU``.

        The points lie where ``ijk_to_lps`` puts the voxels, i runs fastest.  The image shares the memory of the voxels:
        a change of one is a change of the other.  It is a copy where the axes are left-handed (a field array ``SLICES``
        then says that the slices are in reverse order, which VTK needs) or where it is resampled.  Field arrays
        ``SPACE`` and ``UNIT`` say what the coordinates are.  The certificate does not go with it.

        Contour it with ``image.contour([250], method="flying_edges")``: pyvista's default method does not look at an
        image's direction.

        Parameters
        ----------
        resample : bool
            A sheared or unevenly spaced volume, which no image can hold, is resampled (trilinear) to a regular grid
            around all its voxels, i and j in their own steps and k in the smallest step of the slices; points beyond
            the voxels are ``AIR_HU``.  A field array ``RESAMPLED`` says so.  Other volumes stay as they are.

        Raises
        ------
        UsageError
            The volume is sheared or unevenly spaced, and is not to be resampled.
        RefusedInputError
            Resampled it would have more than 2^31 voxels: `resample` with a longer step comes first.
        """
        from clrecon.geometry.vtk import make_image_data

        return make_image_data(image_of(self, resample, "to_pyvista"))

    @classmethod
    def _of(cls: type[Own], *parts: Any) -> Own:
        return cls(*parts)

    @classmethod
    @explains_arguments
    def from_pyvista(cls: type[Own], image: Any, name: str | None = None, space: Space | None = None) -> Own:
        """Make a volume of a ``pyvista.ImageData``, or ``vtkImageData``; its voxels are a copy.

        It has no certificate: its HU are not verified.  What `to_pyvista` turned round comes back as it was.

        Parameters
        ----------
        image : pyvista.ImageData
            In mm, with one number at each point.
        name : str, optional
            Name of the point data; None: the active scalars.
        space : {"lps", "ras"}, optional
            Patient frame of the points; None: that of the field array ``SPACE``, which `to_pyvista` writes, else LPS.

        Raises
        ------
        UsageError
            It is no ImageData, has no such point data, or several numbers a point; ``space`` is not that of the array.
        """
        from clrecon.geometry.vtk import take_image_data

        return cls._of(*take_image_data(image, name, space))

    @explains_arguments
    def to_sitk(self, *, resample: bool = False) -> Any:
        """Return the volume as ``SimpleITK.Image``, a copy in LPS mm, ITK's own frame.

        The type stays, left-handed axes too.  The certificate does not go with it: `save` writes it.

        Parameters
        ----------
        resample : bool
            As in `to_pyvista`: of sheared or unevenly spaced volumes, which such an image cannot hold.

        Raises
        ------
        UsageError
            The volume is sheared or unevenly spaced and is not to be resampled, or SimpleITK is not installed.
        RefusedInputError
            As `to_pyvista`.
        """
        image = image_of(self, resample, "to_sitk")
        return make_sitk(image.voxels, image.affine)

    @classmethod
    def from_sitk(cls: type[Own], image: Any) -> Own:
        """Make a volume of a ``SimpleITK.Image`` of three axes, LPS mm; its voxels are a copy.

        It has no certificate, and nothing of the image's metadata: its HU are not verified.

        Raises
        ------
        UsageError
            It is no image of three axes with one real number a voxel, or SimpleITK is not installed.
        """
        return cls._of(*take_sitk(image))

    @explains_arguments
    def to_nibabel(self, *, resample: bool = False) -> Any:
        """Return the volume as ``nibabel.Nifti1Image``: array (i, j, k) on the memory of the voxels, affine to RAS mm.

        Sheared and left-handed axes stay as they are.  The certificate does not go with it: `save` writes it.

        Parameters
        ----------
        resample : bool
            As in `to_pyvista`, of unevenly spaced volumes, which have no affine.

        Raises
        ------
        UsageError
            The volume is unevenly spaced and is not to be resampled, or nibabel is not installed.
        RefusedInputError
            As `to_pyvista`.
        """
        image = image_of(self, resample, "to_nibabel", holds_shear=True)
        return make_nibabel(image.voxels, image.affine)

    @classmethod
    def from_nibabel(cls: type[Own], image: Any) -> Own:
        """Make a volume of an image of nibabel: its affine leads to RAS, that of the volume to LPS mm.

        Values are as slope and intercept of the header make them; whole numbers stay whole.  It has no certificate:
        its HU are not verified.  `clrecon.read_volume` of a file also says where sform, qform and pixdim disagree.

        Raises
        ------
        UsageError
            It is no image of three axes with one real number a voxel, does not say where it lies, or nibabel is not
            installed.
        """
        return cls._of(*take_nibabel(image))

    @explains_arguments
    def show(self, iso_value: float | Literal["auto"] | None = None, *, device: Any = None) -> None:
        """Show the surface at an iso value, which a slider sets, in a window of pyvista; see `clrecon.show`.

        Parameters
        ----------
        iso_value : float or "auto", optional
            HU at the start, 200 by default.
        device : Device, str or int, optional
            See `clrecon.device`; None is the best of the machine.

        Raises
        ------
        UsageError
            There is no display, or OpenGL does not work on it.
        DeviceError
            The device does not exist.
        """
        given = {"iso_value": iso_value, "device": device}
        public_function("show")(self, **{name: value for name, value in given.items() if value is not None})

    @explains_arguments
    def view(self, iso_value: float | Literal["auto"] | None = None, *, device: Any = None) -> Any:
        """Return the page of ``clrecon view``, which a notebook shows in the cell; see `clrecon.show`.

        Parameters
        ----------
        iso_value : float or "auto", optional
            HU of the surface at the start; without one the page begins with the bone by volume rendering.
        device : Device, str or int, optional
            See `clrecon.device`; None is the best of the machine.

        Returns
        -------
        LivePage
            The page, with ``address``, ``open()`` and ``close()``.

        Raises
        ------
        DeviceError
            The device does not exist.
        """
        return public_function("show")(self, iso_value=iso_value, device=device, page=True)

    def __repr__(self) -> str:
        ni, nj, nk = self.shape_ijk
        di, dj, dk = self.spacing
        uneven = ", uneven slices" * self.uneven
        return f"Volume({ni} x {nj} x {nk} {self.dtype}, spacing {di:.4g} x {dj:.4g} x {dk:.4g} mm{uneven})"
