"""CT DICOM in, calibrated bone mesh out, computed on any OpenCL device.

>>> import clrecon
>>> volume = clrecon.read_volume("CT_FOLDER")
>>> mesh = clrecon.extract_isosurface(volume, 250)
>>> mesh.save("bone.stl")

The public names are those of ``__init__.pyi`` beside this file.  Each is imported when it is first used: ``import
clrecon`` alone needs no driver and loads neither pyopencl nor VTK.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


def _read_homes() -> dict[str, tuple[str, str]]:
    """Public name: the module that it is imported from, and its name there."""
    import ast
    from pathlib import Path

    homes: dict[str, tuple[str, str]] = {}
    renamed: dict[str, str] = {}
    for line in ast.parse(Path(__file__).with_name("__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(line, ast.ImportFrom) and line.module:
            homes.update({alias.name: (line.module, alias.name) for alias in line.names})
        elif isinstance(line, ast.Assign) and isinstance(line.value, ast.Name):
            renamed.update({target.id: line.value.id for target in line.targets if isinstance(target, ast.Name)})
    public = homes | {name: homes[there] for name, there in renamed.items()}
    return {name: home for name, home in sorted(public.items()) if name not in renamed.values()}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from clrecon.version import package_version

        value: Any = package_version()
    elif name == "_homes":
        value = _read_homes()
    elif name == "__all__":
        value = ["__version__", *__getattr__("_homes")]
    elif not name.startswith("_") and name in (homes := globals().get("_homes") or __getattr__("_homes")):
        module, there = homes[name]
        value = getattr(import_module(module), there)
    else:
        raise AttributeError(f"module 'clrecon' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({name for name in globals() if name.startswith("__")} | {*__getattr__("__all__")})
