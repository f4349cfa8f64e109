"""A certificate that says nothing of the slices, what of one goes into files, and with what it is equal."""

from __future__ import annotations

import copy
from dataclasses import MISSING, fields
from typing import Any

import pytest
from refusals import refused

from clrecon.geometry.certificate import Certificate, without_ids


def certificate_of_needed_entries() -> Certificate:
    """Every entry that has no default is None."""
    needed = [field.name for field in fields(Certificate) if field.default is MISSING is field.default_factory]
    return Certificate(**dict.fromkeys(needed))


def test_slices_of_a_certificate_are_even_and_none_is_missing_by_default():
    certificate = certificate_of_needed_entries()
    assert (certificate.uneven, certificate.slices_missing) == (False, 0)


def test_a_certificate_is_equal_to_the_dictionary_of_its_entries_and_not_to_one_that_differs_in_an_entry():
    certificate = certificate_of_needed_entries()
    assert certificate == {**certificate}
    assert certificate != {**certificate, "slices": 1}


def test_a_certificate_has_no_hash_like_a_dictionary():
    with refused(TypeError, "Certificate"):
        hash(certificate_of_needed_entries())


@pytest.fixture(params=[("DICOM", False), ("NRRD", True)], ids=["DICOM", "NRRD"])
def entry_names(request):
    """Whether the file is none of DICOM, and the names of the entries of its certificate, in their order."""
    kind, is_other = request.param
    return is_other, list(certificate_of_needed_entries().changed(format=kind, masked={"more": {"a": 1}}))


def test_dropped_slices_and_padding_stand_elsewhere_in_certificates_of_dicom_and_of_other_files(entry_names):
    is_other, names = entry_names
    after_missing, after_rescale = names.index("slices_missing") + 1, names.index("rescale") + 1
    assert (names[after_missing] == "dropped") == is_other
    assert (names[after_rescale : after_rescale + 2] == ["padding_share", "padding_hu"]) == is_other


def test_a_certificate_lists_each_field_once_and_what_was_masked_by_its_own_name(entry_names):
    _, names = entry_names
    assert sorted(names) == sorted({field.name for field in fields(Certificate)} - {"masked"} | {"more"})


def test_hashes_of_identifiers_are_none_in_what_goes_into_files_and_stay_in_the_report():
    report: dict[str, Any] = {"series": {"number": 3, "uid_hash": "a"}, "frame_of_reference_hash": "b", "slices": 5}
    before = copy.deepcopy(report)
    expected = {"series": {"number": 3, "uid_hash": None}, "frame_of_reference_hash": None, "slices": 5}
    assert without_ids(report) == expected
    assert report == before


def test_a_report_without_a_series_stays_as_it_is_in_files():
    assert without_ids({"series": None}) == {"series": None}
