"""The options of ``clrecon render`` as the parser hands them on."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from printed_text import Printer

from clrecon.cli.common import Parser
from clrecon.cli.main import main
from clrecon.cli.render import add_arguments

GIVEN_TWICE = {
    "view": (["anterior,left", "30,15"], [("anterior", "left"), ("30,15",)]),
    "clip": (["0,0,0,1,0,0", "0,0,5,0,0,1"], [(0, 0, 0, 1, 0, 0), (0, 0, 5, 0, 0, 1)]),
    "label_color": (["L1=red", "20=#ff8000"], [("L1", "red"), ("20", "#ff8000")]),
    "label_opacity": (["L1=0.2", "20=1"], [("L1", 0.2), ("20", 1.0)]),
}


@pytest.fixture
def parser() -> Parser:
    """A parser with the options of render."""
    parser = Parser()
    add_arguments(parser)
    return parser


@pytest.mark.parametrize("name", GIVEN_TWICE)
def test_option_of_render_that_is_given_twice_makes_a_list(name: str, parser: Parser) -> None:
    texts, values = GIVEN_TWICE[name]
    option = f"--{name.replace('_', '-')}"
    (action,) = (action for action in parser._actions if option in action.option_strings)
    options = parser.parse_args([part for text in texts for part in (option, text)])
    assert getattr(options, action.dest) == values
    assert not getattr(parser.parse_args([]), action.dest)  # a parser keeps nothing from the last time
    assert str(action.help).endswith("; may be given again")


def test_mp4_without_an_encoder_is_refused_before_the_input_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printer
) -> None:
    from clrecon.rendering import movies

    movies.find_encoder.cache_clear()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", "")
    assert main(["render", str(tmp_path / "no CT"), "--turntable", str(tmp_path / "a.mp4")]) == 3
    printed().assert_error("MP4")
    movies.find_encoder.cache_clear()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        (["--keep-air"], ("--keep-air", "dvr", "minip")),
        (["--view", "sheet"], ("--sheet",)),
        (["--mode", "sheet"], ("--sheet",)),
        (["-o", "a.gif"], (".gif", "--turntable", ".png")),
    ],
)
def test_wrong_option_of_render_is_refused_with_the_one_that_was_meant(
    arguments: list[str], facts: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printer
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["render", "ct", *([] if "-o" in arguments else ["-o", "a.png"]), *arguments]) == 3
    said = printed()
    assert said.error_lines == 1
    said.assert_error(*facts)
