"""What the pages of the Guide show runs as it stands, on a small phantom; their figures are those of the documents."""

from __future__ import annotations

import re
import runpy
import shlex
import textwrap
from pathlib import Path

import pytest
from command_lines import parse_command
from house import ROOT
from variants import but_seldom, daily

from clrecon.cli.main import COMMANDS, main
from clrecon.proof.phantom import PhantomSettings, write_phantom

GUIDE = ROOT / "docs" / "guide"
PAGES = [path.relative_to(GUIDE).as_posix() for path in sorted(GUIDE.rglob("*.md"))]
COMMAND = re.compile(r"^ {4,}clrecon +([^#\n]+)", re.MULTILINE)
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
SMALLER = {"CT_FOLDER": "ct", "segmentation.nii.gz": "ct/levels.nrrd", "--size 200": "--size 64 --slices 24"}
"""What the machine of a test has not, or what takes long, and what stands for it."""

WITH_COMMANDS = {name for name in PAGES if COMMAND.search((GUIDE / name).read_text(encoding="utf-8"))}
FOR_A_RELEASE = {"quickstart.md", *(f"commands/{name}.md" for name in ("corridor", "demo", "distance", "render"))}
"""Pages whose commands take long; every day they are parsed, and tests of these jobs run the same."""


ENDS_WITH_A_GATE = ("--for print",)
"""Commands whose gates are those of a print: a phantom of voxels of 2 mm may fail one, and the file is there."""


@pytest.fixture(scope="module")
def series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small spine, whose label map has the names of levels."""
    folder = tmp_path_factory.mktemp("guide")
    write_phantom(folder / "ct", PhantomSettings(levels="L2-L4", size=(80, 80), spacing=(2.2, 2.2, 2.0)))
    return folder


def write_smaller(text: str) -> str:
    for long, short in SMALLER.items():
        text = text.replace(long, short)
    return text


def test_every_command_has_a_page_that_shows_it() -> None:
    pages = {Path(name).stem for name in PAGES if name.startswith("commands/")} - {"index"}
    assert pages <= set(COMMANDS)
    for name in pages:
        text = (GUIDE / "commands" / f"{name}.md").read_text(encoding="utf-8")
        assert text.startswith(f"# clrecon {name}\n") and f"clrecon {name}" in text.split("\n", 1)[1], name


@pytest.mark.parametrize("name", sorted(WITH_COMMANDS))
def test_the_commands_of_a_page_are_understood(name: str) -> None:
    for line in COMMAND.findall((GUIDE / name).read_text(encoding="utf-8")):
        parse_command(shlex.split(write_smaller(line)))
    assert FOR_A_RELEASE < WITH_COMMANDS


@pytest.mark.slow
@pytest.mark.parametrize("name", but_seldom(sorted(WITH_COMMANDS), FOR_A_RELEASE))
def test_the_commands_of_a_page_run(name: str, series: Path, device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(series)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    for line in COMMAND.findall((GUIDE / name).read_text(encoding="utf-8")):
        arguments = shlex.split(write_smaller(line))
        allowed = {0, 8} if any(words in line for words in ENDS_WITH_A_GATE) else {0}
        assert main([*arguments, "-q"]) in allowed, line


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PAGES if PYTHON.search((GUIDE / name).read_text(encoding="utf-8"))])
def test_the_python_of_a_page_runs(name: str, series: Path, device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(series)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    for block in PYTHON.findall((GUIDE / name).read_text(encoding="utf-8")):
        made: dict[str, object] = {}
        exec(compile(textwrap.dedent(write_smaller(block)), name, "exec"), made)
        assert {"volume", "mesh"} & set(made)


@pytest.mark.slow
@pytest.mark.parametrize("name", daily(2, [path.stem for path in sorted((GUIDE / "gallery").glob("*.py"))]))
def test_a_script_of_the_gallery_makes_its_picture(
    name: str, tmp_path: Path, device, monkeypatch: pytest.MonkeyPatch
) -> None:
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    from PIL import Image

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    runpy.run_path(str(GUIDE / "gallery" / f"{name}.py"), run_name="__main__")
    colours = Image.open("picture.png").convert("RGB").getcolors(2**20)
    assert colours is not None and len(colours) > 100
    assert (ROOT / "docs" / "images" / f"gallery-{name}.png").is_file()


def find_rows(text: str) -> dict[str, list[str]]:
    """The tables of a page: cells by the first of each row."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    return {row[0]: row[1:] for row in rows}


def test_the_errors_to_expect_are_those_that_were_measured() -> None:
    said = find_rows((GUIDE / "concepts.md").read_text(encoding="utf-8"))
    measured = find_rows((ROOT / "docs" / "iso_value.md").read_text(encoding="utf-8"))
    names = [name for name in said if "mm" in name]
    assert len(names) == 7
    for name in names:
        best, preset, *_, auto = (re.findall(r"\((.*?)\)", cell)[0] for cell in measured[name] if "(" in cell)
        assert said[name] == [best, preset, auto], name
    text = " ".join((GUIDE / "concepts.md").read_text(encoding="utf-8").split())
    lost = [measured[level][2] for level in ("auto", "preset")]
    assert f"at {lost[0]} of the places on 22 phantoms there is no surface, with the preset at {lost[1]}" in text
