"""Looks of what a view shows: states to the styles of pictures, kept from one picture to the next."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from clrecon.labels import LabelMap
from clrecon.labels.resample import ResampledLabels
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.styles import PlaneCut, Projection, SlicesInSpace, Style, SurfaceLook, VolumeLook
from clrecon.viewer.model.objects import ViewMode
from clrecon.viewer.model.state import ShownPart, ViewState

LEAST_OPACITY = 0.01
"""Meshes that are more translucent are not drawn."""

_MOST_KEPT, MOST_LABELLED = 64, 6
"""Styles that are kept, and those of them that keep a label map in memory."""

label_level = 0.5
"""Iso value of label maps that are shown alone, whose voxels are 0 and 1."""


def to_voxels(labels: LabelMap, hidden: Sequence[int] = ()) -> np.ndarray:
    """Return 1 where a map has a label, as int16."""
    shown = np.ones(int(labels.voxels.max()) + 1, np.int16)
    shown[[0, *hidden]] = 0
    return shown[labels.voxels]


class LabelledLook(NamedTuple):
    """A label map with the parts that it draws, and its place on the grid of the scan if that is known."""

    labels: LabelMap
    placed: ResampledLabels | None
    parts: tuple[ShownPart, ...]

    @property
    def is_plain(self) -> bool:
        """True where a picture without labels would be the same."""
        return all(part.is_plain for part in self.parts)


class Looks:
    """Styles by what they show: those of one state are the same objects as long as nothing of them changes."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Style] = OrderedDict()

    def scan(
        self,
        state: ViewState,
        mode: ViewMode,
        whole: ShownPart,
        labelled: LabelledLook | None,
        ray_step: float | None,
        occlusion: float = 0.0,
    ) -> Style:
        clip, of_mode = state.clip, (mode.name, state.iso_value, state.picture_window, occlusion)
        key = ("scan", of_mode, clip, whole, _key(labelled), ray_step)
        if (known := self._known(key)) is not None:
            return known
        if mode.kind == "projection":
            window = state.picture_window or mode.window
            return self._keep(key, Projection(mode.style, window=window, ray_step=ray_step, clip=clip))  # type: ignore[arg-type]
        if mode.kind == "slices":
            return self._keep(key, SlicesInSpace(window=state.picture_window, clip=clip))
        look = {
            "ray_step": ray_step,
            "ambient_occlusion": occlusion,
            "clip": clip,
            **_label_fields(labelled, whole.opacity),
        }
        if mode.kind == "volume":
            return self._keep(key, VolumeLook(mode.style, jitter=True, **look))  # type: ignore[arg-type]
        level = label_level if mode.kind == "labels" else state.iso_value
        return self._keep(key, SurfaceLook(level, color=whole.color, **look))

    def mesh(self, state: ViewState, part: ShownPart, opaque: bool) -> MeshLook:
        key = ("mesh", part, state.clip, opaque)
        opacity = 1.0 if opaque else max(part.opacity, LEAST_OPACITY)
        look = self._known(key) or self._keep(key, MeshLook(part.color, opacity=opacity, clip=state.clip))
        assert isinstance(look, MeshLook)
        return look

    def cloud(self, state: ViewState, part: ShownPart) -> PointLook:
        key = ("cloud", part.color, state.clip)
        look = self._known(key) or self._keep(key, PointLook(color=part.color, clip=state.clip))
        assert isinstance(look, PointLook)
        return look

    def plane(self, state: ViewState, labelled: LabelledLook | None, offset_mm: float) -> PlaneCut:
        """Return the style of a slice; labels are drawn over it where they have a colour."""
        key = ("plane", state.window, state.slab_mm, state.combine, _key(labelled))
        known = self._known(key)
        if known is None:
            fields: dict[str, Any] = {}
            if labelled is not None:
                drawn = [each for each in labelled.parts if each.number and each.visible and each.color is not None]
                if drawn:
                    fields = {
                        "labels": labelled.labels,
                        "label_colors": {each.number: each.color for each in drawn},
                        "label_opacity": {each.number: 0.3 * each.opacity for each in drawn},
                    }
            known = self._keep(
                key, PlaneCut(window=state.window, thickness=state.slab_mm, combine=state.combine, **fields)
            )
        assert isinstance(known, PlaneCut)
        return replace(known, offset_mm=offset_mm)

    def _known(self, key: Hashable) -> Style | None:
        style = self._kept.get(key)
        if style is not None:
            self._kept.move_to_end(key)
        return style

    def _keep(self, key: Hashable, style: Style) -> Style:
        self._kept[key] = style
        labelled = [each for each, kept in self._kept.items() if getattr(kept, "labels", None) is not None]
        for old_key in labelled[: max(0, len(labelled) - MOST_LABELLED)]:
            del self._kept[old_key]
        while len(self._kept) > _MOST_KEPT:
            self._kept.popitem(last=False)
        return style


def _key(labelled: LabelledLook | None) -> Hashable:
    """Return what labelled styles differ by; the map is kept in the style, so that no other gets its address."""
    return None if labelled is None else (id(labelled.labels), labelled.parts)


def _label_fields(labelled: LabelledLook | None, opacity: float) -> dict:
    if labelled is None:
        return {}
    colors = {each.number: each.color for each in labelled.parts if each.number and each.color is not None}
    shares = {each.number: each.opacity * opacity * each.visible for each in labelled.parts}
    if opacity < 1.0:
        shares.setdefault(0, opacity)
    return {
        "labels": labelled.labels,
        "label_colors": colors,
        "label_opacity": {number: share for number, share in shares.items() if share < 1.0},
    }
