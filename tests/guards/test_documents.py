"""Files that README, CONTRIBUTING and the documents name exist, and their commands are understood."""

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


PAGES_WITH_COMMANDS = ("clouds", "export", "mesh", "rendering", "vertebrae")


def read_document(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


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
def test_phrases_that_readers_stumble_over_are_in_no_document_for_users(name: str) -> None:
    prose = re.sub(r"`[^`]*`", "", read_document(name))
    assert GONE.findall(prose) == []


def test_phrase_that_readers_stumble_over_is_found() -> None:
    assert GONE.findall("nothing is resampled unasked, else it fails") == ["unasked", ", else"]


@pytest.mark.parametrize("name", DOCUMENTS)
def test_files_that_a_document_names_exist(name: str) -> None:
    assert find_missing_files(read_document(name), (ROOT / name).parent) == []


FORMS = sorted((ROOT / ".github").rglob("*.yml"))
"""Forms for issues, and workflows."""


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_programs_that_a_form_or_workflow_names_exist(path: Path) -> None:
    programs = re.findall(r"(?:python3? |run: )(\S*(?:scripts/\w+\.py|\.ci/run))", path.read_text(encoding="utf-8"))
    assert [name for name in programs if not (ROOT / name).is_file()] == []


def test_commands_that_forms_and_workflows_name_are_understood() -> None:
    commands = [command for path in FORMS for command in re.findall(r"`clrecon ([^`]+)`", path.read_text("utf-8"))]
    assert commands
    for command in commands:
        parse_command(shlex.split(command))  # raises UsageError where it is not understood


def test_workflow_runs_all_checks_on_linux_and_the_fast_ones_also_on_macos_and_windows() -> None:
    on_linux, on_three_systems = read_document(".github/workflows/tests.yml").split("  quick:\n")
    assert "runs-on: ubuntu-latest" in on_linux
    assert "- run: .ci/run" in on_linux
    assert "system: [ubuntu-latest, macos-latest, windows-latest]" in on_three_systems
    assert "scripts/test.py --fast" in on_three_systems


def test_workflow_runs_the_oldest_and_the_newest_python() -> None:
    oldest, *_, newest = re.findall(r":: Python :: (\d\.\d+)", read_document("setup.cfg"))
    assert f"python_requires = >= {oldest}\n" in read_document("setup.cfg")
    assert f'python: ["{oldest}", "{newest}"]' in read_document(".github/workflows/tests.yml")


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("See [this](docs/contract.md).", []),
        ("See [that](docs/contrakt.md).", ["docs/contrakt.md"]),
        ("See [home](https://x.org/a.md).", []),
        ("Run `scripts/gone.py`.", ["scripts/gone.py"]),
        ("Take `--hu`.", []),
    ],
)
def test_file_that_is_linked_or_quoted_and_does_not_exist_is_found(text: str, missing: list[str]) -> None:
    assert find_missing_files(text, ROOT) == missing


GLUED = re.compile(r": - \*\*|\| \|---|^(?![-|<#*]|\d+\. | )[^\n]+\n(?:- |\|)", re.MULTILINE)
"""A list or a table that begins within the paragraph before it, which is then shown as part of that paragraph."""


@pytest.mark.parametrize("name", DOCUMENTS)
def test_list_or_table_of_a_document_begins_after_an_empty_line(name: str) -> None:
    assert GLUED.findall(re.sub(r"^```.*?^```", "", read_document(name), flags=re.DOTALL | re.MULTILINE)) == []


@pytest.mark.parametrize("text", ["Why: - **A.** B", "Air: | a | |---|\n", "Why:\n- a\n", "Air:\n| a |\n"])
def test_list_or_table_glued_to_a_paragraph_is_found(text: str) -> None:
    assert GLUED.findall(text)


PAGES = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").glob("*.md"))


@pytest.mark.parametrize("name", ["README.md", *PAGES])
def test_commands_of_a_document_are_understood(name: str) -> None:
    commands = find_commands(read_document(name))
    assert commands or name not in {f"docs/{page}.md" for page in PAGES_WITH_COMMANDS}
    for command in commands:
        parse_command(command)  # raises UsageError where it is not understood


def test_readme_shows_the_commands_that_a_beginner_needs() -> None:
    shown = {command for command, *_ in find_commands(read_document("README.md"))}
    assert shown >= {"demo", "mesh", "render", "info", "devices", "phantom", "selftest"}


def test_page_of_the_certificate_shows_the_commands_phantom_and_info() -> None:
    commands = find_commands(read_document("docs/certificate.md"))
    assert [command for command, *_ in commands] == ["phantom", "info"]


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        ("mesh A --hu 300", "required"),
        ("mesh A -o b.stl --iso 3", "unrecognized"),
        ("mash A", "no command"),
        ("info", "required"),
    ],
)
def test_command_of_a_document_that_is_not_understood_is_found(command: str, fault: str) -> None:
    from clrecon.errors import UsageError

    [arguments] = find_commands(f"text\n\n    clrecon {command}   # why\n")
    with pytest.raises(UsageError, match=fault):
        parse_command(arguments)


def test_readme_links_every_page_of_the_documents() -> None:
    assert set(PAGES) <= set(LINK.findall(read_document("README.md")))


def test_readme_is_shorter_than_150_lines() -> None:
    assert read_document("README.md").count("\n") < 150


def versions_of_changelog() -> list[str]:
    _, *versions = re.split(r"^## ", read_document("CHANGELOG.md"), flags=re.MULTILINE)
    return versions


@pytest.mark.parametrize("text", versions_of_changelog(), ids=lambda text: text.splitlines()[0])
def test_version_of_the_changelog_has_its_kinds_of_changes_in_the_usual_order(text: str) -> None:
    usual = ["Added", "Changed", "Deprecated", "Removed", "Fixed"]
    kinds = re.findall(r"^### (.+)$", text, re.MULTILINE)
    assert kinds == [kind for kind in usual if kind in kinds]


@pytest.mark.parametrize("text", versions_of_changelog(), ids=lambda text: text.splitlines()[0])
def test_version_of_the_changelog_has_at_most_150_lines(text: str) -> None:
    assert text.count("\n") <= 150


def test_contents_of_the_readme_link_each_of_its_sections_in_order() -> None:
    text = read_document("README.md")
    sections = [name.lower().replace(" ", "-") for name in re.findall(r"^## (.+)$", text, re.MULTILINE)]
    assert re.findall(r"\]\(#([\w-]+)\)", text) == sections


def test_every_exit_code_of_an_error_has_a_row_in_the_contract() -> None:
    from clrecon import errors

    codes = {kind.exit_code for kind in vars(errors).values() if isinstance(kind, type) and hasattr(kind, "exit_code")}
    assert {1, 2, 3} < codes  # the errors were looked up: they have these codes and others
    rows = re.findall(r"^\| (\d+) \|", read_document("docs/contract.md"), re.MULTILINE)
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
def test_contract_names_these_entries_of_the_report_of_a_command(heading: str, names: str) -> None:
    section = read_document("docs/contract.md").split(f"## {heading}")[1].split("\n## ")[0]
    assert [name for name in names.split() if f"`{name}`" not in section] == []
