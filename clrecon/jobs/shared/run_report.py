"""`RunReport`: what a job writes with ``report_path``, and gives back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from clrecon.system.records import Record

__all__ = ["RunReport"]


class RunReport(Record):
    """What the reports of all jobs say; each is a dataclass with these fields among its own, in the order of its JSON.

    Attributes
    ----------
    affine_ijk_to_lps_mm : nested list (4, 4)
    device, driver : str
    memory_allowed_bytes : int or None
        What may be taken on the device; None: all of it.
    version, platform : str
        Of clrecon; system, machine and Python.
    warnings : list of str
        Those of the volume first, each once.
    volume : mapping
        The `Certificate` of the volume without its warnings.
    seconds : mapping of str to float
        By part of the job, with ``other`` and ``total``.
    peak_memory_bytes : int or None
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
