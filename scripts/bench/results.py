"""Stored results: one JSON file per case, input and device."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

SCHEMA = 1

Key = tuple[str, str, str]


def device_name(device: dict[str, Any]) -> str:
    """Short name of a device and its driver, fit for a file name: ``pocl-3.1-debian``."""
    platform = str(device["platform"]).lower()
    short = "pocl" if "portable computing" in platform else platform.split()[0] if platform.split() else "opencl"
    parts = [short] if short == "pocl" and device["type"] == "cpu" else [short, str(device["name"]).lower()]
    words = re.sub(r"\([^)]*\)", "", " ".join([*parts, str(device["driver"]).lower()]))
    return re.sub(r"[^a-z0-9.]+", "-", words).strip("-")


def result_key(result: dict[str, Any]) -> Key:
    """Return (case, input, device), which two comparable results have in common."""
    return result["case"], result["input"]["name"], device_name(result["device"])


def result_path(folder: Path, result: dict[str, Any]) -> Path:
    """Return the path of the file of a result."""
    return folder / ("-".join(result_key(result)) + ".json")


def load_results(folder: Path) -> dict[Key, dict[str, Any]]:
    """Load all results of a folder by key; other files are named on stderr and skipped."""
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is not a folder of results")
    results = {}
    for path in sorted(folder.glob("*.json")):
        try:
            result = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            result = None
        if isinstance(result, dict) and result.get("schema") == SCHEMA:
            results[result_key(result)] = result
        else:
            print(f"{path.name}: no result of this form, passed over", file=sys.stderr)
    return results


def pick(
    results: dict[Key, dict[str, Any]], cases: list[str] | None = None, ratios: list[str] | None = None
) -> dict[Key, dict[str, Any]]:
    """Pick results by cases and ratios; None means all.  Results without any such ratio are left out."""
    picked = {}
    for key, result in results.items():
        kept = {name: ratio for name, ratio in result["ratios"].items() if ratios is None or name in ratios}
        if kept and (cases is None or key[0] in cases):
            picked[key] = {**result, "ratios": kept}
    return picked
