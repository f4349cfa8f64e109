"""Messages name a parameter as its caller knows it: by its option on the command line, by its name in Python."""

from __future__ import annotations

import ast
import inspect
import re
from functools import cache
from importlib import import_module

import pytest
from house import PACKAGE, ROOT

import clrecon
from clrecon.cli.common import Parser, add_common, speaker_of
from clrecon.cli.main import COMMANDS
from clrecon.jobs.batch.plan import BatchSettings
from clrecon.jobs.cloud.settings import CloudSettings
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.options import InputSettings
from clrecon.jobs.render.job import PictureFiles
from clrecon.jobs.render.settings import RenderSettings
from clrecon.system.arguments import _DESTINATIONS, in_python, name_parameter, spoken_by
from clrecon.viewer.web.server import serve_view

OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")


def parser_of(command: str) -> Parser:
    parser = Parser(prog=command)
    import_module(COMMANDS[command].module).add_arguments(parser)
    add_common(parser)
    return parser


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
def test_parameters_are_named_in_the_words_of_python_or_of_the_command(
    parameter: str, value: object, python: str, mesh: str
) -> None:
    assert name_parameter(parameter, value) == in_python(parameter, value) == python
    with spoken_by(speaker_of(parser_of("mesh"))):
        assert name_parameter(parameter, value) == mesh
    assert name_parameter(parameter, value) == python


def test_the_same_parameter_has_another_option_in_another_command() -> None:
    assert speaker_of(parser_of("render"))("iso_value", 300) == "--iso 300"
    assert speaker_of(parser_of("mesh"))("iso_value", 300) == "--hu 300"


def test_a_parameter_may_be_a_part_of_an_option() -> None:
    speak = speaker_of(parser_of("cloud"))
    assert [speak("eps", 0.5), speak("min_samples", 4)] == ["--cluster eps=0.5", "--cluster min=4"]
    assert [speak("eps", None), speak("min_samples", None)] == ["--cluster eps=MM", "--cluster min=N"]


def test_words_of_python_come_back_after_an_error() -> None:
    with pytest.raises(ValueError, match="in a block"), spoken_by(lambda parameter, value: "another"):
        raise ValueError("in a block")
    assert name_parameter("force", True) == "force=True"


def test_every_parameter_that_the_library_names_has_an_option() -> None:
    speakers = [speaker_of(parser_of(command)) for command in COMMANDS]
    named = named_in_package()
    assert len(named) > 10
    assert {name for name in named if all(speak(name, None) == name for speak in speakers)} == set()


def test_every_parameter_that_the_library_names_is_one_of_its_own() -> None:
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
        serve_view,
    )
    known = {name for own in (*functions, *settings) for name in inspect.signature(own).parameters}
    named = named_in_package()
    assert named - known == set()


def test_the_command_line_says_all_that_pictures_may_be_told() -> None:
    speak = speaker_of(parser_of("render"))
    of_python = {name for name in RenderSettings.keywords() if speak(name, None) == name}
    # Fields that other options make (--light, --clip-box and --clip), and those that only Python has.
    of_meshes = {"vertex_colors"}
    assert of_python == {"style", "lighting", "clip", "angle", "width_mm", "pixel_mm", "lowest_hu"} | of_meshes


def test_every_other_name_of_a_parameter_is_needed() -> None:
    named = named_in_package()
    assert set(_DESTINATIONS) - named == set()


def test_no_option_is_named_outside_of_the_command_line() -> None:
    found = {
        path.relative_to(ROOT).as_posix(): options
        for path in PACKAGE.rglob("*.py")
        if not path.is_relative_to(PACKAGE / "cli") and (options := find_options(path.read_text(encoding="utf-8")))
    }
    assert found == {}


def test_a_named_option_and_a_named_parameter_are_found() -> None:
    assert find_options('raise UsageError("leave --open out, or -o; a--b, x - -y, ---")') == ["--open"]
    assert find_options('a: int = option("--open N", "see --report")\nb = "--seed"') == ["--seed"]
    assert named_parameters("x = f\"{name_parameter('force', True)}\"\nname_parameter(setting)") == {"force"}
