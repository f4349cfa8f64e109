"""What the guards share: the files of the project, and which layer may import what (the one table)."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Container, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "clrecon"
ABSOLUTE_PATH = re.compile(r"""(?:^|[\s"'=:(])(/\w[\w.-]*/[\w./-]*|[A-Z]:\\)""")
"""The path of a file or folder of some machine, in a text."""

LEFT_OF: dict[str, frozenset[str]] = {}
"""For each layer (a module or folder of clrecon/) the layers that it may import."""


def _layer(name: str, allowed: str = "") -> None:
    LEFT_OF[name] = frozenset(allowed.split())


_layer("errors")
_layer("version")
_layer("system", "errors")
_layer("opencl", "errors version system")
_layer("geometry", "errors system")
_layer("anatomy", "errors system geometry")
_layer("exchange", "errors version system geometry")
_layer("reading", "errors system geometry exchange")
_layer("labels", "errors version system geometry reading")
_layer("spine", "errors system geometry anatomy labels")
_layer("mesh", "errors system geometry anatomy exchange")
_layer("points", "errors system geometry exchange")
_layer("rendering", "errors version system geometry labels")
_layer("operators", "errors system opencl geometry anatomy labels mesh points rendering")
_layer(
    "jobs",
    "errors version system opencl geometry anatomy exchange reading labels spine mesh points rendering operators",
)
_layer("viewer", "errors system opencl geometry anatomy exchange reading labels mesh points rendering operators jobs")
_layer("proof", "errors version system opencl geometry exchange reading labels mesh points rendering operators jobs")
_layer("cli", "errors version system jobs viewer proof")
_layer("__main__", "cli")
_layer(
    "__init__",
    "errors version system opencl geometry anatomy reading labels spine mesh points rendering operators viewer proof",
)

# Third-party packages: at module level (paid by whoever imports the layer), or only inside functions.
AT_MODULE_LEVEL: dict[str, frozenset[str]] = {
    "system": frozenset({"numpy"}),
    "geometry": frozenset({"numpy"}),
    "anatomy": frozenset({"numpy"}),
    "reading": frozenset({"numpy", "pydicom", "isal"}),
    "labels": frozenset({"numpy"}),
    "mesh": frozenset({"numpy"}),
    "points": frozenset({"numpy"}),
    "exchange": frozenset({"numpy", "isal"}),
    "rendering": frozenset({"numpy"}),
    "opencl": frozenset({"numpy"}),
    "operators": frozenset({"numpy"}),
    "jobs": frozenset({"numpy"}),
    "viewer": frozenset({"numpy"}),
    "proof": frozenset({"numpy", "pydicom"}),
    "spine": frozenset({"numpy"}),
}
INSIDE_FUNCTIONS: dict[str, frozenset[str]] = {
    "geometry": frozenset({"scipy", "pyvista", "nibabel", "SimpleITK"}),
    "anatomy": frozenset({"scipy"}),
    "reading": frozenset({"imagecodecs", "openjpeg", "rle", "jpeg_ls", "pylibjpeg", "nibabel", "nrrd", "SimpleITK"}),
    "labels": frozenset({"pydicom", "scipy"}),
    "exchange": frozenset({"vtk", "vtkmodules", "pyvista", "laspy"}),
    "mesh": frozenset({"scipy", "pyvista", "vtk", "vtkmodules", "fast_simplification", "trimesh"}),
    "points": frozenset({"open3d"}),
    "rendering": frozenset({"scipy", "PIL", "imageio_ffmpeg", "pyvista", "vtk", "vtkmodules"}),
    "opencl": frozenset({"pyopencl"}),
    # typing_extensions: for type checkers alone, which bring it.
    "operators": frozenset({"pyopencl", "SimpleITK", "skimage", "typing_extensions"}),
    "jobs": frozenset({"PIL", "dask"}),
    "viewer": frozenset({"aiohttp", "PIL", "napari", "pyvista", "vtk", "vtkmodules"}),
    # vtkmodules: peers of the bench and of the comparison, whose page has plots and pictures.
    "proof": frozenset({"scipy", "pyvista", "vtkmodules", "matplotlib", "PIL"}),
    "spine": frozenset({"scipy"}),
}


def package_modules() -> dict[str, Path]:
    """Dotted name -> file of every module of clrecon/; ``clrecon.__init__`` is the stub with the public names."""
    modules = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return modules | {"clrecon.__init__": PACKAGE / "__init__.pyi"}


def project_files(*suffixes: str) -> list[Path]:
    """Files of the project (no environments, caches, build folders) whose name ends with one of `suffixes`."""
    left_out = {"build", "dist", "clrecon-demo", "__pycache__"}
    found: list[Path] = []
    for top in sorted(ROOT.iterdir()):
        if top.name in left_out or (top.name.startswith(".") and top.name != ".ci") or top.name.endswith(".egg-info"):
            continue
        candidates = [top] if top.is_file() else top.rglob("*")
        found.extend(
            path for path in candidates if path.is_file() and not left_out.intersection(path.relative_to(ROOT).parts)
        )
    return sorted(path for path in found if not suffixes or path.name.endswith(suffixes))


def statements_of(source: str) -> Iterator[ast.stmt]:
    """All statements of a source; walking through their expressions too would take five times as long."""
    left: list[ast.AST] = [ast.parse(source)]
    while left:
        node = left.pop()
        if isinstance(node, ast.stmt):
            yield node
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            inner = getattr(node, block, [])
            left += inner if isinstance(inner, list) else []  # that of a lambda or a choice is an expression


def layer_of(module: str) -> str:
    """``clrecon.mesh.refine.decimation`` -> ``mesh``; ``clrecon`` -> ``__init__``."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def _is_type_checking(test: ast.expr) -> bool:
    return (isinstance(test, ast.Name) and test.id == "TYPE_CHECKING") or (
        isinstance(test, ast.Attribute) and test.attr == "TYPE_CHECKING"
    )


def walk_imports(
    node: ast.AST, module: str, is_package: bool, deferred: bool = False
) -> Iterator[tuple[str, bool, int]]:
    """Yield (imported module, is it deferred, line) of every import; annotations-only imports count as deferred."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.expr):  # in which no statement stands
            continue
        if isinstance(child, ast.Import):
            for alias in child.names:
                yield alias.name, deferred, child.lineno
        elif isinstance(child, ast.ImportFrom):
            yield from _imports_from(child, module, is_package, deferred)
        elif isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield from walk_imports(child, module, is_package, True)
        elif isinstance(child, ast.If) and _is_type_checking(child.test):
            yield from walk_imports(child, module, is_package, True)
        else:
            yield from walk_imports(child, module, is_package, deferred)


@cache
def read_imports(source: str, module: str, is_package: bool = False) -> tuple[tuple[str, bool, int], ...]:
    """The imports of a source, read once for all guards that ask."""
    return tuple(walk_imports(ast.parse(source), module, is_package))


def _imports_from(
    node: ast.ImportFrom, module: str, is_package: bool, deferred: bool
) -> Iterator[tuple[str, bool, int]]:
    name = node.module or ""
    if node.level:
        parts = module.split(".")
        base = parts[: len(parts) - node.level + (1 if is_package else 0)]
        name = ".".join([*base, name] if name else base)
    if name == "clrecon":  # from clrecon import geometry: the names are layers or public names
        for alias in node.names:
            layer = alias.name if alias.name in LEFT_OF else "__init__"
            yield (f"clrecon.{layer}" if layer != "__init__" else "clrecon"), deferred, node.lineno
    else:
        yield name, deferred, node.lineno


def find_layer_faults(source: str, module: str, is_package: bool = False) -> list[str]:
    """Imports in `source` that the table does not allow, one line each."""
    own = layer_of(module)
    if own not in LEFT_OF:
        return [f"{module}: layer {own!r} is not in the table of tests/support/house.py"]
    faults = []
    for name, deferred, line in read_imports(source, module, is_package):
        top = name.split(".")[0]
        if top == "clrecon":
            other = layer_of(name)
            if other != own and other not in LEFT_OF[own]:
                faults.append(f"{module}:{line}: layer {own} may not import {name}")
        elif top not in sys.stdlib_module_names:
            allowed = AT_MODULE_LEVEL.get(own, frozenset())
            if deferred:
                allowed = allowed | INSIDE_FUNCTIONS.get(own, frozenset())
            if top not in allowed:
                where = "" if deferred else " at module level"
                faults.append(f"{module}:{line}: layer {own} may not import {top}{where}")
    return faults


def imported_files(source: str, known: Container[str]) -> set[str]:
    """Modules of `known` that `source` imports, wherever in the file and for whatever: deferred, for annotations."""
    found = set()
    for node in statements_of(source):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {
                f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in known else node.module
                for alias in node.names
            }
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name in known}


def find_circles(imports: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """Groups of names that reach each other through `imports` (name -> names it imports), each sorted.

    Tarjan's strongly connected components (1972), without recursion.
    """
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    path: list[str] = []
    circles = []
    for start in imports:
        work = [(start, iter(imports[start]))] if start not in order else []
        while work:
            name, others = work[-1]
            if name not in order:
                order[name] = lowest[name] = len(order)
                path.append(name)
            unseen = None
            for other in others:
                if other in imports and other not in order:
                    unseen = other
                    break
                if other in path:
                    lowest[name] = min(lowest[name], order[other])
            if unseen is not None:
                work.append((unseen, iter(imports[unseen])))
                continue
            work.pop()
            if work:
                lowest[work[-1][0]] = min(lowest[work[-1][0]], lowest[name])
            if lowest[name] == order[name]:
                group = path[path.index(name) :]
                del path[path.index(name) :]
                if len(group) > 1 or name in imports[name]:
                    circles.append(sorted(group))
    return circles
