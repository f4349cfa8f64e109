"""Proof, right of the product: numpy twins with their checks, phantoms, comparison, bench."""

from __future__ import annotations
