"""Comparison of new results with a stored baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from results import Key
from tables import markdown


@dataclass(frozen=True)
class Change:
    """One ratio of one result, before and now.

    fell: True for a loss that neither spread explains: the new median lies more than the allowed share below the lower
    quartile of the baseline, and the new upper quartile lies below the baseline's median.
    """

    key: Key
    ratio: str
    before: dict[str, float]
    now: dict[str, float]
    fell: bool

    @property
    def share(self) -> float:
        """New median divided by the old one."""
        return self.now["median"] / self.before["median"]


def has_fallen(before: dict[str, float], now: dict[str, float], percent: float) -> bool:
    """See `Change.fell`."""
    return now["median"] < before["q1"] * (1.0 - percent / 100.0) and now["q3"] < before["median"]


def compare_results(
    baseline: dict[Key, dict[str, Any]], new: dict[Key, dict[str, Any]], percent: float
) -> tuple[list[Change], list[str]]:
    """Compare the ratios that both sides have.

    baseline, new: Results from `results.load_results`.
    percent: Allowed fall of a ratio below the spread of the baseline.
    left_out: Descriptions of results that only one side has.
    """
    changes, left_out = [], []
    for key in sorted({*baseline, *new}):
        if key not in new or key not in baseline:
            left_out.append(f"{' '.join(key)}: only in the {'baseline' if key in baseline else 'new results'}")
            continue
        before, now = baseline[key]["ratios"], new[key]["ratios"]
        for name in before:
            if name not in now:
                left_out.append(f"{' '.join(key)}: the ratio {name} is missing in the new results")
            else:
                fell = has_fallen(before[name], now[name], percent)
                changes.append(Change(key, name, before[name], now[name], fell))
    return changes, left_out


def _ratio(ratio: dict[str, float]) -> str:
    return f"{ratio['median']:.2f} ({ratio['q1']:.2f} to {ratio['q3']:.2f})"


def format_changes(changes: list[Change]) -> str:
    """Make a table for people."""
    rows = [
        (*change.key, change.ratio, _ratio(change.before), _ratio(change.now), f"{change.share:.2f}",
         "FELL" if change.fell else "")
        for change in changes
    ]  # fmt: skip
    return markdown(("case", "input", "device", "ratio", "baseline", "new", "new / old", ""), rows)
