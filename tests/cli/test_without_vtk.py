"""Commands in an installation that has neither VTK nor pyvista, or no scipy."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clrecon import read_mesh
from clrecon.cli.main import main
from clrecon.proof.compare.job import choose_installed
from clrecon.proof.compare.methods import COMPARED, CompareSettings
from clrecon.proof.phantom import PhantomSettings, write_phantom

OF_VTK = ("vtk", "vtkmodules", "pyvista")


def hide_packages(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Let these packages be imported no more."""
    for name in {*packages, *(name for name in sys.modules if name.split(".")[0] in packages)}:
        monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def without_vtk(monkeypatch: pytest.MonkeyPatch) -> None:
    """VTK and pyvista cannot be imported."""
    hide_packages(monkeypatch, *OF_VTK)


@pytest.fixture
def small_ct(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A CT in the folder ct of the working folder."""
    monkeypatch.chdir(tmp_path)
    write_phantom(tmp_path / "ct", PhantomSettings(size=(80, 80), slices=30, spacing=(2.4, 2.4, 3.0)))


@pytest.fixture
def ct_without_vtk(small_ct: None, without_vtk: None) -> None:
    """The same where VTK cannot be imported."""
    with pytest.raises(ModuleNotFoundError):
        from vtkmodules import vtkCommonCore  # noqa: F401


@pytest.mark.usefixtures("ct_without_vtk")
@pytest.mark.parametrize(
    "command",
    [
        "mesh ct -o a.vtp --smooth",
        "mesh ct -o b.ply --decimate 0.5",
        "mesh ct -o c.stl --for print",
        "cloud ct -o d.vtp",
    ],
)
def test_command_that_refines_or_writes_files_of_vtk_writes_its_file_without_it(device: Any, command: str) -> None:
    assert main([*command.split(), "--device", str(device.index)]) == 0
    _, _, _, output, *_ = command.split()
    assert Path(output).stat().st_size > 100_000  # bytes; measured 196,884 and more


@pytest.mark.usefixtures("ct_without_vtk")
def test_comparison_without_matplotlib_has_a_page_without_plots_that_says_so_as_its_report_does(
    device: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hide_packages(monkeypatch, "matplotlib")

    code = main(f"compare ct -o report --hu 226 --methods t-mc --repeat 1 --device {device.index}".split())

    assert code == 0
    left_out = "left out, their packages are not installed: plots (matplotlib)"
    assert left_out in " ".join(capsys.readouterr().err.split())
    assert left_out in json.loads(Path("report/report.json").read_text())["warnings"]
    page = Path("report/index.html").read_text()
    assert left_out in page
    assert "<svg" not in page


@pytest.mark.usefixtures("without_vtk")
def test_all_methods_without_their_packages_are_left_out_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    hide_packages(monkeypatch, "skimage", "matplotlib")

    methods, lines = choose_installed(CompareSettings())

    assert [name for name in COMPARED if name not in [method.name for method in methods]] == [
        "skimage", "vtk-mc", "vtk-fe"
    ]  # fmt: skip
    (line,) = lines
    assert line.endswith(": plots (matplotlib), skimage (scikit-image), vtk-mc and vtk-fe (vtk)")


@pytest.mark.usefixtures("ct_without_vtk")
def test_distances_between_meshes_are_measured_and_drawn_without_vtk(device: Any) -> None:
    for output in ("a.vtp", "b.ply"):
        assert main(["mesh", "ct", "-o", output, "--decimate", "0.5", "--device", str(device.index), "-q"]) == 0
    assert main("distance b.ply a.vtp -o e.ply --picture e.png".split()) == 0
    assert Path("e.ply").stat().st_size > Path("b.ply").stat().st_size  # the same mesh with distances
    assert Path("e.png").stat().st_size > 100_000  # bytes; measured 217,649


@pytest.mark.usefixtures("ct_without_vtk")
def test_nearest_points_and_rays_of_a_mesh_are_found_without_vtk(device: Any) -> None:
    assert main(["mesh", "ct", "-o", "b.ply", "--device", str(device.index), "-q"]) == 0
    mesh = read_mesh("b.ply")

    _, distances, _ = mesh.closest_points(mesh.vertices[:3])
    assert distances == pytest.approx(0.0, abs=1e-6)  # of vertices in float32
    middles = mesh.vertices[mesh.triangles[:3]].mean(axis=1)
    above = middles + [0.0, 0.0, 500.0]  # mm: outside of the mesh
    assert np.isfinite(mesh.ray(above, middles - above)).all()


@pytest.fixture
def ct_without_scipy(small_ct: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same where scipy cannot be imported."""
    hide_packages(monkeypatch, "scipy", "skimage")


@pytest.mark.usefixtures("ct_without_scipy")
@pytest.mark.parametrize(
    "command",
    [
        "mesh ct -o a.stl --hu auto --keep-largest 1 --remove-table",
        "mesh ct -o f.stl --surface cortex",
        "render ct -o b.png --size 64",
        "cloud ct -o c.ply --hu 300,3000",
        "export ct -o d.nii.gz",
        "view ct --html e.html",
    ],
)
def test_command_that_uses_no_labels_runs_without_scipy(device: Any, command: str) -> None:
    words = command.split()
    named = [] if words[0] == "export" else ["--device", str(device.index)]
    assert main([*words, *named]) == 0
    assert Path(words[3]).stat().st_size > 1000  # bytes


@pytest.mark.usefixtures("ct_without_scipy")
@pytest.mark.parametrize(
    ("command", "package"),
    [
        ("export ct -o a.nii.gz --resample 2", "scipy"),
        ("vertebrae ct -o a.nii.gz", "scipy"),
        ("mesh ct -o a.stl --method skimage", "scikit-image"),
        ("compare ct -o a --methods skimage", "scikit-image"),
        ("compare ct -o a --reference skimage", "scikit-image"),
    ],
)
def test_command_names_the_package_that_it_lacks_and_writes_nothing(
    device: Any, command: str, package: str, printed: Any
) -> None:
    named = ["--device", str(device.index)] if command.startswith(("mesh", "compare")) else []
    assert main([*command.split(), *named, "-q"]) == 3
    printed().assert_error(package)
    assert [path.name for path in Path().iterdir()] == ["ct"]
