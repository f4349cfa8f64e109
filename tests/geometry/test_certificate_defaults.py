"""A certificate that says nothing of the slices: none is missing, and they are even."""

from __future__ import annotations

from dataclasses import MISSING, fields

from clrecon.geometry.certificate import Certificate


def test_slices_are_even_and_none_is_missing_unless_said():
    needed = [one.name for one in fields(Certificate) if one.default is MISSING and one.default_factory is MISSING]
    bare = Certificate(**dict.fromkeys(needed))
    assert (bare.uneven, bare.slices_missing) == (False, 0)
