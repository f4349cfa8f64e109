"""A scene for VTK's volume mappers: the same camera, transfer function, light and ray step that clrecon draws with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Scene:
    """A scene in plain numbers: volume, look and camera.

    affine: Index (i, j, k) to LPS mm, its steps at right angles.
    points: HU, red, green, blue and opacity of the transfer function; linear between them, constant beyond.
    unit_distance, ray_step: mm.
    ambient, diffuse, specular, specular_power: Phong's constants, with a headlight.
    position, focal_point, up: Camera, LPS mm.
    view_angle, parallel_scale: One of the two is given; meanings as in VTK.
    width, height: Pixels.
    """

    affine: Any
    points: Any
    unit_distance: float
    ray_step: float
    ambient: float
    diffuse: float
    specular: float
    specular_power: float
    shade: bool
    position: Any
    focal_point: Any
    up: Any
    view_angle: float | None
    parallel_scale: float | None
    width: int
    height: int


def scene_of(
    volume: Any,
    camera: Any,
    function: Any,
    lighting: Any,
    *,
    size: tuple[int, int],
    ray_step: float,
    shade: bool = True,
) -> Scene:
    """The scene that clrecon draws of `volume` with the same arguments."""
    steps = volume.affine[:3, :3] / volume.spacing
    if volume.uneven or np.abs(steps.T @ steps - np.eye(3)).max() > 1e-4:
        raise RuntimeError("the peer draws volumes with axes at right angles and even slices only")
    if function.gradient_opacity is not None or lighting.direction is not None or lighting.soft_gradient > 0.0:
        raise RuntimeError("the peer draws with opacity by HU, a light at the camera and Phong's shading only")
    return Scene(
        affine=volume.affine.tolist(),
        points=np.asarray(function.points).tolist(),
        unit_distance=function.unit_distance,
        ray_step=ray_step,
        ambient=lighting.ambient,
        diffuse=lighting.diffuse,
        specular=lighting.specular,
        specular_power=lighting.specular_power,
        shade=shade,
        position=list(camera.position),
        focal_point=list(camera.focal_point),
        up=list(camera.up),
        view_angle=camera.view_angle,
        parallel_scale=camera.parallel_scale,
        width=size[0],
        height=size[1],
    )


class Stage:
    """A window with a camera and a volume."""

    def __init__(self, scene: Scene):
        from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow

        self.scene = scene
        self.renderer = vtkRenderer()
        self.renderer.CreateLight()  # at the camera, as Render() does where there is none
        # By default a light of VTK has no ambient part, and the fixed-point mapper then drops the material's too.
        self.renderer.GetLights().GetItemAsObject(0).SetAmbientColor(1.0, 1.0, 1.0)
        self.window = vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.AddRenderer(self.renderer)
        self.window.SetSize(scene.width, scene.height)
        self.volume: Any = None
        self.mapper: Any = None

    def load(self, voxels: NDArray[Any], mapper: Any) -> None:
        """Replace voxels (shared, not copied) and mapper by new ones."""
        from vtkmodules.vtkRenderingCore import vtkVolume

        self.renderer.RemoveAllViewProps()
        mapper.SetInputData(_image_of(voxels, self.scene))
        mapper.SetAutoAdjustSampleDistances(0)
        mapper.SetImageSampleDistance(1.0)
        mapper.SetSampleDistance(self.scene.ray_step)
        self.mapper, self.volume = mapper, vtkVolume()
        self.volume.SetMapper(mapper)
        self.volume.SetProperty(_property_of(self.scene))
        self.volume.SetUserMatrix(_placement_of(self.scene))
        self.renderer.AddVolume(self.volume)
        self._place_camera()

    def _place_camera(self) -> None:
        scene, camera = self.scene, self.renderer.GetActiveCamera()
        camera.SetPosition(scene.position)
        camera.SetFocalPoint(scene.focal_point)
        camera.SetViewUp(scene.up)
        if scene.parallel_scale is not None:
            camera.ParallelProjectionOn()
            camera.SetParallelScale(scene.parallel_scale)
        else:
            camera.SetViewAngle(30.0 if scene.view_angle is None else scene.view_angle)
        self.renderer.ResetCameraClippingRange()
        self.renderer.UpdateLightsGeometryToFollowCamera()


def _image_of(voxels: NDArray[Any], scene: Scene) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    image = vtkImageData()
    image.SetDimensions(*voxels.shape[::-1])
    image.SetSpacing(*np.linalg.norm(np.array(scene.affine)[:3, :3], axis=0))
    image.GetPointData().SetScalars(numpy_to_vtk(voxels.reshape(-1)))
    return image


def _placement_of(scene: Scene) -> Any:
    """Where the image lies: the fixed-point mapper looks at the volume's matrix, not at an image's direction."""
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    placement = np.array(scene.affine)
    placement[:3, :3] /= np.linalg.norm(placement[:3, :3], axis=0)
    matrix = vtkMatrix4x4()
    matrix.DeepCopy(placement.ravel().tolist())
    return matrix


def _property_of(scene: Scene) -> Any:
    from vtkmodules.vtkCommonDataModel import vtkPiecewiseFunction
    from vtkmodules.vtkRenderingCore import vtkColorTransferFunction, vtkVolumeProperty

    colour, opacity = vtkColorTransferFunction(), vtkPiecewiseFunction()
    for number, (hu, red, green, blue, alpha) in enumerate(scene.points):
        # VTK keeps only the last of two points at one place: a step is put between two neighbouring floats.
        place = hu + 1e-4 if number and scene.points[number - 1][0] == hu else hu
        colour.AddRGBPoint(place, red, green, blue)
        opacity.AddPoint(place, alpha)
    found = vtkVolumeProperty()
    found.SetColor(colour)
    found.SetScalarOpacity(opacity)
    found.SetScalarOpacityUnitDistance(scene.unit_distance)
    found.SetInterpolationTypeToLinear()
    found.SetShade(scene.shade)
    found.SetAmbient(scene.ambient)
    found.SetDiffuse(scene.diffuse)
    found.SetSpecular(scene.specular)
    found.SetSpecularPower(scene.specular_power)
    return found


def vtk_version() -> str:
    from vtkmodules.vtkCommonCore import vtkVersion

    return str(vtkVersion.GetVTKVersion())
