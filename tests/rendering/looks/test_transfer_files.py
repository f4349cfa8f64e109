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


def put(folder: Path, value: Any, name: str = "file.json") -> Path:
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


def test_saved_transfer_functions_load_bit_for_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([np.sort(rng.uniform(-1000, 3000, 50)), rng.uniform(size=(50, 4))])
    points[7, 0] = points[6, 0]
    full = TransferFunction(
        points,
        unit_distance=1 / 3,
        gradient_opacity=[(0, 0.1), (1 / 7, 1)],
        lighting=Lighting(0.1, 0.7, 0.3, 99, direction=(1, 2, 3), soft_gradient=1 / 3),
        name='a "b" \u00e4\n',
        description="d\\e",
    )
    plain = TransferFunction([(1, 0, 0, 0, 0), (2, 1, 1, 1, 1)])
    for function in (full, plain, *(preset.transfer_function for preset in PRESETS.values())):
        function.save(tmp_path / "f.json")
        found = load_transfer_function(tmp_path / "f.json")
        assert found == function
        assert (found.name, found.description) == (function.name, function.description)
        assert found.points.tobytes() == function.points.tobytes()
        assert json.loads((tmp_path / "f.json").read_text(encoding="utf-8"))["version"] == 1


def test_the_example_of_the_document_is_read(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "transfer_functions.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    function = load_transfer_function(put(tmp_path, example))
    assert (function.name, function.unit_distance, len(function.points)) == ("glass bone", 1.0, 3)
    assert function([150])[0].tolist() == pytest.approx([204 / 255, 128 / 255, 102 / 255, 0], abs=FLOAT64_SHARE)
    assert function.gradient_factor([50]).tolist() == pytest.approx([0.6])
    assert function.lighting is not None and function.lighting.specular == 0.3
    assert {f"`{field}`" for field in json.loads(example)} <= set(re.findall(r"`\w+`", text.split("| field |")[1]))


def test_the_python_of_the_document_runs() -> None:
    text = (ROOT / "docs" / "transfer_functions.md").read_text(encoding="utf-8")
    code = text.split("    from clrecon import", 1)[1].split("    volume = ")[0]
    names: dict[str, Any] = {}
    exec("from clrecon import" + code.replace("\n    ", "\n"), names)
    assert names["glass_bone"]([300])[0].tolist() == [0.9, 0.8, 0.6, 0.02]
    share = (1 - names["glass_bone"]([300])[0, 3]) ** 100
    said = f"an opacity of 0.02 per mm lets {100 * share:.0f} % of the light through 100 mm"
    assert said in " ".join(text.split())


def test_transfer_function_that_cannot_be_written_leaves_no_file(tmp_path: Path) -> None:
    function = TransferFunction([(1, 0, 0, 0, 0), (2, 1, 1, 1, 1)])
    with refused(OutputError, "f.json", "folder"):
        function.save(tmp_path / "gone" / "f.json")
    with refused(OutputError, "folder"):
        function.save(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_fields_left_out_of_a_transfer_file_have_their_defaults(tmp_path: Path) -> None:
    function = load_transfer_function(put(tmp_path, OWN))
    assert function == TransferFunction([(100, 1, 0.5, 0, 0), (300, 1, 1, 1, 0.5)])
    nothing = {**OWN, "lighting": None, "gradient_opacity": None}
    assert load_transfer_function(put(tmp_path, nothing)) == function
    dim = load_transfer_function(put(tmp_path, {**OWN, "lighting": {"ambient": 0.1}}))
    assert dim.lighting == Lighting(ambient=0.1)
    marked = b"\xef\xbb\xbf" + json.dumps(OWN).encode()
    assert load_transfer_function(put(tmp_path, marked)) == function


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
def test_wrong_fields_of_our_transfer_files_are_named(tmp_path: Path, place: list[Any], new: Any, message: str) -> None:
    with pytest.raises(RefusedInputError, match=f"^'file.json': .*{message}") as caught:
        load_transfer_function(put(tmp_path, changed(OWN, place, new)))
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
)
def test_files_that_are_no_transfer_functions_are_refused(
    tmp_path: Path, content: str | bytes, facts: tuple[str | int, ...]
) -> None:
    with refused(RefusedInputError, "file.json", *facts):
        load_transfer_function(put(tmp_path, content))


def test_missing_files_folders_and_pipes_are_refused_as_transfer_functions(tmp_path: Path) -> None:
    with refused(UsageError, "gone.json"):
        load_transfer_function(tmp_path / "gone.json")
    with refused(UsageError, "folder"):
        load_transfer_function(tmp_path)
    with refused(RefusedInputError, "cannot"):
        load_transfer_function("a\0b")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with refused(RefusedInputError, "regular"):
            load_transfer_function(tmp_path / "pipe")


def test_slicer_text_is_read_with_any_line_ends(tmp_path: Path) -> None:
    for text in (TEXT, TEXT.replace("\n", "\r\n"), TEXT.rstrip()):
        function = load_transfer_function(put(tmp_path, text, "a.vp"))
        assert function.lighting == Lighting(0.15, 0.8, 0.3, 12)
        assert (function.gradient_opacity, function.unit_distance) == (None, 1.0)
        opacity = function([-2000, 79.9, 80, 490, 900, 3000])[:, 3]
        np.testing.assert_allclose(opacity, [0, 0, 0.25, 0.5, 0.75, 0.75], atol=FLOAT64_SHARE)
        np.testing.assert_allclose(function([-450, 500])[:, :3], [[0.5, 0.25, 0], [1, 0.75, 0.5]], atol=FLOAT64_SHARE)
    # Points of both functions, the step alone twice.
    assert function.points[:, 0].tolist() == [-1000, 80, 80, 100, 900]
    unshaded = load_transfer_function(put(tmp_path, TEXT.replace("1\n1\n", "1\n0\n", 1), "a.vp"))
    assert unshaded.lighting == UNSHADED
    silent = TEXT.splitlines()
    silent[2] = silent[7] = ""
    found = load_transfer_function(put(tmp_path, "\n".join(silent), "a.vp"))
    assert found.lighting == Lighting(0.15, 0.7, 0.3, 12)  # VTK's diffuse


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
)
def test_wrong_lines_of_slicer_text_are_named(
    tmp_path: Path, line: int, new: str, facts: tuple[str | int, ...]
) -> None:
    lines = TEXT.splitlines()
    lines[line - 1] = new
    with refused(RefusedInputError, "a.vp", *facts):
        load_transfer_function(put(tmp_path, "\n".join(lines), "a.vp"))
    with refused(RefusedInputError, "a.vp", 9, "colorTransfer"):
        load_transfer_function(put(tmp_path, "\n".join(TEXT.splitlines()[:8]), "a.vp"))


def test_presets_of_slicer_are_chosen_by_name_or_number(tmp_path: Path) -> None:
    path = put(tmp_path, XML, "presets.xml")
    one = load_transfer_function(path, "ct-one")
    assert (one.name, one.lighting) == ("CT-One", Lighting(0.1, 0.9, 0.2, 10))
    assert one.points.tolist() == [[100, 1, 0, 0, 0], [400, 1, 1, 1, 0.5]]
    assert np.array_equal(one.gradient_opacity, [[0, 0.5], [200, 1]])
    two = load_transfer_function(path, "2")
    assert (two.name, two.lighting) == ("CT-Two", UNSHADED)
    assert two([0, 25, 50]).tolist() == [[0.2, 0.4, 0.6, 0], [0.2, 0.4, 0.6, 0.5], [0.2, 0.4, 0.6, 1]]
    with refused(UsageError, "CT-One", "CT-Two", 3):
        load_transfer_function(path)
    for name in ("CT-Three", "4", "0", "\u00b2"):
        with refused(UsageError, name, "CT-One"):
            load_transfer_function(path, name)
    with refused(RefusedInputError, "broken", "scalarOpacity", 7, 5):
        load_transfer_function(path, "broken")
    assert (
        load_transfer_function(put(tmp_path, XML.replace("utf-8", "utf-16").encode("utf-16"), "16.xml"), "CT-One")
        == one
    )
    twice = put(tmp_path, XML.replace("CT-Two", "CT-One"), "twice.xml")
    with refused(UsageError, "CT-One", 2):
        load_transfer_function(twice, "CT-One")


def test_json_of_slicer_is_read_with_lighting_gradient_and_steps(tmp_path: Path) -> None:
    function = load_transfer_function(put(tmp_path, SLICER, "a.vp.json"))
    assert (function.unit_distance, function.lighting) == (2.5, Lighting(0.2, 1, 0, 1))
    assert np.array_equal(function.gradient_opacity, [[0, 0.25], [100, 1]])
    opacity = function([0, 100, 199.9999, 200.0001, 1000])[:, 3]
    np.testing.assert_allclose(opacity, [0, 0.3, 0.6, 0.1, 0.1], atol=STEP_SIDE)
    # Sharpness 1 is a step at the midpoint.
    assert function([99.9, 100.1])[:, 0].tolist() == [0, 1]
    off = changed(SLICER, ["volumeProperties", 0, "components", 0, "disableGradientOpacity"], True)
    off = changed(off, ["volumeProperties", 0, "components", 0, "shade"], False)
    found = load_transfer_function(put(tmp_path, off))
    assert (found.gradient_opacity, found.lighting) == (None, UNSHADED)
    component = dict(SLICER["volumeProperties"][0]["components"][0])
    component["grayTransferFunction"] = component["scalarOpacity"]
    del component["rgbTransferFunction"]
    grey = load_transfer_function(put(tmp_path, changed(SLICER, ["volumeProperties", 0, "components"], [component])))
    assert grey([100])[0].tolist() == pytest.approx([0.3] * 4, abs=STEP_SIDE)


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
def test_wrong_fields_of_slicer_json_are_named(tmp_path: Path, place: list[Any], new: Any, field: str) -> None:
    value = changed(SLICER, ["volumeProperties", *place], new) if place else {**SLICER, "volumeProperties": []}
    with refused(RefusedInputError, "file.json", field):
        load_transfer_function(put(tmp_path, value))


def test_paraview_files_are_read_and_wrong_ones_refused(tmp_path: Path) -> None:
    function = load_transfer_function(put(tmp_path, PARAVIEW))
    assert (function.name, function.lighting) == ("Bone CT", None)
    np.testing.assert_allclose(function([300]), [[0.75, 0.5, 0.5, 0.4]], atol=FLOAT64_SHARE)
    for place, new, fact in (
        ("Points", None, "opacities"),
        ("ColorSpace", "Lab", "Lab"),
        ("RGBPoints", [1, 2, 3], "1.RGBPoints"),
        ("RGBPoints", None, "RGBPoints"),
    ):
        with refused(RefusedInputError, fact):
            load_transfer_function(put(tmp_path, changed(PARAVIEW, [0, place], new)))


@pytest.mark.fuzz
@pytest.mark.parametrize(
    "sample", daily(2, [OWN, TEXT, XML, SLICER, PARAVIEW]), ids=["own", "vp", "xml", "vp.json", "paraview"]
)
def test_mutated_files_are_read_or_refused_in_one_line(tmp_path: Path, sample: Any) -> None:
    rng = np.random.default_rng(5)
    words = (b"-1", b"1e999", b"nan", b"null", b"[]", b"{}", b'""', b"9" * 40, b"\xff", b"\x00", b"<", b"-1e308", b"\n")
    start = put(tmp_path, sample).read_bytes()
    read = 0
    for _ in range(400):
        data = bytearray(start)
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(len(data)))
            if rng.integers(2):
                data[at:at] = words[rng.integers(len(words))]
            else:
                del data[at : at + int(rng.integers(1, 20))]
        try:
            function = load_transfer_function(put(tmp_path, bytes(data)), "1")
            assert np.isfinite(function.table(*function.range_hu, 16)).all()
            read += 1
        except (RefusedInputError, UsageError) as error:
            assert_one_line(error)
    assert 0 < read < 400
