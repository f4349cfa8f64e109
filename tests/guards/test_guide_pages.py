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


PAGES_OF_COMMANDS = sorted({Path(name).stem for name in PAGES if name.startswith("commands/")} - {"index"})


@pytest.mark.parametrize("command", PAGES_OF_COMMANDS)
def test_page_of_a_command_has_its_name_as_title_and_shows_it(command: str) -> None:
    assert command in COMMANDS
    title, text = (GUIDE / "commands" / f"{command}.md").read_text(encoding="utf-8").split("\n", 1)
    assert title == f"# clrecon {command}"
    assert f"clrecon {command}" in text


@pytest.mark.parametrize("name", sorted(WITH_COMMANDS))
def test_commands_of_a_page_of_the_guide_are_understood(name: str) -> None:
    commands = COMMAND.findall((GUIDE / name).read_text(encoding="utf-8"))
    assert commands
    for line in commands:
        parse_command(shlex.split(write_smaller(line)))  # raises UsageError where it is not understood


def test_pages_whose_commands_are_for_a_release_alone_are_some_of_those_with_commands() -> None:
    assert FOR_A_RELEASE < WITH_COMMANDS


@pytest.mark.slow
@pytest.mark.parametrize("name", but_seldom(sorted(WITH_COMMANDS), FOR_A_RELEASE))
def test_commands_of_a_page_of_the_guide_run(name: str, series: Path, device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(series)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    for line in COMMAND.findall((GUIDE / name).read_text(encoding="utf-8")):
        arguments = shlex.split(write_smaller(line))
        allowed = {0, 8} if any(words in line for words in ENDS_WITH_A_GATE) else {0}
        assert main([*arguments, "-q"]) in allowed, line


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PAGES if PYTHON.search((GUIDE / name).read_text(encoding="utf-8"))])
def test_python_of_a_page_of_the_guide_makes_a_volume_or_a_mesh(
    name: str, series: Path, device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(series)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    for block in PYTHON.findall((GUIDE / name).read_text(encoding="utf-8")):
        variables: dict[str, object] = {}
        exec(compile(textwrap.dedent(write_smaller(block)), name, "exec"), variables)
        assert {"volume", "mesh"} & set(variables)


@pytest.mark.slow
@pytest.mark.parametrize("name", daily(2, [path.stem for path in sorted((GUIDE / "gallery").glob("*.py"))]))
def test_script_of_the_gallery_writes_a_picture_of_many_colours(
    name: str, tmp_path: Path, device, monkeypatch: pytest.MonkeyPatch
) -> None:
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    from PIL import Image

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    runpy.run_path(str(GUIDE / "gallery" / f"{name}.py"), run_name="__main__")
    colours = Image.open("picture.png").convert("RGB").getcolors(2**20)
    assert colours is not None
    assert len(colours) > 100  # an empty picture has one, a shaded surface thousands


@pytest.mark.parametrize("name", sorted(path.stem for path in (GUIDE / "gallery").glob("*.py")))
def test_script_of_the_gallery_has_its_picture_among_the_documents(name: str) -> None:
    assert (ROOT / "docs" / "images" / f"gallery-{name}.png").is_file()


def read_tables(path: Path) -> dict[str, list[str]]:
    """The tables of a page: the cells of each row by its first cell."""
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return {row[0]: row[1:] for row in rows}


MEASURED = read_tables(ROOT / "docs" / "iso_value.md")
"""The page with the measured errors of surfaces, from which the guide's page of concepts takes its own."""


def test_errors_of_walls_on_the_page_of_concepts_are_those_of_the_page_of_iso_values() -> None:
    stated = {name: cells for name, cells in read_tables(GUIDE / "concepts.md").items() if "mm" in name}
    assert stated
    for name, cells in stated.items():
        in_brackets = [found[1] for cell in MEASURED[name] if (found := re.search(r"\((.*?)\)", cell))]
        best, preset, *_, auto = in_brackets
        assert cells == [best, preset, auto], name


def test_shares_without_a_surface_on_the_page_of_concepts_are_those_of_the_page_of_iso_values() -> None:
    text = " ".join((GUIDE / "concepts.md").read_text(encoding="utf-8").split())
    auto, preset = (MEASURED[level][2] for level in ("auto", "preset"))
    assert (
        f"on 22 phantoms, {auto} of the true surface has no extracted surface within 3 mm (with the preset {preset})"
        in text
    )
