"""The Python examples of the pages of docs/ run as they stand, from top to bottom, on a small phantom."""

from __future__ import annotations

import ast
import inspect
import os
import re
import textwrap
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
from house import ROOT
from variants import but_seldom

import clrecon
from clrecon.proof.phantom import PhantomSettings, write_phantom

FENCED = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^ {4}\S.*\n(?:\n? {4,}\S.*\n)*)", re.MULTILINE)
SHELL = re.compile(r"^(clrecon|python3?|pip) ", re.MULTILINE)
FOR_A_RELEASE = {"clouds", "corridor", "inside", "measures", "tasks", "transfer_functions"}
"""Pages that take long; every day their calls are compared with the signatures, and jobs' own tests make the same."""
ELSEWHERE = {"certificate", "cookbook", "python", "tour", "view"}
"""Pages with tests of their own, and without Python that begins by itself."""

OPTIONAL = ("dask", "open3d", "pandas", "pyacvd", "tetgen")
"""What a block may import, or convert to, that is installed for a release alone; without it the block is left out."""

SMALLER = {
    '"CT_FOLDER"': '"ct"',
    '"PHANTOM_FOLDER"': '"ct"',
    '"twelve"': '"ct"',
    '"spine.nii.gz"': '"ct/levels.nrrd"',
    "size=(512, 512)": "size=(64, 64)",
    "TransferFunction.from_vtk(actor.prop, voxel_mm=0.8)    # any vtkVolumeProperty\n": "",
}
"""What the machine of a test has not, or what takes long, and what stands for it."""
if find_spec("open3d") is None:  # installed for a release
    SMALLER["dense.to_open3d().to_legacy()"] = "dense"
    SMALLER["clrecon.PointCloud.from_open3d(legacy)"] = "legacy"


def find_python(text: str) -> list[str]:
    """The Python blocks of a page, fenced or indented, in their order."""
    fenced = {match.start(): match[1] for match in FENCED.finditer(text)}
    bare = re.sub(r"^```.*?^```", lambda match: re.sub(r"[^\n]", ".", match[0]), text, flags=re.MULTILINE | re.DOTALL)
    indented = {match.start(): textwrap.dedent(match[0]) for match in INDENTED.finditer(bare)}
    python = {start: block for start, block in indented.items() if "clrecon" in block and not SHELL.search(block)}
    return [block for _, block in sorted({**fenced, **python}.items())]


PAGES = {
    path.stem: blocks
    for path in sorted((ROOT / "docs").glob("*.md"))
    if path.stem not in ELSEWHERE and (blocks := find_python(path.read_text(encoding="utf-8")))
}


@pytest.fixture(scope="module")
def series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small spine, and the meshes and the cloud that the pages read."""
    folder = tmp_path_factory.mktemp("docs")
    write_phantom(folder / "ct", PhantomSettings(levels="L2-L4", size=(72, 72), spacing=(2.5, 2.5, 2.5)))
    volume = clrecon.read_volume(folder / "ct")
    mesh = clrecon.extract_isosurface(volume, 226)
    for name in ("a.stl", "b.stl", "bone.stl", "l3.stl", "l4.stl"):
        mesh.save(folder / name)
    points = clrecon.cluster_points(volume, hu=(226, 3000)).cloud
    for name in ("scan.ply", "cloud.ply"):
        points.save(folder / name)
    line = clrecon.find_spine_line(volume).points[::4]
    points_of = ", ".join(f'{{"position": [{x}, {y}, {z}]}}' for x, y, z in line)
    curve = f'{{"markups": [{{"type": "Curve", "coordinateSystem": "LPS", "controlPoints": [{points_of}]}}]}}'
    (folder / "line.mrk.json").write_text(curve, encoding="utf-8")
    return folder


PAGE = """\
x

    clrecon mesh A -o b.stl

y

    a = clrecon.f()

    b = 1

```json
    clrecon.g()
```

```python
import clrecon
```
    P = S + X
"""
"""A command, indented Python, JSON, fenced Python and a formula."""


def test_indented_and_fenced_python_of_a_page_is_found() -> None:
    assert find_python(PAGE) == ["a = clrecon.f()\n\nb = 1\n", "import clrecon\n"]


def test_pages_with_python_examples_are_found() -> None:
    assert {"clouds", "export", "filters", "masks", "measures", "rendering", "slices", "solid"} <= set(PAGES)


def find_wrong_calls(source: str) -> list[str]:
    """Calls of public functions and classes that their signatures do not take."""
    wrong = []
    for call in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)):
        name = ast.unparse(call.func)
        if not re.fullmatch(r"clrecon(\.\w+)+", name) or any(isinstance(each, ast.Starred) for each in call.args):
            continue
        try:
            called = attrgetter(name.removeprefix("clrecon."))(clrecon)
            words = {keyword.arg: None for keyword in call.keywords if keyword.arg}
            inspect.signature(called).bind_partial(*call.args, **words)
        except (AttributeError, TypeError) as error:
            wrong.append(f"{name}: {error}")
    return wrong


@pytest.mark.parametrize("name", PAGES)
def test_calls_of_clrecon_on_a_page_match_the_signatures(name: str) -> None:
    assert [wrong for block in PAGES[name] for wrong in find_wrong_calls(block)] == []


@pytest.mark.parametrize(
    ("source", "faults"),
    [
        ("clrecon.Mesh.load(x)", ["clrecon.Mesh.load: type object 'Mesh' has no attribute 'load'"]),
        ("f(clrecon.read_mesh('a', b=1))", ["clrecon.read_mesh: got an unexpected keyword argument 'b'"]),
        ("clrecon.cut_slice(v, size=(2, 2))", []),
    ],
    ids=["no such method", "no such keyword", "right"],
)
def test_call_that_does_not_match_its_signature_is_found(source: str, faults: list[str]) -> None:
    assert find_wrong_calls(source) == faults


@pytest.mark.parametrize("name", but_seldom(PAGES, FOR_A_RELEASE))
def test_python_examples_of_a_page_run_and_make_something(
    name: str, series: Path, device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(series)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    made: dict[str, Any] = {"clrecon": clrecon}
    if name in ("rendering", "regions"):  # whose text says what `volume` is
        made["volume"] = clrecon.read_volume("ct")
    before, files = set(made), set(os.listdir())
    missing = [package for package in OPTIONAL if find_spec(package) is None]
    for block in PAGES[name]:
        if any(re.search(rf"^(import|from) {package}\b|_{package}\(", block, re.MULTILINE) for package in missing):
            continue
        for long, short in SMALLER.items():
            block = block.replace(long, short)
        exec(compile(block, f"docs/{name}.md", "exec"), made)
    assert set(made) - before - {"__builtins__"} or set(os.listdir()) - files, f"docs/{name}.md makes nothing"
