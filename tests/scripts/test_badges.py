"""scripts/guide/make_badges.py: the badges of README.md say what the records say."""

from __future__ import annotations

import make_badges
from house import ROOT


def test_badges_are_those_of_the_records() -> None:
    assert make_badges.PICTURE.read_text(encoding="utf-8") == make_badges.draw_badges(make_badges.facts())


def test_readme_says_in_words_what_its_badges_show() -> None:
    words = "; ".join(f"{subject}: {fact}" for subject, fact in make_badges.facts().items())
    assert f"![{words}](docs/images/badges.svg)" in (ROOT / "README.md").read_text(encoding="utf-8")
