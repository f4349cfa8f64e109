"""Settings of the render job, validated on construction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING

from clrecon.errors import UsageError
from clrecon.jobs.render.modes import MODES, find_misplaced
from clrecon.jobs.shared.settings import InputSettings
from clrecon.system.wording import name_parameter

if TYPE_CHECKING:
    from clrecon.geometry.grid import Grid
    from clrecon.rendering.views.camera import Camera
    from clrecon.rendering.views.clip import Clip

__all__ = ["DEFAULT_SIZE", "SPINE", "LabelLook", "RenderSettings", "Turntable", "describe_presets"]

DEFAULT_SIZE = (1024, 1024)
DEFAULT_VIEWS = {"slice": "axial", "cpr": "left"}
"""Of the modes that do not look at the patient from the front."""
COMBINE = ("mean", "max", "min")
CURVED = ("straightened", "stretched")
SPINE = "auto"
"""As a curve: the spinal canal, found in the scan."""
LIGHTS = ("head", "none")


@dataclass(frozen=True)
class Turntable:
    """How a moving picture turns.

    Parameters
    ----------
    frames : int
    fps : float
        Frames a second.
    degrees : float
        From the first frame to the last, towards the patient's left.
    """

    frames: int = 100
    fps: float = 25.0
    degrees: float = 360.0


@dataclass(frozen=True)
class LabelLook:
    """Which labels look different.

    Parameters
    ----------
    path : path
        NIfTI, NRRD, MetaImage or DICOM SEG.
    colors : mapping of str to str
        Number or name of a label to a colour, see `clrecon.rendering.looks.colors.find_color`.
    opacities : mapping of str to float
        The same to a factor on its opacity.
    """

    path: str
    colors: Mapping[str, str] = field(default_factory=dict)
    opacities: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        from clrecon.rendering.looks.colors import find_color

        for color in self.colors.values():
            find_color(color)
        for label, opacity in self.opacities.items():
            if not 0.0 <= opacity <= 1.0:
                raise UsageError(f"the opacity of a label lies between 0 and 1, that of {label} is {opacity:g}")


@dataclass(frozen=True)
class RenderSettings(InputSettings):
    """How pictures are made from a CT series.

    Parameters
    ----------
    mode : str, optional
        One of `clrecon.jobs.render.modes.MODES`; default: what `iso_value` (surface), `curve` (cpr) or the preset
        ask for, else volume rendering.
    preset : str, optional
        See `clrecon.rendering.looks.presets`; default "bone" for volume rendering.
    transfer_function : str, optional
        ``FILE`` or ``FILE:NAME``, see `clrecon.rendering.looks.transfer_files.load_transfer_function`.
    iso_value : float, optional
        Of a surface, HU; default that of the renderer.
    color : str, optional
        Of a surface; default that of bone.
    depth_cue : float, optional
        Share of its brightness that a surface loses from the nearest to the farthest place.
    window : (float, float), optional
        HU that are black and white, of modes that show HU; mm of water in drr.
    views : sequence of str
        One picture each, see `clrecon.rendering.views.camera.Camera.fit`; slices know axial, coronal and sagittal too.
    up, zoom, size, view_angle
        As in `Camera.fit`; without a size 1024 x 1024, and what the curve needs for a curved reformation.
    ray_step : float, optional
        Mm; default half the smallest spacing.
    light : "head", "none", side of the patient or (x, y, z), optional
        Where the light comes from: the camera, nowhere (colours as they are), or a direction in LPS from the patient.
    shadows, jitter : bool
    clip_box : (x0, x1, y0, y1, z0, z1), optional
        What is kept, LPS mm; infinite numbers leave a side open.
    clip_planes : sequence of (px, py, pz, nx, ny, nz)
        Point and normal each; the side of the normal is kept.
    background : str
        Colour, or "transparent".
    letters, scale_bar : bool
    caption : str, optional
        Drawn into the pictures.
    thickness, combine, offset_mm
        Of slices, see `clrecon.operators.reformat.cut.cut_slice`.
    slices, slice_opacity
        Of slices in space, see `clrecon.operators.rays.slices.overlay_slices`.
    curve : str, optional
        File with the centre line, or "auto": the spinal canal, which mode cpr also takes without one.
    cpr : {"straightened", "stretched"}
    labels : LabelLook, optional
    turntable : Turntable, optional
    **shared
        See `clrecon.jobs.shared.settings.InputSettings`.

    Raises
    ------
    UsageError
        A value is impossible, means nothing in the mode, or two exclude each other.
    """

    mode: str | None = None
    preset: str | None = None
    transfer_function: str | None = None
    iso_value: float | None = None
    color: str | None = None
    depth_cue: float | None = None
    window: Sequence[float] | None = None
    views: Sequence[str] = ()
    up: str | Sequence[float] | None = None
    zoom: float = 1.0
    size: tuple[int, int] | None = None
    view_angle: float | None = None
    ray_step: float | None = None
    light: str | Sequence[float] | None = None
    shadows: bool = False
    jitter: bool = False
    clip_box: Sequence[float] | None = None
    clip_planes: Sequence[Sequence[float]] = ()
    background: str = "black"
    letters: bool = False
    scale_bar: bool = False
    caption: str | None = None
    thickness: float = 0.0
    combine: str | None = None
    offset_mm: float = 0.0
    slices: int | Sequence[int] | None = None
    slice_opacity: float | None = None
    curve: str | None = None
    cpr: str | None = None
    labels: LabelLook | None = None
    turntable: Turntable | None = None

    def __post_init__(self) -> None:
        self._check_looks()
        if self.mode_used not in MODES:
            raise UsageError(f"unknown mode {self.mode!r}: use one of {', '.join(MODES)}")
        misplaced = find_misplaced(self.mode_used, self._given())
        if misplaced:
            raise UsageError(misplaced)
        self._check_place()
        self._check_mode()
        super().__post_init__()

    def _given(self) -> set[str]:
        """Names of the settings that are not what they are by default."""
        return {own.name for own in fields(self) if getattr(self, own.name) != own.default}

    def _check_looks(self) -> None:
        from clrecon.rendering.looks.colors import find_color
        from clrecon.rendering.looks.presets import find_preset
        from clrecon.rendering.looks.window import checked_window

        if self.preset is not None:
            find_preset(self.preset)
            if self.transfer_function is not None:
                raise UsageError("give either a preset or a file with a transfer function, not both")
        if self.background != "transparent":
            find_color(self.background)
        if self.color is not None:
            find_color(self.color)
        if self.window is not None:
            checked_window(self.window)
        if isinstance(self.light, str) and self.light not in LIGHTS:
            self.light_direction()
        elif self.light is not None and not isinstance(self.light, str):
            self.light_direction()

    def _check_place(self) -> None:
        """Views, sizes, angles and clips: by placing cameras before a volume of one voxel."""
        import numpy as np

        from clrecon.geometry.grid import Grid
        from clrecon.rendering.views.directions import checked_size

        checked_size(self.size_used)
        if self.letters or self.scale_bar or self.caption:
            from clrecon.rendering.pictures.annotations import SMALLEST_SIDE

            if min(self.size_used) < SMALLEST_SIDE:
                raise UsageError(
                    f"a picture of {self.size_used[0]} x {self.size_used[1]} pixels is too small for letters, a scale"
                    f" bar or a caption: at least {SMALLEST_SIDE} x {SMALLEST_SIDE}"
                )
        if len(set(self.views)) < len(self.views):
            raise UsageError("a view is given twice")
        voxel = Grid(np.zeros((1, 1, 1), np.int8), np.eye(4))
        for view in self.views_used:
            self.camera(voxel, view)
        _ = self.clip
        if self.turntable is not None:
            from clrecon.rendering.movies.movie import turntable_cameras

            if len(self.views_used) > 1:
                raise UsageError("a turntable starts from one view: give one")
            turntable_cameras(self.camera(voxel, self.views_used[0]), self.turntable.frames, self.turntable.degrees)

    def _check_mode(self) -> None:
        if self.ray_step is not None and not 0.0 < self.ray_step < math.inf:
            raise UsageError(f"the ray step is a length in mm above 0, not {self.ray_step:g}")
        if self.iso_value is not None and not math.isfinite(self.iso_value):
            raise UsageError(f"the iso value of a surface is a number of HU, not {self.iso_value}")
        if self.depth_cue is not None and not 0.0 <= self.depth_cue <= 1.0:
            raise UsageError(f"the depth cue is a share of the brightness from 0 to 1, not {self.depth_cue:g}")
        if self.slice_opacity is not None and not 0.0 < self.slice_opacity <= 1.0:
            raise UsageError(f"the opacity of a slice lies above 0 and up to 1, not at {self.slice_opacity:g}")
        if self.shadows and self.light_direction() is None:
            raise UsageError(
                f"shadows need a light beside the camera: {name_parameter('light')} with a side of the patient, or"
                " X,Y,Z"
            )
        if not 0.0 <= self.thickness < math.inf:
            raise UsageError(f"the thickness of a slice is a length in mm, not {self.thickness:g}")
        if not math.isfinite(self.offset_mm):
            raise UsageError(f"the offset of a slice is a length in mm, not {self.offset_mm:g}")
        if self.combine is not None and self.combine not in COMBINE:
            raise UsageError(f"samples of a thick slice are combined by {', '.join(COMBINE)}, not {self.combine!r}")
        if self.cpr is not None and self.cpr not in CURVED:
            raise UsageError(f"a curved reformation is {' or '.join(CURVED)}, not {self.cpr!r}")
        if self.mode_used == "cpr" and len(self.views_used) > 1:
            raise UsageError("a curved reformation is seen from one side: give one view")

    @property
    def mode_used(self) -> str:
        """The mode that the settings come to."""
        if self.mode is not None:
            return self.mode
        if self.iso_value is not None:
            return "surface"
        if self.curve is not None:
            return "cpr"
        if self.preset is not None:
            from clrecon.rendering.looks.presets import find_preset

            return find_preset(self.preset).mode
        return "dvr"

    @property
    def preset_used(self) -> str | None:
        """Name of the preset, None where the mode or a transfer function does without."""
        if self.preset is not None or self.mode_used != "dvr" or self.transfer_function is not None:
            return self.preset
        from clrecon.rendering.looks.presets import DEFAULT_PRESET

        return DEFAULT_PRESET

    @property
    def iso_value_used(self) -> float | None:
        """HU of the surface, None in other modes."""
        if self.mode_used != "surface":
            return None
        from clrecon.operators.rays.render import DEFAULT_ISO_VALUE

        return DEFAULT_ISO_VALUE if self.iso_value is None else self.iso_value

    @property
    def views_used(self) -> tuple[str, ...]:
        """The views that pictures are taken from."""
        return tuple(self.views) or (DEFAULT_VIEWS.get(self.mode_used, "anterior"),)

    @property
    def size_used(self) -> tuple[int, int]:
        """Width and height in pixels; of a curved reformation without `size` they depend on the curve."""
        return DEFAULT_SIZE if self.size is None else self.size

    @property
    def files_read(self) -> tuple[str, ...]:
        """Files that say how, beside the scan."""
        function = self.transfer_function or ""
        curve = "" if self.curve in (None, SPINE) else self.curve
        look = "" if self.labels is None else self.labels.path
        return tuple(path for path in (function, function.rpartition(":")[0], curve, look) if path)

    @property
    def clip(self) -> Clip | None:
        """The part of space that is shown."""
        from clrecon.rendering.views.clip import Clip

        clip = Clip()
        if self.clip_box is not None:
            if len(self.clip_box) != 6:
                raise UsageError(f"a clip box has six numbers, x0,x1,y0,y1,z0,z1, not {len(self.clip_box)}")
            clip = Clip.box(self.clip_box[0::2], self.clip_box[1::2])
        for plane in self.clip_planes:
            if len(plane) != 6:
                raise UsageError(f"a clip plane is a point and a normal, six numbers, not {len(plane)}")
            clip = clip & Clip.plane(plane[:3], plane[3:])
        return clip if len(clip.planes) else None

    def light_direction(self) -> tuple[float, float, float] | None:
        """From the patient to the light, LPS; None for a light at the camera, or none at all.

        Raises
        ------
        UsageError
            Neither a side of the patient nor three numbers.
        """
        from clrecon.rendering import Lighting
        from clrecon.rendering.views.directions import DIRECTIONS

        if self.light is None or self.light in LIGHTS:
            return None
        if not isinstance(self.light, str):
            return Lighting(direction=tuple(self.light)).direction  # type: ignore[arg-type]
        if self.light not in DIRECTIONS:
            known = ", ".join((*LIGHTS, *DIRECTIONS))
            raise UsageError(f"unknown light {self.light!r}: use one of {known}, or a direction X,Y,Z in LPS")
        return DIRECTIONS[self.light]

    def camera(self, volume: Grid, view: str, turning: bool = False) -> Camera:
        """The camera of one of the views; with `turning` the volume stays whole when the camera orbits.

        Raises
        ------
        UsageError
            As `Camera.fit`.
        """
        from clrecon.rendering.views.camera import Camera

        if self.mode_used == "slice":
            from clrecon.rendering.views.plane import find_plane

            return find_plane(volume, view, self.size_used, zoom=self.zoom, up=self.up)  # type: ignore[arg-type]
        return Camera.fit(
            volume, view, self.zoom, up=self.up, view_angle=self.view_angle, size=self.size_used, turning=turning
        )


def describe_presets() -> dict[str, str]:
    """Names of the presets of pictures, and what each shows."""
    from clrecon.rendering.looks.presets import PRESETS

    return {preset.name: preset.description for preset in PRESETS.values()}
