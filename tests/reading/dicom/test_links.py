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
def plan_of_9(tmp_path):
    """A series of 9 slices in the folder ct."""
    return write_series(tmp_path / "ct", Plan(shape=(9, 5, 6)))


SOME_ARE_LINKS = pytest.mark.parametrize("slices", [[1, 3, 5, 7], [8], [0]], ids=["every second", "last", "first"])


@SOME_ARE_LINKS
def test_series_with_slices_that_are_links_out_of_it_is_refused(tmp_path, plan_of_9, slices):
    move_out(tmp_path / "ct", map(plan_of_9.name, slices), tmp_path / "store")
    with refused(RefusedInputError, plan_of_9.name(slices[0]), "follow_links=True"):
        read_volume(tmp_path / "ct")


@SOME_ARE_LINKS
def test_links_out_of_a_folder_are_counted_in_its_listing_and_fail_the_gate_of_files(tmp_path, plan_of_9, slices):
    move_out(tmp_path / "ct", map(plan_of_9.name, slices), tmp_path / "store")
    listing = list_series(tmp_path / "ct")
    assert listing.skipped == {"link out of the folder": len(slices)}
    assert f"{len(slices)} skipped: link out of the folder" in listing.warnings
    assert [gate.measured for gate in listing.certificate.gates if gate.name == "readable"] == [len(slices)]


@SOME_ARE_LINKS
def test_links_that_are_followed_are_slices_as_others(tmp_path, plan_of_9, slices):
    move_out(tmp_path / "ct", map(plan_of_9.name, slices), tmp_path / "store")
    volume = read_volume(tmp_path / "ct", follow_links=True)
    assert np.array_equal(volume.voxels, plan_of_9.hu())
    assert volume.report["warnings"] == []
    assert list_series(tmp_path / "ct", follow_links=True).series[0].slices == 9
    assert len(list_slices(tmp_path / "ct", Selection(follow_links=True))) == 9


def test_folder_of_links_alone_is_refused_unless_they_are_followed(tmp_path, plan_of_9):
    move_out(tmp_path / "ct", map(plan_of_9.name, range(9)), tmp_path / "store")
    with refused(NoDicomError, "follow_links=True", 9):
        read_volume(tmp_path / "ct")
    assert np.array_equal(read_volume(tmp_path / "ct", follow_links=True).voxels, plan_of_9.hu())


@pytest.fixture
def with_lost_links(tmp_path, plan_of_9):
    """The folder of the series, its last slice a link to a file that is not there; and a link to itself."""
    folder = tmp_path / "ct"
    (folder / plan_of_9.name(8)).unlink()
    os.symlink("../.git/annex/objects/lost", folder / plan_of_9.name(8))
    os.symlink("round", folder / "round")
    return folder


@pytest.mark.parametrize("follow_links", [False, True])
def test_series_with_a_link_to_a_file_that_is_not_there_is_refused(with_lost_links, follow_links):
    with refused(RefusedInputError, "slice008.dcm", "link"):
        read_volume(with_lost_links, follow_links=follow_links)


def test_links_to_files_that_are_not_there_are_counted_in_the_listing(with_lost_links):
    assert list_series(with_lost_links).skipped == {"link to a file that is not there": 2}


@pytest.fixture
def plan_of_7(tmp_path):
    """A second series of 7 slices, in a folder outside of `root`."""
    return write_series(tmp_path / "other", Plan(series=2, shape=(7, 5, 6)))


def link_other(tmp_path, place):
    """Move the first series below `root`, and put a link to the folder of the second into `place` there."""
    root = tmp_path / "root"
    root.mkdir()
    (tmp_path / "ct").rename(root / "ct")
    os.symlink(tmp_path / "other", root / place / "more")
    return root


def test_link_to_a_folder_beside_slices_refuses_their_series(tmp_path, plan_of_9, plan_of_7):
    root = link_other(tmp_path, "ct")  # root/ct/more leads to the other series
    with refused(RefusedInputError, "more", "follow_links=True"):
        read_volume(root)


def test_link_to_a_folder_apart_from_slices_is_skipped_with_a_warning(tmp_path, plan_of_9, plan_of_7):
    volume = read_volume(link_other(tmp_path, "."))
    assert np.array_equal(volume.voxels, plan_of_9.hu())
    assert volume.report["warnings"] == ["1 skipped: link out of the folder"]


@pytest.mark.parametrize("place", ["ct", "."], ids=["beside the slices", "apart"])
def test_series_in_a_folder_behind_a_link_is_read_where_links_are_followed(tmp_path, plan_of_9, plan_of_7, place):
    root = link_other(tmp_path, place)
    assert [series.slices for series in list_series(root, follow_links=True).series] == [9, 7]
    assert np.array_equal(read_volume(root, series=2, follow_links=True).voxels, plan_of_7.hu())


def test_followed_links_that_lead_back_are_left_and_no_file_is_read_twice(tmp_path, plan_of_9):
    store = tmp_path / "store"
    move_out(tmp_path / "ct", [plan_of_9.name(0)], store)
    os.symlink(store / "object0", tmp_path / "ct" / "again")
    os.symlink(store, tmp_path / "ct" / "objects")
    os.symlink(tmp_path, tmp_path / "ct" / "up")  # leads back to the folder itself
    os.symlink(tmp_path / "ct", store / "back")
    volume = read_volume(tmp_path / "ct", follow_links=True)
    assert np.array_equal(volume.voxels, plan_of_9.hu())
    assert volume.report["files"]["found"] == 9
    assert volume.report["dropped"] == {}
