"""`VertebraeReport`: what a vertebrae job found and wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from clrecon.geometry.certificate import without_ids
from clrecon.jobs.shared.report import peak_memory_bytes, platform_name
from clrecon.system.records import Record
from clrecon.version import package_version

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.jobs.vertebrae.settings import VertebraeSettings
    from clrecon.spine import VertebraSplit


@dataclass(frozen=True, eq=False)
class VertebraeReport(Record):
    """Report of `make_vertebrae`.

    vertebrae: All that were found, from the head downwards, see `clrecon.spine.split.Vertebra`.
    low_confidence: How many of them have a confidence below 0.5.
    written: How many the label map has.
    discs: ``centre_mm`` and ``normal`` (downwards) of each disc, LPS.
    output: ``format`` and ``bytes`` of the label map.
    volume: The certificate of the volume without its warnings.
    """

    vertebrae: list[Any]
    low_confidence: int
    written: int
    discs: list[dict[str, list[float]]]
    left_out: list[str]
    level_hu: float
    output: Mapping[str, Any]
    version: str
    platform: str
    warnings: list[str]
    volume: Mapping[str, Any]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None


def describe_split(
    volume: Volume,
    split: VertebraSplit,
    settings: VertebraeSettings,
    output: Mapping[str, Any],
    seconds: Mapping[str, float],
) -> VertebraeReport:
    """Describe the result of a job."""
    certificate = dict(volume.report) if settings.keep_ids else without_ids(volume.report)
    told = [str(warning) for warning in certificate.pop("warnings", [])]
    fate = "is in the label map all the same" if settings.keep_unsure else "is not in the label map"
    told += [
        f"{one.name} has low confidence ({one.confidence:.2f}) and {fate}: {'; '.join(one.doubts)}"
        for one in split.low_confidence
    ]
    if (settings.name_at or settings.first) is not None and split.low_confidence:
        told.append("names are counted past vertebrae of low confidence: check them with the picture")
    rounded = [
        {"centre_mm": [round(float(v), 2) for v in centre], "normal": [round(float(v), 4) for v in normal]}
        for centre, normal in zip(split.discs_mm, split.disc_normals, strict=True)
    ]
    return VertebraeReport(
        vertebrae=split.vertebrae,
        low_confidence=len(split.low_confidence),
        written=len(split.labels.numbers),
        discs=rounded,
        left_out=split.left_out,
        level_hu=split.level_hu,
        output=output,
        version=package_version(),
        platform=platform_name(),
        warnings=list(dict.fromkeys(told)),
        volume=certificate,
        seconds=seconds,
        peak_memory_bytes=peak_memory_bytes(),
    )
