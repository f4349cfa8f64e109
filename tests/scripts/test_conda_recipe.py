"""scripts/package/recipe.yaml is built by rattler-build, without a network: its channel is made of this Python."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import venv
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from house import ROOT

rattler_build = pytest.importorskip("rattler_build")

BUILD = "0"
TOOLS = ("pip", "setuptools")
"""What the recipe builds with besides Python."""


def add_package(channel: Path, name: str, version: str, files: Path, *needed: str) -> dict[str, Any]:
    """Put a conda package of `files` into a channel, and return its entry of the channel's list."""
    output = rattler_build.assemble_package(
        name, version, "linux-64", BUILD, channel, files_dir=files, depends=needed, compression_level=1
    )
    data = Path(output.path).read_bytes()
    sums = {name: getattr(hashlib, name)(data).hexdigest() for name in ("md5", "sha256")}
    facts = {"name": name, "version": version, "build": BUILD, "build_number": 0, "depends": needed}
    return {Path(output.path).name: {**facts, **sums, "size": len(data), "subdir": "linux-64"}}


def copy_tool(name: str, site: Path) -> str:
    """Copy the installed files of a package to a folder, and return its version."""
    tool = metadata.distribution(name)
    for file in tool.files or ():
        if ".." not in file.parts and file.suffix != ".pyc":
            (site / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(str(tool.locate_file(file)), site / file)
    return tool.version


@pytest.fixture
def channel(tmp_path: Path) -> Path:
    """A channel with this Python, as an environment that links to it, and what builds wheels here."""
    folder = tmp_path / "channel" / "linux-64"
    folder.mkdir(parents=True)
    python = ".".join(map(str, sys.version_info[:3]))
    venv.create(tmp_path / "python", symlinks=True)
    listed = add_package(folder, "python", python, tmp_path / "python")
    for name in TOOLS:
        version = copy_tool(name, tmp_path / name / "lib" / "python{}.{}".format(*sys.version_info) / "site-packages")
        listed |= add_package(folder, name, version, tmp_path / name, "python")
    for subdir, packages in {"linux-64": listed, "noarch": {}}.items():
        text = json.dumps({"info": {"subdir": subdir}, "packages": {}, "packages.conda": packages})
        (folder.parent / subdir).mkdir(exist_ok=True)
        (folder.parent / subdir / "repodata.json").write_text(text)
    return folder.parent


@pytest.mark.release
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the channel is one of linux-64")
def test_conda_package_of_the_recipe_has_all_kernels_for_any_system(channel: Path, tmp_path: Path) -> None:
    recipe = ROOT / "scripts" / "package" / "recipe.yaml"
    rattler_build.build_recipes([recipe], channel=[channel.as_uri()], test="skip", output_dir=tmp_path / "built")

    [path] = (tmp_path / "built" / "noarch").glob("clrecon-*.conda")
    package = rattler_build.Package.from_file(path)
    kernels = [kernel.relative_to(ROOT).as_posix() for kernel in (ROOT / "cl").rglob("*.cl")]
    assert kernels
    assert {f"site-packages/clrecon/{kernel}" for kernel in kernels} <= set(package.files)
    assert package.noarch == "python"
