"""Symbolic links: followed on request only, and never left out of a series without a word."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest
from dicom_series import Plan, write_series
from refusals import refused

from clrecon.errors import NoDicomError, RefusedInputError
from clrecon.reading import Selection, list_series, read_volume
from clrecon.reading.dicom.reader import list_slices

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="links need a right there")


def move_out(folder, names, store):
    """Put files into a store, as git-annex does, and links in their places."""
    store.mkdir()
    for number, name in enumerate(names):
        (folder / name).rename(store / f"object{number}")
        os.symlink(os.path.relpath(store / f"object{number}", folder), folder / name)


@pytest.fixture
def plan(tmp_path):
    return write_series(tmp_path / "ct", Plan(shape=(9, 5, 6)))


@pytest.mark.parametrize("places", [[1, 3, 5, 7], [8], [0]], ids=["every second", "last", "first"])
def test_slices_that_are_links_refuse_the_series_unless_they_are_followed(tmp_path, plan, places):
    move_out(tmp_path / "ct", map(plan.name, places), tmp_path / "store")
    with refused(RefusedInputError, plan.name(places[0]), "follow_links=True"):
        read_volume(tmp_path / "ct")
    listing = list_series(tmp_path / "ct")
    assert listing.skipped == {"link out of the folder": len(places)}
    assert f"{len(places)} skipped: link out of the folder" in listing.warnings
    assert [gate.measured for gate in listing.certificate.gates if gate.name == "readable"] == [len(places)]
    volume = read_volume(tmp_path / "ct", follow_links=True)
    assert np.array_equal(volume.voxels, plan.hu()) and volume.report["warnings"] == []
    assert list_series(tmp_path / "ct", follow_links=True).series[0].slices == 9
    assert len(list_slices(tmp_path / "ct", Selection(follow_links=True))) == 9


def test_a_folder_of_links_alone_says_how_they_are_followed(tmp_path, plan):
    move_out(tmp_path / "ct", map(plan.name, range(9)), tmp_path / "store")
    with refused(NoDicomError, "follow_links=True", 9):
        read_volume(tmp_path / "ct")
    assert np.array_equal(read_volume(tmp_path / "ct", follow_links=True).voxels, plan.hu())


def test_a_link_that_leads_nowhere_may_have_been_a_slice(tmp_path, plan):
    (tmp_path / "ct" / plan.name(8)).unlink()
    os.symlink("../.git/annex/objects/lost", tmp_path / "ct" / plan.name(8))
    os.symlink("round", tmp_path / "ct" / "round")
    for follow in (False, True):
        with refused(RefusedInputError, "slice008.dcm"):
            read_volume(tmp_path / "ct", follow_links=follow)
    assert list_series(tmp_path / "ct").skipped == {"link to a file that is not there": 2}


@pytest.mark.parametrize("beside", [True, False], ids=["beside the slices", "elsewhere"])
def test_link_to_a_folder_refuses_only_a_series_beside_it(tmp_path, plan, beside):
    """It refuses only a series that has slices beside it."""
    whole = write_series(tmp_path / "other", Plan(series=2, shape=(7, 5, 6)))
    os.symlink(tmp_path / "other", tmp_path / ("ct" if beside else ".") / "more")
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "ct").rename(root / "ct")
    if beside:
        with refused(RefusedInputError, "more", "follow_links=True"):
            read_volume(root)
    else:
        (tmp_path / "more").rename(root / "more")
        volume = read_volume(root)
        assert np.array_equal(volume.voxels, plan.hu())
        assert volume.report["warnings"] == ["1 skipped: link out of the folder"]
    assert [entry.slices for entry in list_series(root, follow_links=True).series] == [9, 7]
    assert np.array_equal(read_volume(root, 2, follow_links=True).voxels, whole.hu())


def test_followed_links_read_no_file_twice_and_end(tmp_path, plan):
    store = tmp_path / "store"
    move_out(tmp_path / "ct", [plan.name(0)], store)
    os.symlink(store / "object0", tmp_path / "ct" / "again")
    os.symlink(store, tmp_path / "ct" / "objects")
    os.symlink(tmp_path, tmp_path / "ct" / "up")  # leads back to the folder itself
    os.symlink(tmp_path / "ct", store / "back")
    volume = read_volume(tmp_path / "ct", follow_links=True)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["files"]["found"] == 9 and volume.report["dropped"] == {}
