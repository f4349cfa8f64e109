"""What README, CONTRIBUTING and the documents name is there, and their commands are understood."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from command_lines import parse_command
from house import ROOT

DOCUMENTS = [
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"),
    *(path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md"))),
]
LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)[^)]*\)")
QUOTED = re.compile(r"`((?:\.ci|cl|clrecon|docs|scripts|tests)/[\w./-]*|(?:setup\.cfg|\w+\.(?:md|toml)))`")
COMMAND = re.compile(r"^ {4}(?:clrecon|python3 scripts/run\.py) +([^#\n]+)", re.MULTILINE)

GONE = re.compile(
    r"\bunasked\b|\bamid\b|vouch|made-up|made again|moving picture|spongy|hangs? together|\bfor ever\b|\btwins?\b"
    r"|light at the camera|get fewer|free points|\bbut for\b|\bfilms\b|[,;] else\b|\bOf each\b"
    r"|leap over|\bRefused (?:is|are)\b"
)
"""Phrases that readers stumbled over; CONTRIBUTING and docs/guide/development speak of the code, which has twins."""


def find_missing_files(text: str, folder: Path) -> list[str]:
    """Files that `text`, a document in `folder`, links to or names in code, and that are not there."""
    links = [name for name in LINK.findall(text) if "://" not in name]
    missing = [name for name in links if not (folder / name).exists()]
    return missing + [name for name in QUOTED.findall(text) if not (ROOT / name).exists()]


def find_commands(text: str) -> list[list[str]]:
    """Arguments of every clrecon command in an indented block of `text`."""
    return [shlex.split(arguments) for arguments in COMMAND.findall(text)]


@pytest.mark.parametrize(
    "name", [name for name in DOCUMENTS if name != "CONTRIBUTING.md" and "/development/" not in name]
)
def test_phrases_that_readers_stumble_over_are_gone(name: str) -> None:
    prose = re.sub(r"`[^`]*`", "", (ROOT / name).read_text(encoding="utf-8"))
    assert GONE.findall(prose) == []


def test_a_phrase_that_readers_stumble_over_is_found() -> None:
    assert GONE.findall("nothing is resampled unasked, else it fails") == ["unasked", ", else"]


@pytest.mark.parametrize("name", DOCUMENTS)
def test_every_named_file_is_there(name: str) -> None:
    path = ROOT / name
    assert find_missing_files(path.read_text(encoding="utf-8"), path.parent) == []


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.stem)
def test_files_that_forms_and_workflows_name_are_there(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for arguments in re.findall(r"`clrecon ([^`]+)`", text):
        parse_command(shlex.split(arguments))
    programs = re.findall(r"(?:python3? |run: )(\S*(?:scripts/\w+\.py|\.ci/run))", text)
    assert [name for name in programs if not (ROOT / name).is_file()] == []


def test_the_workflow_runs_every_check_and_the_oldest_and_newest_python() -> None:
    text = (ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8")
    setup = (ROOT / "setup.cfg").read_text(encoding="utf-8")
    oldest = re.search(r"python_requires = >= ([\d.]+)", setup)
    assert "- run: .ci/run" in text and "scripts/test.py --fast" in text
    assert oldest is not None and f'python: ["{oldest[1]}", "3.14"]' in text


def test_a_missing_file_is_found() -> None:
    text = (
        "See [this](docs/contract.md), [that](docs/contrakt.md), [home](https://x.org/a.md), `scripts/gone.py`, `--hu`."
    )
    assert find_missing_files(text, ROOT) == ["docs/contrakt.md", "scripts/gone.py"]


def test_the_commands_of_documents_are_understood() -> None:
    commands = find_commands((ROOT / "README.md").read_text(encoding="utf-8"))
    assert {command[0] for command in commands} >= {"demo", "mesh", "render", "info", "devices", "phantom", "selftest"}
    more = find_commands((ROOT / "docs" / "certificate.md").read_text(encoding="utf-8"))
    assert [command[0] for command in more] == ["phantom", "info"]
    for path in sorted((ROOT / "docs").glob("*.md")):
        found = find_commands(path.read_text(encoding="utf-8"))
        assert found or path.stem not in ("clouds", "export", "mesh", "rendering", "vertebrae"), path.stem
        more += found
    for command in commands + more:
        parse_command(command)


@pytest.mark.parametrize("command", ["mesh A --hu 300", "mesh A -o b.stl --iso 3", "mash A", "info"])
def test_a_wrong_command_is_found(command: str) -> None:
    from clrecon.errors import UsageError

    (arguments,) = find_commands(f"text\n\n    clrecon {command}   # why\n")
    with pytest.raises(UsageError, match="required|unrecognized|no command"):
        parse_command(arguments)


def test_the_readme_is_short_and_leads_to_every_document() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    pages = {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")}
    assert pages <= set(LINK.findall(text)) and text.count("\n") < 150


def test_each_version_of_the_changelog_is_short_and_in_order() -> None:
    _, *versions = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    kinds = ["Added", "Changed", "Deprecated", "Removed", "Fixed"]
    for text in versions:
        found = re.findall(r"^### (.+)$", text, re.MULTILINE)
        assert found == [kind for kind in kinds if kind in found], text.splitlines()[0]
        assert text.count("\n") <= 150, text.splitlines()[0]


def test_the_contents_of_the_readme_are_its_sections() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    sections = [name.lower().replace(" ", "-") for name in re.findall(r"^## (.+)$", text, re.MULTILINE)]
    assert re.findall(r"\]\(#([\w-]+)\)", text) == sections


def test_exit_codes_are_documented() -> None:
    from clrecon import errors

    codes = {kind.exit_code for kind in vars(errors).values() if isinstance(kind, type) and hasattr(kind, "exit_code")}
    assert len(codes) > 3
    rows = re.findall(r"^\| (\d+) \|", (ROOT / "docs" / "contract.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert codes <= {int(row) for row in rows}


@pytest.mark.parametrize(
    ("heading", "names"),
    [
        (
            "clrecon info",
            "series chosen number uid_hash description modality slices shape_ijk spacing_mm affine_ijk_to_lps_mm "
            "tilt_deg grid_residual_max_mm gap_mm uneven warnings problems",
        ),
        (
            "clrecon mesh",
            "affine_ijk_to_lps_mm iso_value_hu iso_value_reason iso_value_choice space "
            "vertices triangles closed manifold components area_mm2 volume_ml "
            "bounds_mm device driver version warnings seconds read upload build kernels download write total "
            "components_found components_kept keep_largest min_volume_ml seeds_mm split meshes output name label "
            "seed_distances_mm quality",
        ),
    ],
)
def test_the_contract_names_what_it_promises(heading: str, names: str) -> None:
    text = (ROOT / "docs" / "contract.md").read_text(encoding="utf-8")
    section = text.split(f"## {heading}")[1].split("\n## ")[0]
    assert [name for name in names.split() if f"`{name}`" not in section] == []
