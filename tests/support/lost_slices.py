"""Slices that are missing, and what is said of them."""

from __future__ import annotations

MISSING = "1 slice missing between -398.75 and -396.25 mm (gap 2.500 mm, usual 1.250 mm): slice001.dcm, slice003.dcm"
