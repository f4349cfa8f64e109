"""Transfer functions to and from VTK and pyvista, with their own answers as the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from tolerances import BENT_WAY, COLOR_SPACE_WAY, FLOAT64_SHARE

from clrecon.errors import UsageError
from clrecon.rendering import PRESETS, UNSHADED, Lighting, TransferFunction

pytestmark = pytest.mark.unit

vtk_data = pytest.importorskip("vtkmodules.vtkCommonDataModel")
vtk_core = pytest.importorskip("vtkmodules.vtkRenderingCore")

STEPPED = [(0, 0, 0, 0, 0), (100, 1, 1, 1, 0.2), (100, 1, 0, 0, 0.6), (300, 1, 1, 0.5, 1)]
LIGHT = Lighting(ambient=0.1, diffuse=0.9, specular=0.3, specular_power=20)


def make_property(opacity, colors):
    made = vtk_core.vtkVolumeProperty()
    made.SetScalarOpacity(opacity)
    made.SetColor(colors)
    return made


@pytest.fixture
def of_stepped():
    """A transfer function with a step at 100 HU and one of its gradient opacity, and its property of VTK."""
    function = TransferFunction(
        STEPPED, unit_distance=2.5, lighting=LIGHT, gradient_opacity=[(0, 0.1), (40, 0.1), (40, 1)]
    )
    return function, function.to_vtk(voxel_mm=0.5)


def test_colours_and_opacities_of_vtk_are_those_of_the_transfer_function(of_stepped) -> None:
    function, prop = of_stepped
    hu = np.array([-10, 0, 50, 99.9999, 100, 100.0001, 200, 300, 900.0])
    in_vtk = [[*prop.GetRGBTransferFunction().GetColor(x), prop.GetScalarOpacity().GetValue(x)] for x in hu]
    np.testing.assert_allclose(in_vtk, function(hu), atol=FLOAT64_SHARE)


def test_gradient_opacity_of_vtk_is_in_hu_per_voxel(of_stepped) -> None:
    _, prop = of_stepped
    step = 40 * 0.5  # HU per mm of the step from 0.1 to 1, times mm per voxel
    factors = [prop.GetGradientOpacity().GetValue(x) for x in (step - 0.1, step, step + 10)]
    assert factors == pytest.approx([0.1, 1, 1])


def test_unit_distance_and_light_of_vtk_are_those_of_the_transfer_function(of_stepped) -> None:
    _, prop = of_stepped
    assert prop.GetScalarOpacityUnitDistance() == 2.5
    light = (prop.GetAmbient(), prop.GetDiffuse(), prop.GetSpecular(), prop.GetSpecularPower())
    assert light == (LIGHT.ambient, LIGHT.diffuse, LIGHT.specular, LIGHT.specular_power)
    assert prop.GetShade() == 1


@pytest.mark.parametrize("gradient", [None, [(0, 0), (50, 1), (50, 0.5)]])
@pytest.mark.parametrize("light", [LIGHT, UNSHADED])
def test_transfer_function_comes_back_from_vtk_unchanged(gradient: object, light: Lighting) -> None:
    function = TransferFunction(STEPPED, unit_distance=0.25, gradient_opacity=gradient, lighting=light)
    assert TransferFunction.from_vtk(function.to_vtk()) == function
    assert TransferFunction.from_vtk(function.to_vtk(voxel_mm=0.5), voxel_mm=0.5) == function


@pytest.mark.parametrize("name", PRESETS)
def test_preset_comes_back_from_vtk_with_its_plain_light(name: str) -> None:
    function = PRESETS[name].transfer_function
    phong = replace(function.lighting, soft_gradient=0.0)  # VTK has no other
    assert TransferFunction.from_vtk(function.to_vtk()) == function.changed(lighting=phong)


@pytest.mark.parametrize("clamped", [True, False])
def test_bent_functions_of_vtk_are_read_with_their_values_and_ends(clamped: bool) -> None:
    rng = np.random.default_rng(7)
    at = rng.uniform(-1500, 2500, 500)
    for _ in range(40):
        opacity, colors = vtk_data.vtkPiecewiseFunction(), vtk_core.vtkColorTransferFunction()
        places = np.sort(rng.uniform(-1000, 2000, 6))
        for x in places:
            middle, sharp = rng.choice([0.5, 0.3, 0.8, 0.01]), rng.choice([0, 0.005, 0.3, 0.5, 0.9, 1])
            opacity.AddPoint(x, rng.uniform(), middle, sharp)
            colors.AddRGBPoint(x, *rng.uniform(size=3), middle, sharp)
        opacity.SetClamping(clamped)
        function = TransferFunction.from_vtk(make_property(opacity, colors))
        want = [[*colors.GetColor(x), opacity.GetValue(x)] for x in at]
        np.testing.assert_allclose(function(at), want, atol=BENT_WAY)


@pytest.mark.parametrize("space", ["HSV", "Lab", "Diverging"])
def test_colours_of_vtk_in_another_colour_space_are_read(space: str) -> None:
    colors, opacity = vtk_core.vtkColorTransferFunction(), vtk_data.vtkPiecewiseFunction()
    getattr(colors, f"SetColorSpaceTo{space}")()
    for x, color in ((-100, (0.2, 0.3, 0.8)), (200, (0.8, 0.8, 0.3)), (900, (0.7, 0.1, 0.1))):
        colors.AddRGBPoint(x, *color)
    opacity.AddPoint(0, 0)
    opacity.AddPoint(900, 0.5)
    function = TransferFunction.from_vtk(make_property(opacity, colors))
    at = np.linspace(-200, 1000, 601)
    np.testing.assert_allclose(function(at)[:, :3], [colors.GetColor(x) for x in at], atol=COLOR_SPACE_WAY)


def test_grey_property_of_vtk_without_shading_is_read() -> None:
    grey, opacity = vtk_data.vtkPiecewiseFunction(), vtk_data.vtkPiecewiseFunction()
    for function in (grey, opacity):
        function.AddPoint(0, 0)
        function.AddPoint(100, 1)
    made = vtk_core.vtkVolumeProperty()
    made.SetColor(grey)
    made.SetScalarOpacity(opacity)
    found = TransferFunction.from_vtk(made, name="grey")
    assert found([25]).tolist() == [[0.25] * 4]
    assert (found.lighting, found.gradient_opacity, found.name) == (UNSHADED, None, "grey")


def test_property_of_vtk_without_points_is_refused() -> None:
    empty = make_property(vtk_data.vtkPiecewiseFunction(), vtk_core.vtkColorTransferFunction())
    with refused(UsageError, "colour", "points"):
        TransferFunction.from_vtk(empty)


def test_text_in_place_of_a_property_of_vtk_is_refused() -> None:
    with refused(UsageError, "vtkVolumeProperty"):
        TransferFunction.from_vtk("bone")


@pytest.mark.parametrize(
    "convert",
    [
        lambda: TransferFunction.from_vtk(TransferFunction(STEPPED).to_vtk(), voxel_mm=0),
        lambda: TransferFunction(STEPPED).to_vtk(voxel_mm=np.nan),
    ],
    ids=["from VTK", "to VTK"],
)
def test_mean_spacing_that_is_no_length_is_refused(convert) -> None:
    with refused(UsageError, "spacing", "length"):
        convert()


def test_colours_of_vtk_on_a_logarithmic_scale_are_refused() -> None:
    colors = vtk_core.vtkColorTransferFunction()
    colors.AddRGBPoint(1, 0, 0, 0)
    colors.AddRGBPoint(9, 1, 1, 1)
    colors.SetScaleToLog10()
    made = make_property(vtk_data.vtkPiecewiseFunction(), colors)

    with pytest.raises(UsageError, match="logarithm"):
        TransferFunction.from_vtk(made)


@pytest.mark.parametrize("opacity", ["sigmoid_5", "linear_r", 0.3, [0, 0.1, 0.9], list(np.linspace(0, 0.9, 256))])
def test_transfer_function_of_pyvista_is_what_its_scene_shows(opacity: object) -> None:
    pyvista = pytest.importorskip("pyvista")
    image = pyvista.ImageData(dimensions=(4, 4, 4))
    image["hu"] = np.linspace(-200, 1200, 64)
    plotter = pyvista.Plotter(off_screen=True)
    # An array of 256 has 0 to 255 there.
    theirs = np.multiply(opacity, 255) if isinstance(opacity, list) and len(opacity) == 256 else opacity
    actor = plotter.add_volume(image, cmap="bone", opacity=theirs, clim=(-200, 1200), opacity_unit_distance=1.5)
    shown = TransferFunction.from_vtk(actor.prop)
    plotter.close()
    found = TransferFunction.from_pyvista("bone", opacity, (-200, 1200), unit_distance=1.5, name="x")
    assert (found.unit_distance, found.name, found.range_hu) == (1.5, "x", (-200, 1200))
    at = np.linspace(*shown.range_hu, 256)  # some versions of pyvista map HU to 0..255 for the scene
    np.testing.assert_allclose(found.points[:, 1:], shown(at), atol=FLOAT64_SHARE)


@pytest.mark.parametrize(
    ("cmap", "opacity", "clim", "message"),
    [
        ("no-such-map", "linear", (0, 1), "does not take this colour map or opacity: .*no-such-map"),
        ("bone", "no-such", (0, 1), "does not take .*no-such"),
        ("bone", 2.0, (0, 1), "between 0 and 1, got 2.0"),
        ("bone", [0, 3], (0, 1), "two or more numbers between 0 and 1"),
        ("bone", [0.0] * 300, (0, 1), "does not take"),
        ("bone", "linear", (5, 5), "a lower and a higher HU"),
        ("bone", "linear", (0, np.nan), "a lower and a higher HU"),
    ],
)
def test_colour_map_opacity_or_limits_that_pyvista_does_not_take_are_refused(
    cmap: str, opacity: object, clim: tuple[float, float], message: str
) -> None:
    pytest.importorskip("pyvista")
    with pytest.raises(UsageError, match=message):
        TransferFunction.from_pyvista(cmap, opacity, clim)
