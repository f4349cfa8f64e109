"""Numbers as the page and the console write them."""

from __future__ import annotations

import math


def seconds(value: float) -> str:
    """Write seconds with two digits that count: ``0.021``, ``0.39``, ``7.2``, ``42``."""
    if value >= 10.0:
        return f"{value:.0f}"
    return f"{value:.1f}" if value >= 1.0 else f"{value:.2f}" if value >= 0.1 else f"{value:.3f}"


def milliseconds(value: float) -> str:
    """Write milliseconds."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.1f}"


def megabytes(value: float) -> str:
    """Write bytes in MB (10^6 bytes)."""
    return f"{1e-6 * value:,.0f}"


def count(value: float) -> str:
    """Write a whole number."""
    return f"{value:,.0f}"


def share(value: float) -> str:
    """Write a share of 1, such as a Dice coefficient; 1 alone is exactly 1."""
    return "1" if value == 1.0 else f"{min(value, 0.99999):.4f}"


def signed(value: float, digits: int = 3) -> str:
    """Write a number with its sign."""
    return f"{value:+.{digits}f}"


def ratio(value: float) -> str:
    """Write a ratio of two positive numbers: ``1.3``, ``54``."""
    return f"{value:,.0f}" if value >= 10.0 else f"{value:.1f}" if math.isfinite(value) else "many"


def join(names: list[str]) -> str:
    """Join names: ``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1]))) if names else ""
