"""Pictures of triangles: against their twin, against known shapes, and what cannot be shown."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused
from sample_meshes import ball

import clrecon
from clrecon import Mesh, MeshLook
from clrecon.errors import DeviceError, UsageError
from clrecon.opencl import Stopwatch
from clrecon.operators.rays import mesh_pictures, picture_buffers, scene
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
FIXED = Lighting(ambient=0.1, diffuse=0.7, specular=0.5, specular_power=20.5, direction=(0.4, -1.0, 0.8))


def no_volume(device: Any) -> DrawnVolume:
    """What is drawn beside the triangles."""
    return DrawnVolume(device, sample=None, near_mm=0.0, stopwatch=Stopwatch(), warnings=[])


def soup(count: int, *, seed: int = 2) -> Mesh:
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


def quad(low: float, high: float, *, y: float) -> Mesh:
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
@pytest.mark.parametrize("flat", [False, True])
def test_colour_and_depth_of_opaque_triangles_are_those_of_the_twin(
    device: Any, name: str, lighting: Lighting, flat: bool
) -> None:
    mesh, camera = soup(150), CAMERAS[name]
    colors = np.random.default_rng(4).integers(0, 256, (mesh.vertex_count, 3)).astype(np.uint8)
    look = MeshLook(vertex_colors=colors, lighting=lighting, flat=flat)

    found = draw_layers(no_volume(device), [make_part(mesh, look)], Shot(camera, SIZE))

    meetings = find_meetings(mesh.vertices, mesh.triangles, camera, SIZE)
    shown = ColoredMesh(mesh.vertices, mesh.triangles, colors / 255.0, None if flat else mesh.normals)
    rgb, depth = shade_layer(meetings, nth_layer(meetings, 0, SIZE), shown, camera, lighting)
    seen = ~np.isnan(depth)
    assert seen.any() and (not seen.all() or "inside" in name)
    assert np.allclose(found.depth, depth, rtol=0.0, atol=tolerances.SPLAT_DEPTH_MM, equal_nan=True)
    assert np.array_equal(found.image[..., 3] == 255, seen)
    in_8_bits = 255.0 * rgb[seen]
    assert np.abs(found.image[seen, :3] - in_8_bits).max() <= tolerances.SPLAT_COLOR_LEVELS
    assert (found.layers, found.open_pixels) == (1, 0)


class TranslucentTriangles:
    """Triangles with an opacity of 0.3, and red, opacity and mean depth of all their layers by the twin."""

    def __init__(self, device: Any, camera: Camera) -> None:
        mesh, opacity = soup(60), 0.3
        colors = np.zeros((mesh.vertex_count, 3), np.uint8)
        colors[:, 0] = np.repeat(np.arange(mesh.triangle_count) * 4, 3)
        look = MeshLook(vertex_colors=colors, lighting=UNSHADED, opacity=opacity)
        self.found = draw_layers(no_volume(device), [make_part(mesh, look)], Shot(camera, SIZE))

        meetings = find_meetings(mesh.vertices, mesh.triangles, camera, SIZE)
        self.most = int(np.bincount(meetings.pixels).max())
        shown = ColoredMesh(mesh.vertices, mesh.triangles, colors / 255.0, None)
        layers = [
            shade_layer(meetings, nth_layer(meetings, layer, SIZE), shown, camera, UNSHADED)
            for layer in range(self.most)
        ]
        (_, self.first_depth), *_ = layers
        red, self.opacity, way = np.zeros(SIZE[::-1]), np.zeros(SIZE[::-1]), np.zeros(SIZE[::-1])
        for rgb, depth in layers:
            weight = np.where(np.isnan(depth), 0.0, (1.0 - self.opacity) * opacity)
            red += weight * rgb[..., 0]
            way += weight * np.nan_to_num(depth)
            self.opacity += weight
        self.seen = self.opacity > 0
        self.red, self.mean_depth = red[self.seen] / self.opacity[self.seen], way[self.seen] / self.opacity[self.seen]


@pytest.fixture(params=CAMERAS)
def translucent(request: pytest.FixtureRequest, device: Any) -> TranslucentTriangles:
    """Translucent triangles seen by each of the cameras."""
    return TranslucentTriangles(device, CAMERAS[request.param])


@pytest.mark.every_device
def test_translucent_layers_are_blended_in_the_order_of_the_twin(translucent: TranslucentTriangles) -> None:
    found, seen = translucent.found, translucent.seen
    assert np.abs(found.image[..., 3] - 255.0 * translucent.opacity).max() <= 0.51  # rounding, in float32
    assert np.abs(found.image[seen, 0] - 255.0 * translucent.red).max() <= 0.52  # and a division


@pytest.mark.every_device
def test_depths_of_translucent_layers_are_the_first_and_the_mean_of_the_twin(translucent: TranslucentTriangles) -> None:
    found, seen, limit = translucent.found, translucent.seen, tolerances.SPLAT_DEPTH_MM
    assert np.allclose(found.depth, translucent.first_depth, rtol=0.0, atol=limit, equal_nan=True)
    assert np.allclose(found.expected_depth[seen], translucent.mean_depth, rtol=0.0, atol=limit)
    assert np.isnan(found.expected_depth[~seen]).all()


@pytest.mark.every_device
def test_translucent_triangles_take_a_pass_more_than_the_most_layers_of_a_pixel(
    translucent: TranslucentTriangles,
) -> None:
    assert 3 <= translucent.most <= LAYERS  # with layers between the first and the last, and all of them in one run
    assert (translucent.found.layers, translucent.found.open_pixels) == (translucent.most + 1, 0)


BALL_RADIUS = 8.0


@pytest.fixture(params=[False, True], ids=["smooth", "flat"])
def white_ball(request: pytest.FixtureRequest, device: Any) -> Any:
    """A picture of a ball of triangles, whether they are flat, and the squared height of its sphere at each pixel."""
    mesh = Mesh(*ball(BALL_RADIUS, rings=90))
    picture = clrecon.render(mesh, MeshLook("white", flat=request.param), camera=FRONT, size=(95, 47), device=device)
    x, z = np.meshgrid(0.5 * (np.arange(95) - 47.0), 0.5 * (23.0 - np.arange(47)))
    return picture, request.param, BALL_RADIUS**2 - x * x - z * z


def test_outline_and_depth_of_a_ball_of_triangles_are_those_of_its_sphere(white_ball: Any) -> None:
    picture, _, square = white_ball
    assert np.isnan(picture.depth[square < -0.5]).all()  # mm2: 0.03 mm outside of the sphere of 8 mm
    off_edge = square > 0.05 * BALL_RADIUS**2
    depth = 50.0 - np.sqrt(np.maximum(square, 0.0))
    assert np.abs(picture.depth - depth)[off_edge].max() < tolerances.BALL_MESH_DEPTH_MM
    assert picture.expected_depth == pytest.approx(picture.depth, nan_ok=True)


def test_light_of_a_ball_of_triangles_is_that_of_its_sphere(white_ball: Any) -> None:
    picture, is_flat, square = white_ball
    off_edge = square > 0.05 * BALL_RADIUS**2
    cosine = np.sqrt(np.maximum(square, 0.0)) / BALL_RADIUS
    light = Lighting()
    shine = light.ambient + light.diffuse * cosine + light.specular * cosine**light.specular_power
    away = np.abs(picture.image[..., 0] - 255.0 * np.minimum(shine, 1.0))[off_edge]
    assert away.max() < (24.0 if is_flat else 3.0)  # of 255: a triangle of 90 rings turns by 2 degrees


def test_report_of_a_mesh_counts_its_triangles(white_ball: Any) -> None:
    picture, _, _ = white_ball
    assert picture.mode == "mesh"
    assert picture.report["triangles"] == Mesh(*ball(BALL_RADIUS, rings=90)).triangle_count


REACH = 30.0
"""Mm from the middle of a flat sheet to its sides: beyond the pictures of it."""


def grid_points() -> np.ndarray:
    """Return points of the sheet at each half mm, row by row."""
    places = np.arange(-REACH, REACH + 1.0, 0.5)
    x, z = np.meshgrid(places, places)
    return np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)


def grid_of_squares() -> Mesh:
    """Return a sheet of squares of half a mm, two triangles each."""
    vertices = grid_points()
    n = int(np.sqrt(len(vertices)))
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    pairs = [(corner, corner + 1, corner + n + 1), (corner, corner + n + 1, corner + n)]
    return Mesh(vertices, np.concatenate([np.stack(pair, axis=1) for pair in pairs]))


def fan_about_the_middle() -> Mesh:
    """Return a sheet of slender triangles that meet in the middle."""
    vertices = grid_points()
    rim = vertices[np.abs(vertices).max(axis=1) == REACH]
    order = np.argsort(np.arctan2(rim[:, 2], rim[:, 0])) + 1
    triangles = [(0, int(a), int(b)) for a, b in zip(order, np.roll(order, -1), strict=True)]
    return Mesh(np.concatenate([[(0.0, 0.0, 0.0)], rim]), triangles)


@pytest.mark.every_device
@pytest.mark.parametrize("make", [grid_of_squares, fan_about_the_middle])
@pytest.mark.parametrize("size", [(48, 48), (47, 47)])
def test_shared_edges_are_drawn_once_without_cracks(device: Any, size: tuple[int, int], make: Any) -> None:
    """Translucent triangles whose edges run through centres of pixels are of one opacity everywhere."""
    camera = Camera((0.0, -50.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=size[1] / 2)
    look = MeshLook("white", opacity=0.5, lighting=UNSHADED)
    picture = clrecon.render(make(), look, camera=camera, size=size, device=device, background="transparent")
    assert (picture.image == (255, 255, 255, 128)).all()
    assert (picture.depth == 50.0).all()
    assert picture.report["layers"] == 2  # the triangles, and the pass that finds no more


LARGE_SHOT = Shot(CAMERAS["perspective"], (333, 150))


def screen_and_specks() -> tuple[Mesh, Mesh, Mesh]:
    """Return a triangle larger than the picture, 400 small ones before it, and both as one mesh."""
    screen = Mesh([(-900.0, 30.0, -900.0), (900.0, 40.0, -900.0), (0.0, 35.0, 900.0)], [(0, 1, 2)])
    specks = soup(400, seed=7)
    both = Mesh(
        np.concatenate([screen.vertices, specks.vertices]), np.concatenate([screen.triangles, specks.triangles + 3])
    )
    return screen, specks, both


def test_large_and_small_triangles_give_one_picture_each_time_and_as_two_meshes_in_another_order(device: Any) -> None:
    screen, specks, both = screen_and_specks()
    look = MeshLook(flat=True, lighting=FIXED)
    found, again, apart = (
        draw_layers(no_volume(device), [make_part(mesh, look) for mesh in meshes], LARGE_SHOT)
        for meshes in ([both], [both], [specks, screen])
    )
    assert found.image.tobytes() == again.image.tobytes() == apart.image.tobytes()
    assert found.depth.tobytes() == again.depth.tobytes() == apart.depth.tobytes()


def test_first_of_large_and_small_triangles_and_its_depth_are_those_of_the_twin(device: Any) -> None:
    _, _, both = screen_and_specks()
    camera, size = LARGE_SHOT.camera, LARGE_SHOT.size
    meetings = find_meetings(both.vertices, both.triangles, camera, size)
    places = nth_layer(meetings, 0, size)
    assert (places >= 0).all()  # the screen is behind every pixel
    colors = np.zeros((both.vertex_count, 3), np.uint8)  # red and green tell the number of the triangle
    colors[:, :2] = np.repeat(np.arange(both.triangle_count, dtype="<u2"), 3).view(np.uint8).reshape(-1, 2)
    look = MeshLook(vertex_colors=colors, lighting=UNSHADED)
    found = draw_layers(no_volume(device), [make_part(both, look)], LARGE_SHOT)
    assert np.array_equal(found.image[..., 0] + 256 * found.image[..., 1].astype(int), meetings.triangles[places])
    _, directions = camera.rays(size)
    along = directions @ camera.basis().forward
    assert np.allclose(found.depth, meetings.depths[places] / along, rtol=tolerances.RAY_LENGTH_SHARE, atol=0.0)


@pytest.mark.parametrize(("colors", "seen"), [(["red", "blue"], (255, 0, 0)), (["blue", "red"], (0, 0, 255))])
def test_of_meshes_in_one_place_the_first_is_seen(device: Any, colors: list[str], seen: tuple[int, int, int]) -> None:
    parts = [make_part(quad(-20.0, 20.0, y=3.0), MeshLook(color, lighting=UNSHADED)) for color in colors]
    assert (draw_layers(no_volume(device), parts, Shot(FRONT, (17, 17))).image == (*seen, 255)).all()


WHITE = MeshLook("white", lighting=UNSHADED)
CLOSE = Camera((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), view_angle=90.0)
"""From the origin along y."""


@pytest.mark.parametrize(
    ("mesh", "camera"),
    [
        pytest.param(quad(100.0, 120.0, y=0.0), FRONT, id="beside"),
        pytest.param(quad(-9.0, 9.0, y=-5.0), CLOSE, id="behind"),
    ],
)
def test_triangles_beside_or_behind_the_camera_are_not_seen(device: Any, mesh: Mesh, camera: Camera) -> None:
    assert np.isnan(clrecon.render(mesh, WHITE, camera=camera, size=SIZE, device=device).depth).all()


def test_a_floor_that_reaches_behind_the_camera_is_seen_before_it_alone(device: Any) -> None:
    floor = Mesh([(-50.0, -10.0, -1.0), (50.0, -10.0, -1.0), (0.0, 200.0, -1.0)], [(0, 1, 2)])
    picture = clrecon.render(floor, WHITE, camera=CLOSE, size=(61, 60), device=device)
    _, directions = CLOSE.rays((61, 60))
    way = -1.0 / directions[..., 2]  # to the plane 1 mm below the camera
    # surely within the triangle, whose half width at y = 100 is 50 * (200 - 100) / 210 = 23.8 mm
    hit = (way > 0.0) & (directions[..., 1] * way < 100.0) & (np.abs(directions[..., 0] * way) < 20.0)
    assert np.allclose(picture.depth[hit], way[hit], rtol=1e-5)  # float32: a division by a slope of 0.01
    assert np.isnan(picture.depth[:30]).all()  # of 60 rows: above the horizon


def test_a_picture_of_one_pixel_shows_the_triangle_there(device: Any) -> None:
    picture = clrecon.render(quad(-9.0, 9.0, y=3.0), WHITE, camera=FRONT, size=(1, 1), device=device)
    assert picture.image.tolist() == [[[255, 255, 255, 255]]]
    assert picture.depth.tolist() == [[50.0 + 3.0]]


def test_a_clipped_square_is_seen_where_it_is_kept(device: Any) -> None:
    """The planes meet the square in x = 2.25 and z = -1.25; its sides are at 9.1."""
    clip = Clip.plane((2.25, 3.0, 0.0), (0.6, 0.8, 0.0)) & Clip.plane((0.0, 3.0, -1.25), (0.0, 0.6, 0.8))
    picture = clrecon.render(quad(-9.1, 9.1, y=3.0), MeshLook(clip=clip), camera=FRONT, size=SIZE, device=device)
    columns, rows = np.arange(SIZE[0]), np.arange(SIZE[1])
    x, z = 0.5 * (columns - 30), 0.5 * (23 - rows)  # centres of pixels, half a mm apart
    kept = ((z > -1.25) & (z < 9.1))[:, None] & ((x > 2.25) & (x < 9.1))
    assert np.array_equal(~np.isnan(picture.depth), kept)


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("name", ["parallel", "perspective"])
def test_clipped_balls_show_what_is_kept_and_nothing_else(device: Any, name: str) -> None:
    mesh, camera = Mesh(*ball(radius=8.0, rings=30)), CAMERAS[name]
    clip = Clip.plane((0.0, 0.0, 1.0), (0.2, 0.3, -1.0)) & Clip.plane((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
    picture = clrecon.render(mesh, MeshLook(clip=clip), camera=camera, size=SIZE, device=device)
    seen = ~np.isnan(picture.depth)
    origins, directions = camera.rays(SIZE)
    places = (origins + np.nan_to_num(picture.depth)[..., None] * directions)[seen]
    in_doubt = 1e-3  # mm: ten times the error of a depth
    assert seen.any() and (places @ clip.planes[:, :3].T >= clip.planes[:, 3] - in_doubt).all()
    meetings = find_meetings(mesh.vertices, mesh.triangles, camera, SIZE)
    pixels = np.unravel_index(meetings.pixels, SIZE[::-1])
    along = meetings.depths / (directions @ camera.basis().forward)[pixels]
    points = origins[pixels] + along[:, None] * directions[pixels]
    kept = (points @ clip.planes[:, :3].T >= clip.planes[:, 3] + in_doubt).all(axis=1)
    assert seen[tuple(axis[kept] for axis in pixels)].all()


def test_bytes_a_pixel_are_those_of_the_buffers(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []

    def counted(function: Any, name: str) -> Any:
        def call(device: Any, what: Any, *more: Any) -> Any:
            sizes = {"allocate": lambda: what, "upload": lambda: what.nbytes}
            size = sizes.get(name, lambda: np.empty(what, *more).nbytes)
            taken.append(size())
            return function(device, what, *more)

        return call

    names_of = {scene.ocl: ("allocate", "upload"), mesh_pictures: ("allocate",), picture_buffers: ("empty_output",)}
    for module, names in names_of.items():
        for name in names:
            monkeypatch.setattr(module, name, counted(getattr(module, name), name))

    def bytes_of(width: int, height: int) -> int:
        taken.clear()
        still = Still(np.zeros((height, width, 4), np.uint8), np.zeros((height, width), np.float32))
        square = make_part(quad(-9.0, 9.0, y=3.0), MeshLook())
        draw_layers(no_volume(device), [square], Shot(FRONT, (width, height)), still=still)
        return sum(taken)

    assert bytes_of(61, 47) - bytes_of(11, 47) == PIXEL_BYTES * 50 * 47


def test_a_mesh_far_from_the_origin_looks_as_the_same_mesh_near_it(device: Any) -> None:
    mesh = Mesh(*ball(radius=8.0))
    near = clrecon.render(mesh, size=SIZE, view=(20, 30), device=device)
    away = Mesh(mesh.vertices.astype(np.float64) + 1e5, mesh.triangles)
    assert away.vertices.dtype == np.float64
    far = clrecon.render(away, size=SIZE, view=(20, 30), device=device)
    is_other = np.abs(far.image.astype(int) - near.image).max(axis=-1) > 2  # of 255: more than a step of float32 does
    assert is_other.mean() < tolerances.FAR_SPLAT_SHARE  # pixels at the rim and along edges of triangles


def test_layers_beyond_the_most_are_left_out_and_the_report_warns_of_their_pixels(device: Any) -> None:
    sheets = [quad(-30.0, 30.0, y=float(n)) for n in range(LAYERS + 3)]
    mesh = Mesh(
        np.concatenate([sheet.vertices for sheet in sheets]),
        np.concatenate([sheet.triangles + 4 * n for n, sheet in enumerate(sheets)]),
    )
    report = clrecon.render(mesh, MeshLook("white", opacity=0.1), camera=FRONT, size=(20, 10), device=device).report
    assert report["layers"] == LAYERS
    assert any(f"200 pixels have more than {LAYERS}" in text for text in report["warnings"])  # all of 20 x 10


def changed(mesh: Mesh, array: str, place: tuple[int, int], value: float) -> Mesh:
    """Return the mesh with one number changed after it was checked."""
    getattr(mesh, array)[place] = value
    return mesh


def triangle(*corners: tuple[float, float, float]) -> Mesh:
    return Mesh(list(corners), [(0, 1, 2)])


@pytest.mark.parametrize(
    ("mesh", "text"),
    [
        (Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), "no triangles"),
        (changed(triangle((0, 0, 0), (1, 0, 0), (2, 1, 0)), "vertices", (2, 0), np.nan), "vertex 2 is not finite"),
        (changed(triangle((1, 0, 0), (0, 1, 0), (0, 0, 1)), "triangles", (0, 2), 7), "refers to vertex 7"),
        (triangle((0, 0, 0), (1, 0, 0), (3e9, 1, 0)), "3,000,000,000 mm"),
    ],
)
def test_meshes_that_cannot_be_drawn_are_refused(device: Any, mesh: Mesh, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        clrecon.render(mesh, camera=FRONT, device=device)


def test_triangles_whose_numbers_need_more_than_32_bits_are_refused() -> None:
    with pytest.raises(UsageError, match=r"at most 4,294,967,294 triangles, the mesh has 4,294,967,295$"):
        make_part(SimpleNamespace(triangle_count=2**32 - 1), MeshLook())


def test_a_mesh_drawn_as_a_volume_is_refused(device: Any) -> None:
    with pytest.raises(UsageError, match="mode mesh"):
        clrecon.render(quad(-9.0, 9.0, y=3.0), "dvr", device=device)


def test_a_volume_drawn_as_a_mesh_is_refused(device: Any) -> None:
    with pytest.raises(UsageError, match="extract a surface"):
        clrecon.render(clrecon.Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), MeshLook(), device=device)


def test_fewer_colours_than_vertices_are_refused(device: Any) -> None:
    with refused(UsageError, 3, 4):
        clrecon.render(quad(-9.0, 9.0, y=3.0), MeshLook(vertex_colors=np.zeros((3, 3))), device=device)


@pytest.mark.parametrize(
    "colors",
    [np.zeros(3), np.full((4, 3), 2.0), np.zeros((4, 3), np.int64), np.full((4, 3), np.nan)],
    ids=["one row", "beyond 1", "64 bits", "nan"],
)
def test_colours_of_vertices_that_are_none_are_refused(colors: np.ndarray) -> None:
    with pytest.raises(UsageError, match="colours of vertices"):
        MeshLook(vertex_colors=colors)


def test_a_colour_of_the_mesh_and_colours_of_its_vertices_are_refused_together() -> None:
    with pytest.raises(UsageError, match="one colour"):
        MeshLook("red", vertex_colors=np.zeros((4, 3)))


def test_a_mesh_without_opacity_is_refused() -> None:
    with refused(UsageError, "opacity"):
        MeshLook(opacity=0.0)


def test_a_mesh_beyond_the_memory_is_refused(device: Any) -> None:
    with refused(DeviceError, "triangles"):
        clrecon.render(quad(-9.0, 9.0, y=3.0), size=SIZE, memory=1000, device=device)


def test_a_picture_with_too_many_pieces_of_triangles_is_refused(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clrecon.operators.rays.mesh_pictures.MOST_PIECES", 5)
    with pytest.raises(UsageError, match="take a smaller picture"):
        clrecon.render(quad(-9.0, 9.0, y=3.0), camera=FRONT, size=(200, 200), device=device)
