"""A certificate that says nothing of the slices, what of one goes into files, and with what it is equal."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any

import pytest
from refusals import refused

from clrecon.geometry.certificate import Certificate, without_ids


def bare():
    needed = [one.name for one in fields(Certificate) if one.default is MISSING and one.default_factory is MISSING]
    return Certificate(**dict.fromkeys(needed))


def test_slices_are_even_and_none_is_missing_unless_said():
    assert (bare().uneven, bare().slices_missing) == (False, 0)


def test_a_certificate_is_equal_to_the_dict_of_its_entries():
    assert bare() == {**bare()} and bare() != {**bare(), "slices": 1}
    with refused(TypeError, "Certificate"):  # as a dict
        hash(bare())


@pytest.mark.parametrize(("kind", "moved"), [("DICOM", False), ("NRRD", True)])
def test_entries_of_other_files_stand_where_they_always_have(kind, moved):
    names = list(bare().changed(format=kind, masked={"more": {"a": 1}}))
    assert (names[names.index("slices_missing") + 1] == "dropped") == moved
    assert (names[names.index("rescale") + 1 :][:2] == ["padding_share", "padding_hu"]) == moved
    assert sorted(names) == sorted({field.name for field in fields(Certificate)} - {"masked"} | {"more"})


def test_files_get_no_hash_of_an_identifier():
    report: dict[str, Any] = {"series": {"number": 3, "uid_hash": "a"}, "frame_of_reference_hash": "b", "slices": 5}
    found = without_ids(report)
    assert found == {"series": {"number": 3, "uid_hash": None}, "frame_of_reference_hash": None, "slices": 5}
    assert report["frame_of_reference_hash"] == "b" and report["series"]["uid_hash"] == "a"
    assert without_ids({"series": None}) == {"series": None}
