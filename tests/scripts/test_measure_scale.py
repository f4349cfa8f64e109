"""How often other scales of values are noticed: the page has the figures, and they hold for a small phantom."""

from __future__ import annotations

import json

import marked_tables  # isort: skip
import measure_scale  # isort: skip

from clrecon.proof.phantom import PhantomSettings, write_phantom


def test_the_page_has_the_figures_and_sound_scans_are_kept():
    figures = json.loads(measure_scale.FIGURES.read_text(encoding="utf-8"))
    table = marked_tables.find_table(measure_scale.PAGE.read_text(encoding="utf-8"), "other scales")
    assert list(figures["noticed"]) == list(measure_scale.CHANGES) and figures["noticed"]["unchanged"] == 0
    for name, count in figures["noticed"].items():
        assert f"| {name} | {count} of {figures['scans']} |" in table


def test_a_hand_on_other_scales_is_noticed_and_a_sound_one_kept(tmp_path):
    write_phantom(tmp_path / "hand", PhantomSettings(kind="hand", spacing=(1.5, 1.5, 3.0)))
    noticed = measure_scale.try_scan(tmp_path / "hand")
    assert not noticed["unchanged"] and not noticed["+100 HU"]
    assert noticed["+500 HU"] and noticed["+1024 HU"] and noticed["HU x 0.5"] and noticed["HU x 0.6 + 400"]
