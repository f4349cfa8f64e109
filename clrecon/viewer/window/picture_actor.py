"""`PictureActor`: a picture of ours in a scene of VTK, with its own depth.

The picture fills its renderer and is drawn by a shader that writes the depth of each pixel, so that lines and meshes of
VTK are in front of it or behind it, pixel by pixel.  VTK is only the glass: it draws a rectangle, whatever the picture
shows.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from clrecon.rendering import Rendering
    from clrecon.rendering.views.camera import Camera

_COLOR = """
  // VTK would multiply both textures: this is all that is drawn.  Row 0 of a picture is its top.
  vec2 pictureSize = vec2(textureSize(pictureColor, 0));
  vec2 place = vec2(tcoordVCVSOutput.x, 1.0 - tcoordVCVSOutput.y) * pictureSize;
  vec4 shown;
  if (pictureSmooth > 0) {
    // Between four pixels, weighted with their opacity: a transparent one has no colour.
    vec2 corner = floor(place - 0.5);
    vec2 share = place - 0.5 - corner;
    ivec2 last = ivec2(pictureSize) - 1;
    ivec2 low = clamp(ivec2(corner), ivec2(0), last);
    ivec2 high = clamp(ivec2(corner) + 1, ivec2(0), last);
    vec4 a = texelFetch(pictureColor, low, 0);
    vec4 b = texelFetch(pictureColor, ivec2(high.x, low.y), 0);
    vec4 c = texelFetch(pictureColor, ivec2(low.x, high.y), 0);
    vec4 d = texelFetch(pictureColor, high, 0);
    vec2 rest = 1.0 - share;
    vec4 weight = vec4(a.a, b.a, c.a, d.a)
      * vec4(rest.x * rest.y, share.x * rest.y, rest.x * share.y, share.x * share.y);
    float opacity = weight.x + weight.y + weight.z + weight.w;
    vec3 sum = a.rgb * weight.x + b.rgb * weight.y + c.rgb * weight.z + d.rgb * weight.w;
    shown = vec4(sum / max(opacity, 1e-6), opacity);
  } else {
    shown = texelFetch(pictureColor, min(ivec2(place), ivec2(pictureSize) - 1), 0);
  }
  if (shown.a <= 0.0) discard;
  gl_FragData[0] = shown;
"""

_DEPTH = """
  // Mm along the ray of the pixel; negative where nothing is hit, which lies behind everything.
  // Three pixels of a row lie in one texel: VTK keeps float32 in textures of three colours only.
  ivec2 depthSize = textureSize(pictureColor, 0);
  vec2 across = vec2(tcoordVCVSOutput.x, 1.0 - tcoordVCVSOutput.y);
  ivec2 depthPlace = min(ivec2(across * vec2(depthSize)), depthSize - 1);
  float way = texelFetch(pictureDepth, ivec2(depthPlace.x / 3, depthPlace.y), 0)[depthPlace.x % 3];
  float pictureZ;
  if (pictureSlope > 0.0) {
    vec2 off = (across - 0.5) * 2.0 * pictureSlope * vec2(pictureAspect, 1.0);
    way = way / sqrt(1.0 + dot(off, off));
    pictureZ = way > 0.0 ? pictureFar * (way - pictureNear) / (way * (pictureFar - pictureNear)) : 1.0;
  } else {
    pictureZ = way > 0.0 ? (way - pictureNear) / (pictureFar - pictureNear) : 1.0;
  }
  gl_FragDepth = pictureZ;
"""


LEAST_COSINE = 0.5
"""Between the ray of a corner and the view; depths along rays are longer than along the view by less than this."""


class PictureActor:
    """An actor that shows a picture over all of a renderer.

    Its renderer takes the picture's camera in `show`; where the camera is another one later, the picture is wrong.
    The actor is drawn after what is opaque.  With translucent actors beside it, switch depth peeling on.

    renderer: Gets the actor; its clipping range is set before each drawing.

    actor: Not pickable, and no part of the bounds of a scene.
    """

    def __init__(self, renderer: Any) -> None:
        from vtkmodules.vtkCommonCore import vtkPoints
        from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
        from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkTexture
        from vtkmodules.vtkRenderingOpenGL2 import vtkOpenGLPolyDataMapper  # noqa: F401  the factory of mappers

        self._points = vtkPoints()
        self._points.SetDataTypeToDouble()
        self._points.SetNumberOfPoints(4)
        cells = vtkCellArray()
        cells.InsertNextCell(4, (0, 1, 2, 3))
        self._rectangle = vtkPolyData()
        self._rectangle.SetPoints(self._points)
        self._rectangle.SetPolys(cells)
        self._rectangle.GetPointData().SetTCoords(_numbers([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
        mapper = vtkPolyDataMapper()
        mapper.SetInputData(self._rectangle)
        self.actor = vtkActor()
        self.actor.SetMapper(mapper)
        self.actor.GetProperty().LightingOff()
        self.actor.ForceTranslucentOn()
        self.actor.PickableOff()
        self.actor.UseBoundsOff()
        self.actor.VisibilityOff()
        self._textures: list[Any] = []
        for name in ("pictureColor", "pictureDepth"):
            texture = vtkTexture()
            texture.SetColorModeToDirectScalars()
            texture.InterpolateOff()
            texture.MipmapOff()
            texture.RepeatOff()
            self.actor.GetProperty().SetTexture(name, texture)
            self._textures.append(texture)
        shader = self.actor.GetShaderProperty()
        shader.AddFragmentShaderReplacement("//VTK::TCoord::Impl", True, _COLOR, False)
        shader.AddFragmentShaderReplacement("//VTK::Depth::Impl", True, _DEPTH, False)
        self._uniforms = shader.GetFragmentCustomUniforms()
        self._camera: Camera | None = None
        self._ways: tuple[float, float] | None = None
        renderer.AddActor(self.actor)
        renderer.AddObserver("StartEvent", self._set_range)
        self._renderer = renderer

    def show(self, rendering: Rendering, *, expected: bool = False, smooth: bool = True) -> None:
        """Show a picture, and give the renderer its camera.

        rendering: With a camera; its aspect is that of the renderer.  Its arrays must not change while it is shown.
        expected: Depths are the expected ones, as volume rendering has them.
        smooth: Between pixels colours are interpolated, where the picture is smaller than the renderer.
        """
        camera = rendering.camera
        assert camera is not None
        depth = rendering.expected_depth if expected else rendering.depth
        right, up, forward = camera.basis()
        half = camera.half_height() * (1.0 if camera.is_parallel else camera.distance)
        width, height = rendering.size
        middle = np.asarray(camera.focal_point)
        for n, (x, y) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
            self._points.SetPoint(n, *(middle + half * (x * width / height * right + y * up)))
        self._points.Modified()
        self._rectangle.Modified()
        place_camera(self._renderer.GetActiveCamera(), camera)
        hit = depth[np.isfinite(depth)]
        self._ways = (float(hit.min()), float(hit.max())) if hit.size else None
        self._camera = camera
        set_number = self._uniforms.SetUniformf
        set_number("pictureSlope", 0.0 if camera.is_parallel else camera.half_height())
        set_number("pictureAspect", width / height)
        self._uniforms.SetUniformi("pictureSmooth", int(smooth))
        colors = np.ascontiguousarray(rendering.image)
        ways = np.full((height, -(-width // 3) * 3), -1.0, dtype=np.float32)
        np.copyto(ways[:, :width], depth, where=np.isfinite(depth))
        for texture, values in zip(self._textures, (colors, ways.reshape(height, -1, 3)), strict=True):
            texture.SetInputData(image_data(values))
        self.actor.VisibilityOn()

    def hide(self) -> None:
        """Show nothing."""
        self.actor.VisibilityOff()

    def _set_range(self, *_: object) -> None:
        """Let the clipping range hold all visible actors and the picture's depths, and tell it to the shader.

        It is done before each drawing: whoever draws may have set another range.
        """
        camera = self._camera
        if camera is None:
            return
        ways = [camera.distance, *(self._ways or ())]  # the rectangle itself is clipped too
        bounds = self._renderer.ComputeVisiblePropBounds()
        if bounds[0] <= bounds[1]:
            corners = np.array(list(itertools.product(bounds[:2], bounds[2:4], bounds[4:])))
            ways += ((corners - camera.position) @ camera.basis().forward).tolist()
        near, far = min(ways), max(ways)
        room = 0.01 * (far - near) + 1.0
        near, far = near - room, far + room
        if not camera.is_parallel:
            near = max(near * LEAST_COSINE, 1e-3 * far)
        self._renderer.GetActiveCamera().SetClippingRange(near, far)
        self._uniforms.SetUniformf("pictureNear", near)
        self._uniforms.SetUniformf("pictureFar", far)


def place_camera(target: Any, camera: Any) -> None:
    """Give a vtkCamera the view of a `Camera`."""
    target.SetPosition(*camera.position)
    target.SetFocalPoint(*camera.focal_point)
    target.SetViewUp(*camera.up)
    target.SetUseHorizontalViewAngle(False)
    target.SetParallelProjection(camera.is_parallel)
    if camera.is_parallel:
        target.SetParallelScale(camera.parallel_scale)
    else:
        target.SetViewAngle(camera.view_angle)


def _numbers(values: Any) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk

    return numpy_to_vtk(np.array(values, dtype=np.float32), deep=True)


def image_data(values: Any) -> Any:
    """Return an array (h, w) or (h, w, n) as image data that shares its memory."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    height, width = values.shape[:2]
    image = vtkImageData()
    image.SetDimensions(width, height, 1)
    image.GetPointData().SetScalars(numpy_to_vtk(values.reshape(height * width, -1)))
    return image
