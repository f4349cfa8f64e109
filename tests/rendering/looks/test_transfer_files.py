"""Files with transfer functions: ours there and back, those of 3D Slicer and ParaView, and every refusal's place."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_one_line, refused
from tolerances import FLOAT64_SHARE, STEP_SIDE
from variants import daily

from clrecon.errors import OutputError, RefusedInputError, UsageError
from clrecon.rendering import PRESETS, UNSHADED, Lighting, TransferFunction, load_transfer_function

pytestmark = pytest.mark.unit

ROOT = Path(__file__).resolve().parents[3]

OWN: dict[str, Any] = {
    "format": "clrecon transfer function",
    "version": 1,
    "points": [{"hu": 100, "color": [1, 0.5, 0], "opacity": 0}, {"hu": 300, "color": "#ffffff", "opacity": 0.5}],
}
TEXT = """1
1
0.8
0.15
0.3
12
8 -1000 0 80 0 80 0.25 900 0.75
4 0 1 255 1
12 -1000 0 0 0 100 1 0.5 0 900 1 1 1
"""
XML = """<?xml version="1.0" encoding="utf-8"?>
<MRML>
  <VolumeProperty selected="false" name="CT-One" gradientOpacity="4 0 0.5 200 1" userTags="" specularPower="10"
    scalarOpacity="4 100 0 400 0.5" id="vtkMRMLVolumePropertyNode1" specular="0.2" shade="1" ambient="0.1"
    colorTransfer="8 100 1 0 0 400 1 1 1" selectable="true" diffuse="0.9" interpolation="1"/>
  <VolumeProperty name="CT-Two" scalarOpacity="4 0 0 50 1" shade="0" colorTransfer="4 0 0.2 0.4 0.6"/>
  <VolumeProperty name="broken" scalarOpacity="5 0 0 50 1" colorTransfer="4 0 0.2 0.4 0.6"/>
</MRML>
"""
SLICER: dict[str, Any] = {
    "@schema": "https://raw.githubusercontent.com/slicer/slicer/main/Modules/Loadable/VolumeRendering/Resources/Schema/"
    "volume-property-schema-v1.0.0.json#",
    "volumeProperties": [
        {
            "effectiveRange": [0.0, 220.0],
            "components": [
                {
                    "shade": True,
                    "lighting": {"diffuse": 1.0, "ambient": 0.2, "specular": 0.0, "specularPower": 1.0},
                    "rgbTransferFunction": {
                        "type": "colorTransferFunction",
                        "points": [
                            {"x": 0.0, "color": [0.0, 0.0, 0.0], "midpoint": 0.25, "sharpness": 1.0},
                            {"x": 400.0, "color": [1.0, 0.5, 0.0], "midpoint": 0.5, "sharpness": 0.0},
                        ],
                    },
                    "scalarOpacityUnitDistance": 2.5,
                    "scalarOpacity": {
                        "type": "piecewiseLinearFunction",
                        "points": [
                            {"x": 0.0, "y": 0.0, "midpoint": 0.5, "sharpness": 0.0},
                            {"x": 200.0, "y": 0.6, "midpoint": 0.5, "sharpness": 0.0},
                            {"x": 200.00001, "y": 0.1},
                        ],
                    },
                    "gradientOpacity": {"points": [{"x": 0, "y": 0.25}, {"x": 100, "y": 1}]},
                }
            ],
        }
    ],
}
PARAVIEW: list[dict[str, Any]] = [
    {
        "ColorSpace": "RGB",
        "Name": "Bone CT",
        "Points": [100.0, 0.0, 0.5, 0.0, 500.0, 0.8, 0.5, 0.0],
        "RGBPoints": [100.0, 0.5, 0.0, 0.0, 500.0, 1.0, 1.0, 1.0],
    }
]


def write_file(folder: Path, value: Any, name: str = "file.json") -> Path:
    path = folder / name
    if isinstance(value, bytes):
        path.write_bytes(value)
    else:
        path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
    return path


def changed(value: Any, place: list[Any], new: Any) -> Any:
    """A deep copy of `value` with `new` at `place`; None takes the field out."""
    copy = json.loads(json.dumps(value))
    inner = copy
    for key in place[:-1]:
        inner = inner[key]
    if new is None:
        del inner[place[-1]]
    else:
        inner[place[-1]] = new
    return copy


def make_full_function() -> TransferFunction:
    """A transfer function with every field, numbers of all digits, and letters that JSON escapes."""
    rng = np.random.default_rng(3)
    points = np.column_stack([np.sort(rng.uniform(-1000, 3000, 50)), rng.uniform(size=(50, 4))])
    points[7, 0] = points[6, 0]  # a step
    return TransferFunction(
        points,
        unit_distance=1 / 3,
        gradient_opacity=[(0, 0.1), (1 / 7, 1)],
        lighting=Lighting(
            ambient=0.1, diffuse=0.7, specular=0.3, specular_power=99, direction=(1, 2, 3), soft_gradient=1 / 3
        ),
        name='a "b" \u00e4\n',
        description="d\\e",
    )


@pytest.mark.parametrize(
    "function",
    [
        pytest.param(make_full_function(), id="every field"),
        pytest.param(TransferFunction([(1, 0, 0, 0, 0), (2, 1, 1, 1, 1)]), id="points alone"),
        *(pytest.param(preset.transfer_function, id=name) for name, preset in PRESETS.items()),
    ],
)
def test_saved_transfer_function_is_loaded_bit_for_bit(function: TransferFunction, tmp_path: Path) -> None:
    function.save(tmp_path / "f.json")

    loaded = load_transfer_function(tmp_path / "f.json")

    assert loaded == function
    assert (loaded.name, loaded.description) == (function.name, function.description)
    assert loaded.points.tobytes() == function.points.tobytes()


def test_saved_transfer_function_states_version_1(tmp_path: Path) -> None:
    make_full_function().save(tmp_path / "f.json")
    assert json.loads((tmp_path / "f.json").read_text(encoding="utf-8"))["version"] == 1


@pytest.fixture(scope="module")
def example() -> tuple[str, str]:
    """The JSON of the page on transfer functions, and its table of fields."""
    text = (ROOT / "docs" / "transfer_functions.md").read_text(encoding="utf-8")
    (content,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    return content, text.split("| field |")[1]


def test_example_of_the_page_on_transfer_functions_is_read(example: tuple[str, str], tmp_path: Path) -> None:
    content, _table = example
    function = load_transfer_function(write_file(tmp_path, content))

    assert (function.name, function.unit_distance, len(function.points)) == ("glass bone", 1.0, 3)
    assert function([150])[0].tolist() == pytest.approx([204 / 255, 128 / 255, 102 / 255, 0], abs=FLOAT64_SHARE)
    assert function.gradient_factor([50]).tolist() == pytest.approx([0.6])
    assert function.lighting.specular == 0.3


def test_page_on_transfer_functions_lists_the_fields_of_its_example(example: tuple[str, str]) -> None:
    content, table = example
    assert {f"`{field}`" for field in json.loads(content)} <= set(re.findall(r"`\w+`", table))


def test_python_of_the_page_on_transfer_functions_gives_the_figures_that_it_states() -> None:
    text = (ROOT / "docs" / "transfer_functions.md").read_text(encoding="utf-8")
    code = text.split("    from clrecon import", 1)[1].split("    volume = ")[0]
    names: dict[str, Any] = {}
    exec("from clrecon import" + code.replace("\n    ", "\n"), names)
    assert names["glass_bone"]([300])[0].tolist() == [0.9, 0.8, 0.6, 0.02]
    share = (1 - names["glass_bone"]([300])[0, 3]) ** 100
    said = f"an opacity of 0.02 per mm lets {100 * share:.0f} % of the light through 100 mm"
    assert said in " ".join(text.split())


@pytest.mark.parametrize("name", ["gone/f.json", "."], ids=["missing folder", "a folder"])
def test_transfer_function_that_cannot_be_saved_is_refused_and_leaves_no_file(name: str, tmp_path: Path) -> None:
    function = TransferFunction([(1, 0, 0, 0, 0), (2, 1, 1, 1, 1)])
    with refused(OutputError, "folder"):
        function.save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(OWN, id="left out"),
        pytest.param({**OWN, "lighting": None, "gradient_opacity": None}, id="null"),
        pytest.param(b"\xef\xbb\xbf" + json.dumps(OWN).encode(), id="with the mark of UTF-8"),
    ],
)
def test_fields_left_out_of_a_transfer_file_have_their_defaults(content: Any, tmp_path: Path) -> None:
    function = load_transfer_function(write_file(tmp_path, content))
    assert function == TransferFunction([(100, 1, 0.5, 0, 0), (300, 1, 1, 1, 0.5)])


def test_fields_left_out_of_the_lighting_of_a_transfer_file_have_their_defaults(tmp_path: Path) -> None:
    function = load_transfer_function(write_file(tmp_path, {**OWN, "lighting": {"ambient": 0.1}}))
    assert function.lighting == Lighting(ambient=0.1)


@pytest.mark.parametrize(
    ("place", "new", "message"),
    [
        (["version"], 2, "its version is 2: this clrecon reads version 1"),
        (["version"], True, "its version is True"),
        (["version"], None, "no field 'version'"),
        (["format"], "tf", "its format is 'tf'"),
        (["points"], None, "no field 'points'"),
        (["points"], [], "points is empty"),
        (["points"], {}, "points is an object, not a list"),
        (["point"], [], "field 'point' that is not known"),
        (["points", 1], [300, 1, 1, 1, 1], r"points\[1\] is a list, not an object"),
        (["points", 1, "opacity"], None, r"points\[1\] has no field 'opacity'"),
        (["points", 1, "opacity"], "1", r"points\[1\].opacity is '1', not a finite number"),
        (["points", 1, "opacity"], True, r"points\[1\].opacity is true or false"),
        (["points", 1, "opacity"], 1.5, "opacity of point 2 is 1.5"),
        (["points", 1, "hu"], 10**400, r"points\[1\].hu is 1000"),
        (["points", 1, "hu"], 99, "back from 100 HU at point 1 to 99 HU at point 2"),
        (["points", 0, "color"], "red", r"points\[0\].color is 'red', not \[red, green, blue\] or '#rrggbb'"),
        (["points", 0, "color"], "#ggffff", r"points\[0\].color is '#ggffff'"),
        (["points", 0, "color"], "# 1 2 3", r"points\[0\].color is '# 1 2 3'"),
        (["points", 0, "color"], [1, 1], r"points\[0\].color is a list"),
        (["points", 0, "color", 2], "x", r"points\[0\].color\[2\] is 'x'"),
        (["points", 0, "colour"], 1, r"points\[0\] has a field 'colour' that is not known: hu, color, opacity are"),
        (["unit_distance_mm"], 0, "unit distance of a transfer function is a length in mm, .*, not 0"),
        (["name"], 5, "name is 5, not a text"),
        (["gradient_opacity"], [{"hu_per_mm": 1}], r"gradient_opacity\[0\] has no field 'factor'"),
        (["gradient_opacity"], [{"hu_per_mm": 1, "factor": 2}], "factor of the gradient opacity of point 1 is 2"),
        (["lighting"], {"ambient": 2}, "ambient of lighting lies between 0 and 1"),
        (["lighting"], {"ambience": 2}, "lighting has a field 'ambience' that is not known"),
        (["lighting"], {"direction": [0, 0]}, "three finite numbers in LPS"),
    ],
)
def test_wrong_field_of_a_transfer_file_is_refused_by_its_name_in_one_line(
    tmp_path: Path, place: list[Any], new: Any, message: str
) -> None:
    with pytest.raises(RefusedInputError, match=f"^'file.json': .*{message}") as caught:
        load_transfer_function(write_file(tmp_path, changed(OWN, place, new)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "facts"),
    [
        ('{"format": 1,\n "version" 1}', ("JSON", 2, 12)),
        ('{"format": NaN}', ("JSON", "NaN")),
        ('{"version": 1, "version": 1}', ("version",)),
        ('{"a": ' + "9" * 5000 + "}", ()),
        ("[" * 100_000, ()),
        ("{}", ('"format"',)),
        ("", ("form",)),
        ("bone", ("form",)),
        (b"\x89PNG\r\n", ("UTF-8", 0)),
        (b" " * 1_000_001, (1_000_000,)),
        ("<a>", ("XML", 1)),
        ("<MRML/>", ("VolumeProperty",)),
        ('<!DOCTYPE x [<!ENTITY a "b">]><MRML/>', ("DOCTYPE", 1)),
        ('<!DOCTYPE x [<!ENTITY a "b">]><MRML/>'.encode("utf-16"), ("DOCTYPE", 1)),
        ('<?xml version="1.0" encoding="no-such"?><MRML/>', ("XML",)),
    ],
    ids=[
        *("no JSON in line 2, column 12", "NaN", "name twice", "5,000 digits", "deep", "no format", "empty", "a word"),
        *("no UTF-8 at byte 0", "more than a million bytes", "cut XML", "XML without a preset", "entity"),
        *("entity in UTF-16", "unknown encoding"),
    ],
)
def test_file_that_is_no_transfer_function_is_refused(
    tmp_path: Path, content: str | bytes, facts: tuple[str | int, ...]
) -> None:
    with refused(RefusedInputError, "file.json", *facts):
        load_transfer_function(write_file(tmp_path, content))


def test_missing_transfer_file_is_refused(tmp_path: Path) -> None:
    with refused(UsageError, "no", "file", "gone.json"):
        load_transfer_function(tmp_path / "gone.json")


def test_folder_as_a_transfer_file_is_refused(tmp_path: Path) -> None:
    with refused(UsageError, "folder"):
        load_transfer_function(tmp_path)


def test_name_of_a_transfer_file_with_a_zero_byte_is_refused() -> None:
    with refused(RefusedInputError, "cannot"):
        load_transfer_function("a\0b")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes of POSIX")
def test_pipe_as_a_transfer_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with refused(RefusedInputError, "regular"):
        load_transfer_function(tmp_path / "pipe")


@pytest.mark.parametrize(
    "text",
    [TEXT, TEXT.replace("\n", "\r\n"), TEXT.rstrip()],
    ids=["line feeds", "carriage returns", "no end of the last line"],
)
def test_slicer_text_is_read_with_its_opacities_colours_and_light(text: str, tmp_path: Path) -> None:
    function = load_transfer_function(write_file(tmp_path, text, "a.vp"))

    assert function.lighting == Lighting(ambient=0.15, diffuse=0.8, specular=0.3, specular_power=12)
    assert (function.gradient_opacity, function.unit_distance) == (None, 1.0)
    opacity = function([-2000, 79.9, 80, 490, 900, 3000])[:, 3]  # 490 lies half way from 80 to 900
    np.testing.assert_allclose(opacity, [0, 0, 0.25, 0.5, 0.75, 0.75], atol=FLOAT64_SHARE)
    colors = function([-450, 500])[:, :3]  # half way from -1000 to 100, and from 100 to 900
    np.testing.assert_allclose(colors, [[0.5, 0.25, 0], [1, 0.75, 0.5]], atol=FLOAT64_SHARE)


def test_slicer_text_gives_points_at_the_hu_of_both_functions_and_steps_twice(tmp_path: Path) -> None:
    function = load_transfer_function(write_file(tmp_path, TEXT, "a.vp"))
    assert function.points[:, 0].tolist() == [-1000, 80, 80, 100, 900]


def test_slicer_text_without_shading_is_unshaded(tmp_path: Path) -> None:
    function = load_transfer_function(write_file(tmp_path, TEXT.replace("1\n1\n", "1\n0\n", 1), "a.vp"))
    assert function.lighting == UNSHADED


def test_slicer_text_without_a_diffuse_part_has_that_of_vtk(tmp_path: Path) -> None:
    lines = TEXT.splitlines()
    lines[2] = lines[7] = ""  # diffuse, and the gradient opacity
    function = load_transfer_function(write_file(tmp_path, "\n".join(lines), "a.vp"))
    assert function.lighting == Lighting(ambient=0.15, diffuse=0.7, specular=0.3, specular_power=12)


@pytest.mark.parametrize(
    ("line", "new", "facts"),
    [
        (3, "0.8x", (3, "diffuse", "0.8x")),
        (3, "7", ("diffuse", 0, 1)),
        (7, "8 -1000 0 80 0", (7, "scalarOpacity", 8, 4)),
        (7, "3 1 0 2", (3, 2)),
        (7, "4 5 0 x 1", (4, 7, "scalarOpacity")),
        (7, "4 50 0 20 1", (7, "scalarOpacity", 50, 1, 20)),
        (7, "4 50 0 90 7", ("opacity", 3, 7)),
        (7, "", (7, "scalarOpacity")),
        (8, "4 0 1 255 nan", (5, 8, "gradientOpacity")),
        (9, "0", (9, "colorTransfer", 0)),
    ],
    ids=[
        *("letter in a number", "diffuse above 1", "4 numbers for 8", "3 numbers, of 2 to a point", "number 4 is x"),
        *("falls from 50 to 20 HU", "opacity 7 of point 3", "empty", "number 5 is nan", "no colours"),
    ],
)
def test_wrong_line_of_slicer_text_is_refused_with_its_number_and_field(
    tmp_path: Path, line: int, new: str, facts: tuple[str | int, ...]
) -> None:
    lines = TEXT.splitlines()
    lines[line - 1] = new
    with refused(RefusedInputError, "a.vp", *facts):
        load_transfer_function(write_file(tmp_path, "\n".join(lines), "a.vp"))


def test_slicer_text_that_ends_before_its_colours_is_refused(tmp_path: Path) -> None:
    without_colours = "\n".join(TEXT.splitlines()[:8])
    with refused(RefusedInputError, "a.vp", 9, "colorTransfer"):  # of line 9
        load_transfer_function(write_file(tmp_path, without_colours, "a.vp"))


@pytest.fixture
def presets_xml(tmp_path: Path) -> Path:
    """Presets of Slicer: CT-One, CT-Two, and one that is broken."""
    return write_file(tmp_path, XML, "presets.xml")


def test_preset_of_slicer_is_read_by_its_name_in_any_case(presets_xml: Path) -> None:
    function = load_transfer_function(presets_xml, "ct-one")

    assert (function.name, function.lighting) == (
        "CT-One",
        Lighting(ambient=0.1, diffuse=0.9, specular=0.2, specular_power=10),
    )
    assert function.points.tolist() == [[100, 1, 0, 0, 0], [400, 1, 1, 1, 0.5]]
    assert np.array_equal(function.gradient_opacity, [[0, 0.5], [200, 1]])


def test_preset_of_slicer_is_read_by_its_number(presets_xml: Path) -> None:
    function = load_transfer_function(presets_xml, "2")

    assert (function.name, function.lighting) == ("CT-Two", UNSHADED)
    assert function([0, 25, 50]).tolist() == [[0.2, 0.4, 0.6, opacity] for opacity in (0, 0.5, 1)]


def test_preset_of_slicer_in_utf_16_is_that_in_utf_8(presets_xml: Path, tmp_path: Path) -> None:
    utf_16 = write_file(tmp_path, XML.replace("utf-8", "utf-16").encode("utf-16"), "16.xml")
    assert load_transfer_function(utf_16, "CT-One") == load_transfer_function(presets_xml, "CT-One")


def test_presets_of_slicer_without_a_choice_are_refused_with_their_names(presets_xml: Path) -> None:
    with refused(UsageError, "CT-One", "CT-Two", "broken", 3):  # presets
        load_transfer_function(presets_xml)


@pytest.mark.parametrize("name", ["CT-Three", "4", "0", "\u00b2"])
def test_preset_of_slicer_that_is_not_there_is_refused(name: str, presets_xml: Path) -> None:
    with refused(UsageError, name, "CT-One"):
        load_transfer_function(presets_xml, name)


def test_broken_preset_of_slicer_is_refused_with_its_line_and_count(presets_xml: Path) -> None:
    line, numbers = 7, 5
    with refused(RefusedInputError, "broken", "scalarOpacity", line, numbers):
        load_transfer_function(presets_xml, "broken")


def test_name_of_two_presets_of_slicer_is_refused(tmp_path: Path) -> None:
    twice = write_file(tmp_path, XML.replace("CT-Two", "CT-One"), "twice.xml")
    with refused(UsageError, "CT-One", 2):  # of that name
        load_transfer_function(twice, "CT-One")


COMPONENT = ["volumeProperties", 0, "components", 0]


def test_json_of_slicer_is_read_with_its_distance_light_gradient_and_step_of_opacity(tmp_path: Path) -> None:
    function = load_transfer_function(write_file(tmp_path, SLICER, "a.vp.json"))

    assert (function.unit_distance, function.lighting) == (
        2.5,
        Lighting(ambient=0.2, diffuse=1, specular=0, specular_power=1),
    )
    assert np.array_equal(function.gradient_opacity, [[0, 0.25], [100, 1]])
    opacity = function([0, 100, 199.9999, 200.0001, 1000])[:, 3]
    np.testing.assert_allclose(opacity, [0, 0.3, 0.6, 0.1, 0.1], atol=STEP_SIDE)


def test_colours_of_slicer_with_sharpness_1_have_a_step_at_their_midpoint(tmp_path: Path) -> None:
    function = load_transfer_function(write_file(tmp_path, SLICER, "a.vp.json"))
    midpoint = 0.25 * 400
    assert function([midpoint - 0.1, midpoint + 0.1])[:, 0].tolist() == [0, 1]


def test_json_of_slicer_with_gradient_and_shading_off_has_neither(tmp_path: Path) -> None:
    off = changed(SLICER, [*COMPONENT, "disableGradientOpacity"], True)
    off = changed(off, [*COMPONENT, "shade"], False)

    function = load_transfer_function(write_file(tmp_path, off))

    assert (function.gradient_opacity, function.lighting) == (None, UNSHADED)


def test_json_of_slicer_with_a_grey_function_is_read(tmp_path: Path) -> None:
    component = dict(SLICER["volumeProperties"][0]["components"][0])
    component["grayTransferFunction"] = component["scalarOpacity"]
    del component["rgbTransferFunction"]
    value = changed(SLICER, ["volumeProperties", 0, "components"], [component])

    function = load_transfer_function(write_file(tmp_path, value))

    half_way_to_200 = 100
    assert function([half_way_to_200])[0].tolist() == pytest.approx([0.6 / 2] * 4, abs=STEP_SIDE)


@pytest.mark.parametrize(
    ("place", "new", "field"),
    [
        ([], None, "volumeProperties"),
        ([0, "components"], [], "volumeProperties[0].components"),
        ([0, "components"], None, "components"),
        ([0, "components", 0, "scalarOpacity"], None, "scalarOpacity"),
        ([0, "components", 0, "rgbTransferFunction"], None, "grayTransferFunction"),
        ([0, "components", 0, "scalarOpacity", "points"], {}, "scalarOpacity.points"),
        ([0, "components", 0, "scalarOpacity", "points", 1, "y"], "x", "scalarOpacity.points[1].y"),
        ([0, "components", 0, "rgbTransferFunction", "points", 1, "color"], [1], "points[1].color"),
        ([0, "components", 0, "lighting"], 3, "lighting"),
    ],
)
def test_wrong_field_of_slicer_json_is_refused_by_its_name(
    tmp_path: Path, place: list[Any], new: Any, field: str
) -> None:
    value = changed(SLICER, ["volumeProperties", *place], new) if place else {**SLICER, "volumeProperties": []}
    with refused(RefusedInputError, "file.json", field):
        load_transfer_function(write_file(tmp_path, value))


def test_paraview_file_is_read_with_its_name_colours_and_opacities(tmp_path: Path) -> None:
    function = load_transfer_function(write_file(tmp_path, PARAVIEW))

    assert (function.name, function.lighting) == ("Bone CT", None)
    half_way = 300  # from 100 to 500
    np.testing.assert_allclose(function([half_way]), [[0.75, 0.5, 0.5, 0.4]], atol=FLOAT64_SHARE)


@pytest.mark.parametrize(
    ("field", "new", "fact"),
    [
        ("Points", None, "opacities"),
        ("ColorSpace", "Lab", "Lab"),
        ("RGBPoints", [1, 2, 3], "1.RGBPoints"),
        ("RGBPoints", None, "RGBPoints"),
    ],
    ids=["no opacities", "another colour space", "three numbers", "no colours"],
)
def test_wrong_field_of_a_paraview_file_is_refused(field: str, new: Any, fact: str, tmp_path: Path) -> None:
    with refused(RefusedInputError, fact):
        load_transfer_function(write_file(tmp_path, changed(PARAVIEW, [0, field], new)))


@pytest.mark.fuzz
@pytest.mark.parametrize(
    "sample", daily(2, [OWN, TEXT, XML, SLICER, PARAVIEW]), ids=["own", "vp", "xml", "vp.json", "paraview"]
)
def test_mutated_transfer_file_is_read_or_refused_in_one_line(tmp_path: Path, sample: Any) -> None:
    rng = np.random.default_rng(5)
    words = (b"-1", b"1e999", b"nan", b"null", b"[]", b"{}", b'""', b"9" * 40, b"\xff", b"\x00", b"<", b"-1e308", b"\n")
    start = write_file(tmp_path, sample).read_bytes()
    read, mutations = 0, 400
    first = "1"  # must be chosen in XML, which has three functions; the others have one
    few_nodes = 16  # evenly over the range, with both its ends
    for _ in range(mutations):
        data = bytearray(start)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(data)))
            if rng.integers(2):
                data[at:at] = words[rng.integers(len(words))]
            else:
                del data[at : at + int(rng.integers(1, 20))]
        try:
            function = load_transfer_function(write_file(tmp_path, bytes(data)), first)
            assert np.isfinite(function.table(*function.range_hu, few_nodes)).all()
            read += 1
        except (RefusedInputError, UsageError) as error:
            assert_one_line(error)
    assert 0 < read < mutations  # some are read, and some refused
