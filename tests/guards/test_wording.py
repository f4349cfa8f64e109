"""Messages name a parameter as its caller knows it: by its option on the command line, by its name in Python."""

from __future__ import annotations

import ast
import inspect
import re
from functools import cache

import pytest
from command_lines import parser_of
from house import PACKAGE, ROOT

import clrecon
from clrecon.cli.common import speaker_of
from clrecon.cli.main import COMMANDS
from clrecon.jobs.batch.plan import BatchSettings
from clrecon.jobs.cloud.settings import CloudSettings
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.options import InputSettings
from clrecon.jobs.render.job import PictureFiles
from clrecon.jobs.render.settings import RenderSettings
from clrecon.jobs.view import ViewSettings
from clrecon.system.arguments import _DESTINATIONS, in_python, name_parameter, spoken_by
from clrecon.viewer.web.server import serve_view

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")


def find_options(source: str) -> list[str]:
    """Options of a command line that stand in the texts of a module, docstrings and comments included, other than in
    the declarations of fields as options."""
    if not OPTION.search(source):
        return []
    declared = [
        str(ast.get_source_segment(source, node))
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("option")
    ]
    for text in declared:
        source = source.replace(text, "")
    return OPTION.findall(source)


def named_parameters(source: str) -> set[str]:
    """Parameters that a module names by `name_parameter` with a literal."""
    if "name_parameter" not in source:
        return set()
    return {
        str(node.args[0].value)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") == "name_parameter"
        and isinstance(node.args[0], ast.Constant)
    }


@cache
def named_in_package() -> frozenset[str]:
    """The same of all of clrecon."""
    return frozenset().union(*(named_parameters(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.py")))


@pytest.mark.parametrize(
    ("parameter", "value", "python", "mesh"),
    [
        ("keep_largest", "N", "keep_largest=N", "--keep-largest N"),
        ("min_volume_ml", "ML", "min_volume_ml=ML", "--min-volume ML"),
        ("keep", "bone", "keep='bone'", "--keep bone"),
        ("iso_value", "N", "iso_value=N", "--hu N"),
        ("half_way", "(BONE, TISSUE)", "half_way=(BONE, TISSUE)", "--hu half:BONE,TISSUE"),
        ("half_way", "auto", "half_way='auto'", "--hu auto"),
        ("force", True, "force=True", "--force"),
        ("closed", False, "closed=False", "--open"),
        ("series", None, "series", "--series"),
        ("ray_step", None, "ray_step", "ray_step"),
    ],
)
def test_parameter_in_a_message_is_an_option_within_a_command_and_of_python_elsewhere(
    parameter: str, value: object, python: str, mesh: str
) -> None:
    assert name_parameter(parameter, value) == in_python(parameter, value) == python
    with spoken_by(speaker_of(parser_of("mesh"))):
        assert name_parameter(parameter, value) == mesh
    assert name_parameter(parameter, value) == python


@pytest.mark.parametrize(("command", "option"), [("render", "--iso 300"), ("mesh", "--hu 300")])
def test_parameter_in_a_message_is_the_option_of_the_command_that_runs(command: str, option: str) -> None:
    assert speaker_of(parser_of(command))("iso_value", 300) == option


@pytest.mark.parametrize(
    ("parameter", "value", "option"),
    [
        ("eps", 0.5, "--cluster eps=0.5"),
        ("min_samples", 4, "--cluster min=4"),
        ("eps", None, "--cluster eps=MM"),
        ("min_samples", None, "--cluster min=N"),
    ],
)
def test_parameter_in_a_message_may_be_a_part_of_an_option(parameter: str, value: object, option: str) -> None:
    assert speaker_of(parser_of("cloud"))(parameter, value) == option


def test_parameters_in_messages_are_those_of_python_again_after_an_error_in_a_command() -> None:
    with pytest.raises(ValueError, match="in a block"), spoken_by(lambda parameter, value: "another"):
        raise ValueError("in a block")
    assert name_parameter("force", True) == "force=True"


def test_every_parameter_that_a_message_names_is_an_option_of_some_command() -> None:
    speakers = [speaker_of(parser_of(command)) for command in COMMANDS]
    named = named_in_package()
    assert len(named) > 50  # the search works: it returns some 75
    assert {name for name in named if all(speak(name, None) == name for speak in speakers)} == set()


def test_every_parameter_that_a_message_names_is_one_of_a_public_function_or_settings() -> None:
    public = [getattr(clrecon, name) for name in clrecon.__all__]
    is_error = [isinstance(each, type) and issubclass(each, Exception) for each in public]
    functions = [each for each, error in zip(public, is_error, strict=True) if callable(each) and not error]
    settings = (
        BatchSettings,
        InputSettings,
        CloudSettings,
        MeshSettings,
        RenderSettings,
        RenderSettings.of,
        LabelChoice,
        PictureFiles,
        ViewSettings,
        serve_view,
    )
    known = {name for own in (*functions, *settings) for name in inspect.signature(own).parameters}
    named = named_in_package()
    assert named - known == set()


def test_every_setting_of_pictures_but_the_listed_ones_is_an_option_of_the_command_render() -> None:
    speak = speaker_of(parser_of("render"))
    without_option = {name for name in RenderSettings.keywords() if speak(name, None) == name}
    made_by_other_options = {"lighting", "clip"}  # --light, --clip-box and --clip
    of_python_alone = {"style", "angle", "width_mm", "pixel_mm", "lowest_hu", "vertex_colors"}
    assert without_option == made_by_other_options | of_python_alone


def test_every_parameter_with_an_option_of_another_name_is_named_by_a_message() -> None:
    assert set(_DESTINATIONS) - named_in_package() == set()


def test_no_module_outside_of_the_command_line_names_an_option() -> None:
    found = {
        path.relative_to(ROOT).as_posix(): options
        for path in PACKAGE.rglob("*.py")
        if not path.is_relative_to(PACKAGE / "cli") and (options := find_options(path.read_text(encoding="utf-8")))
    }
    assert found == {}


@pytest.mark.parametrize(
    ("source", "options"),
    [
        ('raise UsageError("leave --open out, or -o; a--b, x - -y, ---")', ["--open"]),
        ('a: int = option("--open N", "see --report")\nb = "--seed"', ["--seed"]),
    ],
    ids=["in a message", "beside a declared option"],
)
def test_option_in_a_text_of_a_module_is_found_unless_it_is_declared_there(source: str, options: list[str]) -> None:
    assert find_options(source) == options


def test_parameter_that_a_message_names_by_a_literal_is_found() -> None:
    source = "x = f\"{name_parameter('force', True)}\"\nname_parameter(setting)"
    assert named_parameters(source) == {"force"}
