"""The small parts of a noisy scan in a view: when they are said to be noise, and that they are hidden together."""

from __future__ import annotations

import numpy as np
import pytest
from open_views import open_sessions
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.viewer.session.session import ViewSession

pytestmark = pytest.mark.opencl
PATIENCE_S = 60.0


@pytest.fixture
def open_session(device):
    """A function that opens the session of objects, by default of a scan of three balls and a mesh."""
    with open_sessions(device) as make:
        yield make


def find_parts(session: ViewSession) -> None:
    session.rest()
    assert session.wait(PATIENCE_S)


def specks(count: int) -> Volume:
    """Lone voxels of 700 HU in air, of which no two touch: each is a part."""
    voxels = np.full((30, 30, 30), -1000, np.int16)
    apart = np.stack(np.meshgrid(*[np.arange(1, 30, 2)] * 3), axis=-1).reshape(-1, 3)
    voxels[tuple(apart[:count].T)] = 700
    return Volume(voxels, np.eye(4))


@pytest.mark.parametrize(("count", "is_said"), [(20 + 1_000, True), (20 + 999, False)], ids=["1000_small", "999_small"])
def test_a_thousand_parts_beside_the_twenty_largest_are_said_to_be_noise(open_session, count, is_said):
    view = open_session(specks(count))

    find_parts(view)

    assert ("1,000 small parts" in (view.facts()["said"] or "")) == is_said


def test_noisy_scan_is_smoothed_by_the_step_that_the_hint_offers_and_shown_as_read_again(open_session):
    view = open_session(specks(20 + 1_000))
    find_parts(view)
    offered = view.facts()["advice"]

    view.do({"do": offered["do"]})
    assert view.wait(PATIENCE_S)
    find_parts(view)
    smoothed = view.facts()
    back = view.do({"do": smoothed["advice"]["do"]})

    assert offered["words"] == "smooth by 1 mm"  # a voxel: there is no soft tissue in which noise could be measured
    assert (smoothed["smooth_mm"], [part["kind"] for part in smoothed["parts"]]) == (1.0, ["scan", "rest"])
    assert (back["smooth_mm"], back["advice"]) == (0.0, offered)


def test_step_against_noise_is_offered_for_no_scan_of_few_parts(open_session):
    view = open_session(specks(50))
    find_parts(view)

    assert view.facts()["advice"] is None


def test_small_parts_are_hidden_together_and_shown_again(open_session):
    view = open_session(specks(50))
    find_parts(view)
    names_shown = [
        [part["name"] for part in facts["parts"] if part["kind"] == "cluster" and part["visible"]]
        for facts in (view.facts(), view.do({"do": "toggle_small_parts"}), view.do({"do": "toggle_small_parts"}))
    ]

    twenty = [f"part {number}" for number in range(1, 21)]
    assert names_shown == [[*twenty, "30 smaller parts"], twenty, [*twenty, "30 smaller parts"]]


def test_small_parts_of_a_scan_of_few_parts_cannot_be_hidden(open_session):
    view = open_session()
    find_parts(view)

    with refused(UsageError, "small"):
        view.do({"do": "toggle_small_parts"})
