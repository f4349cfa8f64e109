"""Pictures of triangles: against their twin, against known shapes, and what cannot be shown."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tolerances
from sample_meshes import ball

import clrecon
from clrecon import Mesh, MeshLook
from clrecon.errors import DeviceError, UsageError
from clrecon.opencl import Stopwatch
from clrecon.operators.rays import mesh_pictures, scene
from clrecon.operators.rays.mesh_pictures import make_part
from clrecon.operators.rays.picture_buffers import DrawnVolume, Shot
from clrecon.operators.rays.scene import LAYERS, PIXEL_BYTES, Still, draw_layers
from clrecon.proof.rays.objects import ColoredMesh, find_meetings, nth_layer, shade_layer
from clrecon.rendering import UNSHADED, Lighting
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

SIZE = (61, 47)
FRONT = Camera((0.0, -50.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=11.75)
"""Half a mm a pixel, y into the picture."""

CAMERAS = {
    "parallel": Camera((30.0, -60.0, 25.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=9.0),
    "perspective": Camera((9.0, -16.0, 6.0), (0.0, 1.0, 0.0), (0.1, 0.0, 1.0), view_angle=50.0),
    "inside": Camera((1.0, -3.0, 0.5), (0.0, 5.0, 0.0), (0.1, 0.0, 1.0), view_angle=70.0),
    "inside, parallel": Camera((1.0, -3.0, 0.5), (0.0, 5.0, 0.0), (0.1, 0.0, 1.0), parallel_scale=9.0),
}
FIXED = Lighting(0.1, 0.7, 0.5, 20.5, direction=(0.4, -1.0, 0.8))


def alone(device: Any) -> DrawnVolume:
    return DrawnVolume(device, None, 0.0, Stopwatch(), [])


def soup(count: int = 150, seed: int = 2) -> Mesh:
    """Return triangles of all sizes anywhere, some without area, some twice."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-8.0, 8.0, (count, 1, 3))
    corners = middle + rng.normal(size=(count, 3, 3)) * np.exp(rng.uniform(-3.0, 2.0, (count, 1, 1)))
    corners[5, 2] = corners[5, 0]
    corners[6, 2] = 0.5 * (corners[6, 0] + corners[6, 1])
    corners[7] = corners[8]
    normals = rng.normal(size=(3 * count, 3))
    return Mesh(
        corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), normals / np.linalg.norm(normals, axis=1)[:, None]
    )


def quad(low: float, high: float, y: float) -> Mesh:
    """Return a square across the view of FRONT at depth y + 50, of two triangles."""
    corners = [(low, y, low), (high, y, low), (high, y, high), (low, y, high)]
    return Mesh(corners, [(0, 1, 2), (0, 2, 3)])


@pytest.mark.every_device
@pytest.mark.parametrize(
    ("name", "lighting"),
    [
        pytest.param("inside", Lighting(), marks=pytest.mark.oclgrind),
        pytest.param("parallel", Lighting(), marks=pytest.mark.oclgrind),
        ("perspective", Lighting()),
        ("inside, parallel", Lighting()),
        *product(CAMERAS, (FIXED, UNSHADED)),
    ],
)
def test_every_layer_is_that_of_the_twin(device: Any, name: str, lighting: Lighting) -> None:
    mesh, camera = soup(), CAMERAS[name]
    rng = np.random.default_rng(4)
    colors = rng.integers(0, 256, (mesh.vertex_count, 3)).astype(np.uint8)
    meetings = find_meetings(mesh.vertices, mesh.triangles, camera, SIZE)
    for normals in (mesh.normals, None):
        look = MeshLook(vertex_colors=colors, lighting=lighting, flat=normals is None)
        found = draw_layers(alone(device), [make_part(mesh, look)], Shot(camera, SIZE))
        shown = ColoredMesh(mesh.vertices, mesh.triangles, colors / 255.0, normals)
        rgb, depth = shade_layer(meetings, nth_layer(meetings, 0, SIZE), shown, camera, lighting)
        seen = ~np.isnan(depth)
        assert seen.any() and (not seen.all() or "inside" in name)
        assert np.array_equal(np.isnan(found.depth), ~seen)
        assert np.allclose(found.depth, depth, rtol=0.0, atol=tolerances.SPLAT_DEPTH_MM, equal_nan=True)
        assert np.array_equal(found.image[..., 3] == 255, seen)
        assert np.abs(found.image[seen, :3] - 255.0 * rgb[seen]).max() <= tolerances.SPLAT_COLOR_LEVELS
        assert found.layers == 1 and found.open_pixels == 0


@pytest.mark.every_device
@pytest.mark.parametrize("name", CAMERAS)
def test_translucent_layers_are_blended_in_the_order_of_the_twin(device: Any, name: str) -> None:
    mesh, camera, opacity = soup(60), CAMERAS[name], 0.3
    colors = np.zeros((mesh.vertex_count, 3), np.uint8)
    colors[:, 0] = np.repeat(np.arange(mesh.triangle_count) * 4, 3)
    meetings = find_meetings(mesh.vertices, mesh.triangles, camera, SIZE)
    most = int(np.bincount(meetings.pixels).max())
    assert 3 <= most <= LAYERS
    look = MeshLook(vertex_colors=colors, lighting=UNSHADED, opacity=opacity)
    found = draw_layers(alone(device), [make_part(mesh, look)], Shot(camera, SIZE))
    premultiplied, seen, way = np.zeros(SIZE[::-1]), np.zeros(SIZE[::-1]), np.zeros(SIZE[::-1])
    for layer in range(most):
        shown = ColoredMesh(mesh.vertices, mesh.triangles, colors / 255.0, None)
        rgb, depth = shade_layer(meetings, nth_layer(meetings, layer, SIZE), shown, camera, UNSHADED)
        weight = np.where(np.isnan(depth), 0.0, (1.0 - seen) * opacity)
        premultiplied += weight * rgb[..., 0]
        way += weight * np.nan_to_num(depth)
        seen += weight
        if layer == 0:
            assert np.allclose(found.depth, depth, rtol=0.0, atol=tolerances.SPLAT_DEPTH_MM, equal_nan=True)
    there = seen > 0
    assert np.abs(found.image[..., 3] - 255.0 * seen).max() <= 0.51
    assert np.abs(found.image[there, 0] - 255.0 * premultiplied[there] / seen[there]).max() <= 0.52
    assert np.allclose(found.expected_depth[there], way[there] / seen[there], rtol=0.0, atol=1e-4)
    assert np.isnan(found.expected_depth[~there]).all()
    assert (found.layers, found.open_pixels) == (most + 1, 0)


@pytest.mark.parametrize("flat", [False, True])
def test_a_ball_has_the_depth_and_light_of_a_ball(device: Any, flat: bool) -> None:
    mesh = Mesh(*ball(8.0))
    picture = clrecon.render(mesh, MeshLook("white", flat=flat), camera=FRONT, size=(95, 47), device=device)
    x, y = np.meshgrid(0.5 * (np.arange(95) - 47.0), 0.5 * (23.0 - np.arange(47)))
    square = 64.0 - x * x - y * y
    inside, outside = square > 64.0 * 0.05, square < -0.5
    assert np.isnan(picture.depth[outside]).all()
    depth = 50.0 - np.sqrt(np.maximum(square, 0.0))
    assert np.abs(picture.depth - depth)[inside].max() < tolerances.BALL_MESH_DEPTH_MM
    light = Lighting()
    cosine = np.sqrt(np.maximum(square, 0.0)) / 8.0
    shine = light.ambient + light.diffuse * cosine + light.specular * cosine**light.specular_power
    away = np.abs(picture.image[..., 0] - 255.0 * np.minimum(shine, 1.0))[inside]
    assert away.max() < (24.0 if flat else 3.0)
    assert picture.expected_depth == pytest.approx(picture.depth, nan_ok=True)
    assert picture.mode == "mesh" and picture.report["triangles"] == mesh.triangle_count


@pytest.mark.every_device
@pytest.mark.parametrize("size", [(48, 48), (47, 47)])
def test_shared_edges_are_drawn_once_without_cracks(device: Any, size: tuple[int, int]) -> None:
    """Translucent squares whose edges and diagonals run through centres of pixels are of one opacity everywhere."""
    camera = Camera((0.0, -50.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=size[1] / 2)
    places = np.arange(-30.0, 31.0, 0.5)
    x, z = np.meshgrid(places, places)
    vertices = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    n = len(places)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    pairs = [(corner, corner + 1, corner + n + 1), (corner, corner + n + 1, corner + n)]
    mesh = Mesh(vertices, np.concatenate([np.stack(pair, axis=1) for pair in pairs]))
    fan = Mesh(np.concatenate([[(0.0, 0.0, 0.0)], vertices[np.abs(vertices).max(axis=1) == 30.0]]), _fan(vertices))
    for shown in (mesh, fan):
        picture = clrecon.render(
            shown, MeshLook("white", opacity=0.5, lighting=UNSHADED), camera=camera, size=size, device=device,
            background="transparent",
        )  # fmt: skip
        assert (picture.image == (255, 255, 255, 128)).all()
        assert (picture.depth == 50.0).all() and picture.report["layers"] == 2


def _fan(vertices: np.ndarray) -> list[tuple[int, int, int]]:
    rim = vertices[np.abs(vertices).max(axis=1) == 30.0]
    order = np.argsort(np.arctan2(rim[:, 2], rim[:, 0])) + 1
    return [(0, int(a), int(b)) for a, b in zip(order, np.roll(order, -1), strict=True)]


def test_large_and_small_triangles_are_drawn_as_the_twin_in_any_order(device: Any) -> None:
    """A screen behind specks: all boxes, and both orders of the meshes, show the same."""
    camera, size = CAMERAS["perspective"], (333, 150)
    screen = Mesh([(-900.0, 30.0, -900.0), (900.0, 40.0, -900.0), (0.0, 35.0, 900.0)], [(0, 1, 2)])
    specks = soup(400, seed=7)
    both = Mesh(
        np.concatenate([screen.vertices, specks.vertices]), np.concatenate([screen.triangles, specks.triangles + 3])
    )
    look = MeshLook(flat=True, lighting=FIXED)
    found = draw_layers(alone(device), [make_part(both, look)], Shot(camera, size))
    apart = draw_layers(alone(device), [make_part(specks, look), make_part(screen, look)], Shot(camera, size))
    again = draw_layers(alone(device), [make_part(both, look)], Shot(camera, size))
    assert found.image.tobytes() == again.image.tobytes() == apart.image.tobytes()
    assert found.depth.tobytes() == again.depth.tobytes() == apart.depth.tobytes()
    meetings = find_meetings(both.vertices, both.triangles, camera, size)
    places = nth_layer(meetings, 0, size)
    assert (places >= 0).all()
    along = camera.rays(size)[1] @ camera.basis().forward
    assert np.allclose(found.depth, meetings.depths[places] / along, rtol=tolerances.RAY_LENGTH_SHARE, atol=0.0)
    colors = np.zeros((both.vertex_count, 3), np.uint8)
    colors[:, :2] = np.repeat(np.arange(both.triangle_count, dtype="<u2"), 3).view(np.uint8).reshape(-1, 2)
    numbered = draw_layers(
        alone(device), [make_part(both, MeshLook(vertex_colors=colors, lighting=UNSHADED))], Shot(camera, size)
    )
    assert np.array_equal(numbered.image[..., 0] + 256 * numbered.image[..., 1].astype(int), meetings.triangles[places])


def test_of_triangles_in_one_place_the_first_is_seen(device: Any) -> None:
    first, second = quad(-20.0, 20.0, 3.0), quad(-20.0, 20.0, 3.0)
    parts = [make_part(mesh, MeshLook(color, lighting=UNSHADED)) for mesh, color in ((first, "red"), (second, "blue"))]
    assert (draw_layers(alone(device), parts, Shot(FRONT, (17, 17))).image == (255, 0, 0, 255)).all()
    assert (draw_layers(alone(device), parts[::-1], Shot(FRONT, (17, 17))).image == (0, 0, 255, 255)).all()


def test_triangles_beside_or_behind_the_camera_are_not_drawn_and_small_ones_are(device: Any) -> None:
    look = MeshLook("white", lighting=UNSHADED)
    aside = quad(100.0, 120.0, 0.0)
    assert np.isnan(clrecon.render(aside, look, camera=FRONT, size=SIZE, device=device).depth).all()
    close = Camera((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), view_angle=90.0)
    behind = clrecon.render(quad(-9.0, 9.0, -5.0), look, camera=close, size=SIZE, device=device)
    assert np.isnan(behind.depth).all()
    around = Mesh([(-50.0, -10.0, -1.0), (50.0, -10.0, -1.0), (0.0, 200.0, -1.0)], [(0, 1, 2)])
    floor = clrecon.render(around, look, camera=close, size=(61, 60), device=device)
    _, directions = close.rays((61, 60))
    down = -1.0 / directions[..., 2]
    hit = (down > 0.0) & (directions[..., 1] * down < 100.0)
    assert np.allclose(floor.depth[hit & (np.abs(directions[..., 0] * down) < 20.0)],
                       down[hit & (np.abs(directions[..., 0] * down) < 20.0)], rtol=1e-5)  # fmt: skip
    assert np.isnan(floor.depth[:30]).all()
    one = clrecon.render(quad(-9.0, 9.0, 3.0), look, camera=FRONT, size=(1, 1), device=device)
    assert one.image.tolist() == [[[255, 255, 255, 255]]] and one.depth[0, 0] == 53.0


def test_a_clipped_square_is_seen_where_it_is_kept(device: Any) -> None:
    clip = Clip.plane((2.25, 3.0, 0.0), (0.6, 0.8, 0.0)) & Clip.plane((0.0, 3.0, -1.25), (0.0, 0.6, 0.8))
    look = MeshLook(clip=clip)
    picture = clrecon.render(quad(-9.1, 9.1, 3.0), look, camera=FRONT, size=SIZE, device=device)
    seen = np.argwhere(~np.isnan(picture.depth))  # centres of pixels at half mm from the middle, 23 and 30
    assert [seen.min(axis=0).tolist(), seen.max(axis=0).tolist()] == [[5, 35], [25, 48]] and len(seen) == 21 * 14


@pytest.mark.release
@pytest.mark.seconds
def test_clipped_meshes_are_open(device: Any) -> None:
    mesh = Mesh(*ball(8.0, 30))
    for name in ("parallel", "perspective"):
        camera = CAMERAS[name]
        clip = Clip.plane((0.0, 0.0, 1.0), (0.2, 0.3, -1.0)) & Clip.plane((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
        picture = clrecon.render(mesh, MeshLook(clip=clip), camera=camera, size=SIZE, device=device)
        origins, directions = camera.rays(SIZE)
        seen = ~np.isnan(picture.depth)
        places = (origins + np.nan_to_num(picture.depth)[..., None] * directions)[seen]
        assert seen.any() and (places @ clip.planes[:, :3].T >= clip.planes[:, 3] - 1e-3).all()
        meetings = find_meetings(mesh.vertices, mesh.triangles, camera, SIZE)
        pixels = np.unravel_index(meetings.pixels, SIZE[::-1])
        along = meetings.depths / (directions @ camera.basis().forward)[pixels]
        points = origins[pixels] + along[:, None] * directions[pixels]
        kept = (points @ clip.planes[:, :3].T >= clip.planes[:, 3] + 1e-3).all(axis=1)
        expected = np.zeros(SIZE[::-1], bool)
        expected[tuple(axis[kept] for axis in pixels)] = True
        assert seen[expected].all()


def test_bytes_a_pixel_are_those_of_the_buffers(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []

    def counted(function: Any, name: str) -> Any:
        def call(device: Any, what: Any, *more: Any) -> Any:
            sizes = {"allocate": lambda: what, "upload": lambda: what.nbytes}
            size = sizes.get(name, lambda: np.empty(what, *more).nbytes)
            taken.append(size())
            return function(device, what, *more)

        return call

    for module, names in ((scene.ocl, ("allocate", "upload", "empty_output")), (mesh_pictures, ("allocate",))):
        for name in names:
            monkeypatch.setattr(module, name, counted(getattr(module, name), name))

    def bytes_of(width: int, height: int) -> int:
        taken.clear()
        still = Still(np.zeros((height, width, 4), np.uint8), np.zeros((height, width), np.float32))
        draw_layers(
            alone(device), [make_part(quad(-9.0, 9.0, 3.0), MeshLook())], Shot(FRONT, (width, height)), still=still
        )
        return sum(taken)

    assert bytes_of(61, 47) - bytes_of(11, 47) == PIXEL_BYTES * 50 * 47


def test_a_mesh_far_away_looks_the_same(device: Any) -> None:
    mesh = Mesh(*ball(8.0))
    near = clrecon.render(mesh, size=SIZE, view=(20, 30), device=device)
    away = Mesh(mesh.vertices.astype(np.float64) + 1e5, mesh.triangles)
    assert away.vertices.dtype == np.float64
    far = clrecon.render(away, size=SIZE, view=(20, 30), device=device)
    assert (np.abs(far.image.astype(int) - near.image).max(axis=-1) > 2).mean() < tolerances.FAR_SPLAT_SHARE


def test_layers_beyond_the_most_are_left_out_and_said(device: Any) -> None:
    sheets = [quad(-30.0, 30.0, float(n)) for n in range(LAYERS + 3)]
    mesh = Mesh(
        np.concatenate([sheet.vertices for sheet in sheets]),
        np.concatenate([sheet.triangles + 4 * n for n, sheet in enumerate(sheets)]),
    )
    picture = clrecon.render(mesh, MeshLook("white", opacity=0.1), camera=FRONT, size=(20, 10), device=device)
    assert picture.report["layers"] == LAYERS
    assert any(f"200 pixels have more than {LAYERS}" in text for text in picture.report["warnings"])


def test_what_cannot_be_shown_is_refused(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = quad(-9.0, 9.0, 3.0)
    broken = Mesh([(0, 0, 0), (1, 0, 0), (2, 1, 0)], [(0, 1, 2)])
    broken.vertices[2, 0] = np.nan  # what is given is checked; arrays can be changed afterwards
    lost = Mesh(np.eye(3), [(0, 1, 2)])
    lost.triangles[0, 2] = 7
    away = Mesh([(0, 0, 0), (1, 0, 0), (3e9, 1, 0)], [(0, 1, 2)])
    for bad, text in (
        (Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), "no triangles"),
        (broken, "vertex 2 is not finite"),
        (lost, "refers to vertex 7"),
        (away, "3,000,000,000 mm"),
    ):
        with pytest.raises(UsageError, match=text):
            clrecon.render(bad, camera=FRONT, device=device)
    with pytest.raises(UsageError, match="at most 4,294,967,294 triangles, the mesh has 4,294,967,295$"):
        make_part(SimpleNamespace(triangle_count=2**32 - 1), MeshLook())
    with pytest.raises(UsageError, match="mode mesh"):
        clrecon.render(mesh, "dvr", device=device)
    with pytest.raises(UsageError, match="extract a surface"):
        clrecon.render(clrecon.Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), MeshLook(), device=device)
    with pytest.raises(UsageError, match="3 colours for 4 vertices"):
        clrecon.render(mesh, MeshLook(vertex_colors=np.zeros((3, 3))), device=device)
    for colors in (np.zeros(3), np.full((4, 3), 2.0), np.zeros((4, 3), np.int64), np.full((4, 3), np.nan)):
        with pytest.raises(UsageError, match="colours of vertices"):
            MeshLook(vertex_colors=colors)
    with pytest.raises(UsageError, match="one colour"):
        MeshLook("red", vertex_colors=np.zeros((4, 3)))
    with pytest.raises(UsageError, match="opacity of a mesh"):
        MeshLook(opacity=0.0)
    with pytest.raises(DeviceError, match="triangles"):
        clrecon.render(mesh, size=SIZE, memory=1000, device=device)
    monkeypatch.setattr("clrecon.operators.rays.mesh_pictures.MOST_PIECES", 5)
    with pytest.raises(UsageError, match="take a smaller picture"):
        clrecon.render(mesh, camera=FRONT, size=(200, 200), device=device)
