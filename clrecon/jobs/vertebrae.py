"""The vertebrae job: a CT series in, a first guess of a label map out, with a picture to judge it by."""

from __future__ import annotations

import os
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.jobs.run import ArchiveTarget, Run, ScanReport
from clrecon.jobs.settings import VertebraeSettings
from clrecon.labels.label_map import encode_nifti, load_nibabel
from clrecon.labels.write_segmentation import encode_identified, encode_segmentation
from clrecon.reading import tell_format
from clrecon.reading.dicom.reader import list_slices
from clrecon.rendering.pictures.label_style import distinct_colors
from clrecon.rendering.pictures.pillow import load_font, load_pillow
from clrecon.system.light_dataclass import dataclass

if TYPE_CHECKING:
    from clrecon.labels import LabelMap
    from clrecon.spine import VertebraSplit
    from clrecon.spine.split import Vertebra


@dataclass(frozen=True, eq=False, kw_only=True)
class VertebraeReport(ScanReport):
    SCHEMA = "vertebrae"

    _LEFT_OUT = ("stored",)

    vertebrae: list[Vertebra]
    low_confidence: int
    written: int
    discs: list[dict[str, list[float]]]
    left_out: list[str]
    level_hu: float
    output: Mapping[str, Any]
    stored: Mapping[str, int] | None = None


def make_vertebrae(
    source: str | Path,
    output: str | Path,
    settings: VertebraeSettings | None = None,
    *,
    picture_path: str | Path | None = None,
    with_picture: bool = True,
    report_path: str | Path | None = None,
    store: str | None = None,
    **how: Any,
) -> VertebraeReport:
    """Read a CT series, find its vertebrae, and write a label map, and a PNG, by default beside it."""
    from clrecon.spine import split_vertebrae

    settings = settings or VertebraeSettings()
    picture = picture_beside(output) if picture_path is None and with_picture else picture_path
    with Run(settings, **how) as run:
        run.check([("the label map", output), ("the picture", picture), ("the report", report_path)], source)
        target = None if store is None else ArchiveTarget(store, source, run)
        if target is not None:
            source = target.source
        elif map_format(output) in _SEGMENTATION:  # whose slices are read twice
            source = run.open(source)
        _check_formats(source, output, picture)
        volume = run.read(source)
        run.lap("read")
        split = split_vertebrae(
            volume,
            level=settings.level,
            seeds=list(settings.seeds) or None,
            name_at=settings.name_at,
            first=settings.first,
            keep_unsure=settings.keep_unsure,
            progress=run.progress,
        )
        run.lap("split")
        run.progress("write", 0, 0)
        file = run.write(output, _encode_map(split.labels, output, source, settings))
        if picture is not None:
            run.write(picture, draw_vertebrae(split))
        stored = None
        if target is not None:
            stored = target.store([encode_identified(split.labels, list_slices(source, settings), target.origin)])
        run.lap("write")
        discs = [
            {"centre_mm": [round(float(v), 2) for v in centre], "normal": [round(float(v), 4) for v in normal]}
            for centre, normal in zip(split.discs_mm, split.disc_normals, strict=True)
        ]
        fate = "is in the label map all the same" if settings.keep_unsure else "is not in the label map"
        warnings = [
            f"{one.name} has low confidence ({one.confidence:.2f}) and {fate}: {'; '.join(one.doubts)}"
            for one in split.low_confidence
        ]
        if (settings.name_at or settings.first) is not None and split.low_confidence:
            warnings.append("names are counted past vertebrae of low confidence: check them with the picture")
        report = run.report(
            VertebraeReport,
            warnings,
            volume,
            vertebrae=split.vertebrae,
            low_confidence=len(split.low_confidence),
            written=len(split.labels.numbers),
            discs=discs,
            left_out=split.left_out,
            level_hu=split.level_hu,
            output={"format": map_format(output), "bytes": file.size},
            stored=stored,
        )
        return run.finish(report, report_path)


def _check_formats(source: str | Path, output: str | Path, picture: str | Path | None) -> None:
    kind = map_format(output)
    if kind in _NIFTI:
        load_nibabel()
    elif (form := tell_format(source)) is not None:
        raise UsageError(f"DICOM SEG belongs to a scan in DICOM, and this is {form}: write the label map as .nii.gz")
    if picture is not None and not os.fspath(picture).lower().endswith(".png"):
        raise UsageError(f"the picture of the discs is a .png file, not {os.path.basename(os.fspath(picture))[-40:]!r}")
    if picture is not None:
        load_pillow()


def _encode_map(labels: LabelMap, output: str | Path, source: str | Path, settings: VertebraeSettings) -> bytes:
    kind = map_format(output)
    if kind in _SEGMENTATION:
        return encode_segmentation(labels, list_slices(source, settings))
    return encode_nifti(labels, packed=kind.endswith(".gz"))


_NIFTI, _SEGMENTATION = ("nii", "nii.gz"), ("dcm",)


def map_format(path: str | Path) -> str:
    name = os.path.basename(os.fspath(path)).lower()
    for kind in (*_NIFTI[::-1], *_SEGMENTATION):
        if name.endswith(f".{kind}") and name != f".{kind}":
            return kind
    raise UsageError(f"a label map is written as .nii.gz, .nii (NIfTI) or .dcm (DICOM SEG), not {name[-40:]!r}")


def picture_beside(output: str | Path) -> str:
    """Return the name of the picture beside a label map: ``spine.nii.gz`` has ``spine.png``."""
    text = os.fspath(output)
    return text[: -len(map_format(output)) - 1] + ".png"


_PIXELS_PER_MM = 3
WINDOW_HU = (-150.0, 650.0)
_TINT = 0.35
"""Share of a vertebra's colour in its pixels."""
_LOW_COLOR = (255, 40, 40)
_LINE_COLOR = (255, 230, 0)
_TEXT_MM = 6.0
_NAMES_MM = 62


def draw_vertebrae(split: VertebraSplit) -> bytes:
    """Return a PNG of the straightened spine, side and front, a row a mm; low confidence is hatched in red."""
    load_pillow()
    from PIL import Image, ImageDraw

    plane = split.plane
    colors = (255 * distinct_colors(len(split.vertebrae))).astype(np.uint8)
    shades = {one.number: np.array(shade) for one, shade in zip(split.vertebrae, colors, strict=True)}
    doubted = [one.number for one in split.low_confidence]
    left = _tint_slice(plane.sagittal, plane.sagittal_labels, shades, doubted)
    right = _tint_slice(plane.coronal, plane.coronal_labels, shades, doubted)
    gap = np.zeros((len(left), _NAMES_MM * _PIXELS_PER_MM, 3), np.uint8)
    picture = Image.fromarray(np.concatenate([left, gap, right], axis=1))
    pen = ImageDraw.Draw(picture)
    for front, back in plane.lines:
        ends = [((column + 0.5) * _PIXELS_PER_MM, (row + 0.5) * _PIXELS_PER_MM) for row, column in (front, back)]
        pen.line(ends, fill=_LINE_COLOR, width=2)
        row = 0.5 * (front[0] + back[0])
        start = left.shape[1] + gap.shape[1], (row + 0.5) * _PIXELS_PER_MM
        pen.line([start, (picture.width, start[1])], fill=_LINE_COLOR, width=1)
    font = load_font(_TEXT_MM * _PIXELS_PER_MM)
    for item, row in zip(split.vertebrae, split.plane.rows, strict=True):
        text = (
            f"{item.name}  {item.confidence:.2f}"
            + ("" if item.is_confident else "  low")
            + ("" if item.whole else "  cut")
        )
        color = tuple(int(value) for value in shades[item.number]) if item.is_confident else _LOW_COLOR
        pen.text((left.shape[1] + 6, (row + 0.5) * _PIXELS_PER_MM), text, color, font, "lm")
    stream = BytesIO()
    picture.save(stream, "PNG")
    return stream.getvalue()


def _tint_slice(
    values: NDArray[np.float32], labels: NDArray[np.int32], shades: dict[int, NDArray[np.uint8]], doubted: list[int]
) -> NDArray[np.uint8]:
    """Return grey values with the colours of the vertebrae over them, enlarged."""
    low, high = WINDOW_HU
    grey = np.clip((np.nan_to_num(values, nan=low) - low) / (high - low), 0.0, 1.0) * 255.0
    large = np.repeat(np.repeat(grey, _PIXELS_PER_MM, axis=0), _PIXELS_PER_MM, axis=1)
    numbers = np.repeat(np.repeat(labels, _PIXELS_PER_MM, axis=0), _PIXELS_PER_MM, axis=1)
    picture = np.repeat(large[..., None], 3, axis=2)
    rows, columns = np.indices(numbers.shape)
    for number, shade in shades.items():
        pixels = numbers == number
        if number in doubted:
            pixels &= (rows + columns) % 12 < 4
            shade = np.array(_LOW_COLOR)
        picture[pixels] = (1.0 - _TINT) * picture[pixels] + _TINT * shade
    return np.asarray(np.rint(picture), dtype=np.uint8)
