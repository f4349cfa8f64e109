"""`RunReport`: the common part of all reports, which jobs return and write to ``report_path``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from clrecon.system.records import Record


class RunReport(Record):
    """The entries that all reports share; each report is a dataclass with these fields and its own, in JSON order.

    affine_ijk_to_lps_mm: nested list (4, 4)
    memory_allowed_bytes: Most bytes that may be taken on the device; None: all.
    version, platform: Version of clrecon; system, machine and Python.
    warnings: Those of the volume first, each once.
    volume: The `Certificate` of the volume without its warnings.
    seconds: Seconds by part of the job, with ``other`` and ``total``.
    """

    affine_ijk_to_lps_mm: list[list[float]]
    device: str
    driver: str
    memory_allowed_bytes: int | None
    version: str
    platform: str
    warnings: list[str]
    volume: Mapping[str, Any]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None
