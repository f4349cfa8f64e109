"""How often other scales of values are noticed: the page has the figures, and they hold for a small phantom."""

from __future__ import annotations

import json

import pytest

import marked_tables  # isort: skip
import measure_scale  # isort: skip

from clrecon.proof.phantom import PhantomSettings, write_phantom

FIGURES = json.loads(measure_scale.FIGURES.read_text(encoding="utf-8"))


@pytest.mark.parametrize("change", measure_scale.CHANGES)
def test_page_has_how_many_scans_with_a_change_of_scale_were_noticed(change):
    table = marked_tables.find_table(measure_scale.PAGE.read_text(encoding="utf-8"), "other scales")
    assert f"| {change} | {FIGURES['noticed'][change]} of {FIGURES['scans']} |" in table


def test_no_unchanged_scan_was_noticed_as_one_of_another_scale():
    assert FIGURES["noticed"]["unchanged"] == 0


@pytest.fixture(scope="module")
def noticed_changes(tmp_path_factory):
    """Which changes of scale are noticed in a synthetic scan of a hand."""
    folder = tmp_path_factory.mktemp("scale") / "hand"
    write_phantom(folder, PhantomSettings(kind="hand", spacing=(1.5, 1.5, 3.0)))
    return measure_scale.try_scan(folder)


@pytest.mark.parametrize("change", ["+500 HU", "+1024 HU", "HU x 0.5", "HU x 0.6 + 400"])
def test_large_change_of_the_scale_of_a_hand_is_noticed(noticed_changes, change):
    assert noticed_changes[change]


@pytest.mark.parametrize("change", ["unchanged", "+100 HU"])
def test_hand_with_a_small_or_no_change_of_scale_is_not_noticed(noticed_changes, change):
    assert not noticed_changes[change]
