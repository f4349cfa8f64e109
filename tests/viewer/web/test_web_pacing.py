"""Which picture is drawn next, what lies behind it, and what is told beside it."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tolerances
from web_views import Views, browsing, serving

from clrecon.viewer.model.state import SCENE
from clrecon.viewer.web.connection import Asked, Connection, Pace, _lay_over

pytestmark = pytest.mark.unit

SIZE = (400, 300)


@pytest.fixture
def pace() -> Pace:
    """Of a browser that shows the scene and an axial slice."""
    made = Pace()
    made.resize({SCENE: SIZE, "axial": (100, 100)})
    return made


def drain(pace: Pace) -> list[Asked]:
    """Take what is to be drawn until nothing is."""
    return list(iter(pace.next, None))


def test_each_view_that_is_shown_is_drawn_once(pace: Pace) -> None:
    assert drain(pace) == [Asked(SCENE, SIZE, moving=False), Asked("axial", (100, 100), moving=False)]
    assert drain(pace) == []


def test_changing_view_is_coarse_first_and_sharp_at_rest(pace: Pace) -> None:
    drain(pace)

    pace.change([SCENE])
    moving = drain(pace)
    pace.rest()
    resting = drain(pace)

    assert moving == [Asked(SCENE, SIZE, moving=True)]
    assert resting == [Asked(SCENE, SIZE, moving=False)]


def test_pace_is_done_once_the_sharp_picture_of_a_change_is_drawn(pace: Pace) -> None:
    drain(pace)
    done = [pace.is_done]

    pace.change([SCENE])
    drain(pace)
    done.append(pace.is_done)
    pace.rest()
    done.append(pace.is_done)
    drain(pace)
    done.append(pace.is_done)

    assert done == [True, False, False, True]


def test_views_take_turns_while_both_change_all_the_time(pace: Pace) -> None:
    drain(pace)
    order = []
    for _ in range(6):
        pace.change([SCENE, "axial"])
        order.append(pace.next().view)
    assert order == [SCENE, "axial"] * 3


def test_views_that_are_not_shown_are_not_drawn(pace: Pace) -> None:
    drain(pace)
    pace.resize({SCENE: SIZE})
    pace.change([SCENE, "axial", "sagittal"])
    assert [asked.view for asked in drain(pace)] == [SCENE]
    pace.rest()
    assert [asked.view for asked in drain(pace)] == [SCENE]


def test_only_a_new_size_is_drawn_again(pace: Pace) -> None:
    drain(pace)
    pace.resize({SCENE: SIZE, "axial": (120, 100)})
    assert drain(pace) == [Asked("axial", (120, 100), moving=False)]


SHARP, COARSE = Asked(SCENE, SIZE, moving=False), Asked(SCENE, SIZE, moving=True)


def test_sharp_picture_gives_way_to_a_moving_one_of_its_view(pace: Pace) -> None:
    drain(pace)
    pace.change(["axial", SCENE])

    assert pace.instead(SHARP) == COARSE
    assert [asked.view for asked in drain(pace)] == ["axial"]


@pytest.mark.parametrize(
    ("changed", "drawn"),
    [
        pytest.param([], SHARP, id="nothing is stale"),
        pytest.param(["axial"], SHARP, id="another view waits"),
        pytest.param([SCENE], COARSE, id="one that moves is finished"),
    ],
)
def test_picture_that_is_drawn_is_finished(pace: Pace, changed: list[str], drawn: Asked) -> None:
    drain(pace)
    pace.change(changed)

    assert pace.instead(drawn) is None


@pytest.mark.parametrize("ground", [(0, 0, 0), (255, 255, 255), (13, 140, 201)], ids=["black", "white", "blue"])
def test_pictures_lie_over_their_ground_rounded_to_whole_numbers(ground: tuple[int, int, int]) -> None:
    image = np.random.default_rng(4).integers(0, 256, (20, 256, 4)).astype(np.uint8)
    image[..., 3] = np.arange(256)  # every opacity
    share = image[..., 3:] / 255.0
    exact = image[..., :3] * share + np.array(ground) * (1.0 - share)
    half_a_step = 0.5 * (1 + tolerances.FLOAT64_SHARE)
    assert np.abs(np.asarray(_lay_over(image, ground)) - exact).max() <= half_a_step


@pytest.mark.parametrize(
    ("mode", "behind"), [pytest.param("surface", 20, id="surface"), pytest.param("bone", 0, id="volume rendering")]
)
def test_ground_is_black_in_volume_rendering_and_that_of_the_page_in_surfaces(mode: str, behind: int) -> None:
    views = Views()
    views.painter.opacity = 0

    async def browse(server: Any) -> Any:
        async with browsing(server) as client:
            await client.tell(do="set_mode", name=mode)
            await client.until(lambda: client.facts.get("mode") == mode)
            await client.tell("layout", sizes={"scene": [120, 90]}, ground=[20, 20, 20])
            await client.until(lambda: client.pictures)
            return client.pictures[0][1]

    with serving(views.open) as server:
        picture = asyncio.run(browse(server))

    assert np.abs(np.asarray(picture, np.int64) - behind).max() <= tolerances.JPEG_GREYS


def test_facts_that_stay_as_they_are_are_sent_once() -> None:
    async def browse(server: Any) -> list[set[str]]:
        async with browsing(server) as client:
            await client.lay_out()
            await client.until(lambda: client.pictures and client.facts["settled"])
            before = len(client.told)
            await client.tell(do="set_window", low=10.0, high=20.0)
            await client.until(lambda: client.facts["window"] == [10.0, 20.0] and client.facts["settled"])
            return client.told[before:]

    with serving(Views().open) as server:
        told = set.union(*asyncio.run(browse(server)))

    assert told >= {"window", "settled"}
    assert not told & {"modes", "parts", "bounds", "camera", "slices"}


def test_connection_that_is_closed_twice_ends_downloads_waiting_pictures_and_session_once() -> None:
    told: list[object] = []

    async def close() -> None:
        connection: Any = SimpleNamespace(
            _closed=False,
            downloads=SimpleNamespace(close=lambda: told.append("downloads")),
            _thread=SimpleNamespace(shutdown=lambda **how: told.append(how)),
            _resting=None,
            _session=SimpleNamespace(close=lambda: told.append("session")),
            _loop=asyncio.get_running_loop(),
        )
        await Connection.close(connection)
        await Connection.close(connection)

    asyncio.run(close())
    assert told == ["downloads", {"wait": False, "cancel_futures": True}, "session"]
