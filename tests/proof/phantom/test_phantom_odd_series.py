"""Phantoms whose series is uneven, gapped or phased are read and told as real ones are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from variants import daily

from clrecon.errors import RefusedInputError, UsageError
from clrecon.proof.phantom import PhantomSettings, apply_point_spread, make_phantom, parse_missing, write_phantom
from clrecon.proof.phantom.series import place_slices
from clrecon.proof.phantom.settings import TEXT_HU, draw_ghosts
from clrecon.proof.phantom.spine import draw_spine
from clrecon.reading import list_series, read_volume

SMALL = {"size": (24, 20), "slices": 20, "spacing": (11.0, 10.0, 2.5)}
CLEAN = {"noise": 0.0, "point_spread_mm": 0.0}


@pytest.mark.parametrize(
    "extra", daily(1, [{}, {"tilt": 12.0, "oblique": (5.0, 0.0, 10.0)}]), ids=["straight", "tilted"]
)
def test_uneven_slices_lie_where_the_truth_says(tmp_path: Path, extra: dict) -> None:
    settings = PhantomSettings(**SMALL, **extra, uneven_mm=0.8)
    truth = write_phantom(tmp_path / "ct", settings)
    volume = read_volume(tmp_path / "ct")
    places = np.array(truth["series"]["slice_positions_lps_mm"])
    assert volume.uneven
    assert volume.ijk_to_lps([(0, 0, k) for k in range(20)]) == pytest.approx(places, abs=1e-6)
    normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
    steps = np.diff(places @ normal / np.linalg.norm(normal))
    assert 0.3 < np.abs(steps - 2.5).max() <= 0.8
    warned = list_series(tmp_path / "ct").series[0].warnings
    assert any("unevenly spaced" in text for text in warned)
    assert np.array_equal(volume.voxels, make_phantom(settings)[0])


@pytest.mark.release
def test_uneven_slices_show_what_is_at_their_place() -> None:
    settings = PhantomSettings(size=(40, 36), slices=5, spacing=(6.0, 6.0, 2.5), **CLEAN)
    affine = place_slices(settings).affine
    moved = affine.copy()
    moved[:3, 3] += 0.4 * affine[:3, 2]
    by_place = draw_spine(settings, affine, places=np.arange(5) + 0.4)[0]
    by_affine = draw_spine(settings, moved)[0]
    assert np.abs(by_place - by_affine).max() < 0.5  # float32 of coordinates
    assert np.abs(by_place - draw_spine(settings, affine)[0]).max() > 100.0


def test_blur_between_uneven_slices_weighs_by_distance() -> None:
    affine, rng = np.diag((1.0, 1.0, 2.0, 1.0)), np.random.default_rng(0)
    field = rng.normal(0.0, 100.0, (9, 6, 5)).astype(np.float32)
    even = apply_point_spread(field.copy(), affine, 1.5)
    again = apply_point_spread(field.copy(), affine, 1.5, places=np.arange(9.0))
    assert again[4] == pytest.approx(even[4], abs=0.2)  # beyond four sigma the one has nothing
    line = np.broadcast_to(np.arange(9, dtype=np.float32)[:, None, None] * 0.0 + 7.0, field.shape).copy()
    places = np.arange(9) + np.array([0, 0.2, -0.1, 0.1, 0, -0.2, 0.1, 0, 0])
    assert apply_point_spread(line, affine, 1.5, places=places) == pytest.approx(np.full(field.shape, 7.0), abs=1e-5)


def test_missing_slices_are_told_and_read_when_allowed(tmp_path: Path) -> None:
    settings = PhantomSettings(**SMALL, missing=(9, 8, 15))
    truth = write_phantom(tmp_path / "ct", settings)
    names = sorted(path.name for path in (tmp_path / "ct").glob("*.dcm"))
    assert len(names) == truth["shape_ijk"][2] == 17
    assert {"IM0008.dcm", "IM0009.dcm", "IM0015.dcm"}.isdisjoint(names)
    with refused(RefusedInputError, "allow_gaps=True", 2):
        read_volume(tmp_path / "ct")
    volume = read_volume(tmp_path / "ct", allow_gaps=True)
    assert volume.report["slices_missing"] == 3
    whole = make_phantom(PhantomSettings(**SMALL))[0]
    kept = [k for k in range(20) if k + 1 not in (8, 9, 15)]
    assert np.array_equal(volume.voxels, make_phantom(settings)[0])
    assert np.array_equal(volume.voxels, whole[kept])


@pytest.mark.release
def test_phases_are_listed_and_differ_in_their_vessels(tmp_path: Path) -> None:
    settings = PhantomSettings(**SMALL, **CLEAN, phases=3)
    write_phantom(tmp_path / "ct", settings)
    entry = list_series(tmp_path / "ct").series[0]
    assert entry.slices == 60 and [phase["slices"] for phase in entry.phases] == [20, 20, 20]
    with refused(RefusedInputError, "phases", 3):
        read_volume(tmp_path / "ct")
    first, last = (read_volume(tmp_path / "ct", phase=n).voxels for n in (1, 3))
    assert np.array_equal(first, make_phantom(PhantomSettings(**SMALL, **CLEAN))[0])
    changed = (last - first)[first != last]
    assert 0.001 < (first != last).mean() < 0.2 and changed.max() == 180


@pytest.mark.parametrize(("text", "numbers"), [("20-22,40", (20, 21, 22, 40)), (" 3 ", (3,)), ("5-5", (5,))])
def test_numbers_of_slices_are_read(text: str, numbers: tuple[int, ...]) -> None:
    assert parse_missing(text) == numbers


@pytest.mark.parametrize("text", ["", "a", "3-", "5-3", "1.5", "-2", "3,,4", "\u0663"])
def test_other_numbers_of_slices_are_refused(text: str) -> None:
    with refused(UsageError, 20, 22):
        parse_missing(text)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"missing": (1,)}, "missing slice must be a whole number from 2 to 19, got 1"),
        ({"missing": (20,)}, "from 2 to 19, got 20"),
        ({"missing": (5, 5)}, "named more than once"),
        ({"missing": ("5",)}, "whole number.*got 5"),
        ({"uneven_mm": 1.01}, r"from 0 to 1 mm \(0.4 of the mean gap\), got 1.01"),
        ({"uneven_mm": -0.1}, "unevenness.*got -0.1"),
        ({"phases": 0}, "phases must be a whole number from 1 to 20, got 0"),
        ({"phases": 20, "slices": 500}, "20 phases of 500 slices are more than 9999 files"),
        ({"ghosts": True, "phases": 2}, "ghosts are for an even series of one phase"),
        ({"kind": "sphere", "uneven_mm": 0.5}, "a sphere has no uneven slices: they are for the spine"),
        ({"kind": "sphere", "phases": 2}, "a sphere has no phases: they are for the spine"),
    ],
)
def test_impossible_series_are_refused_with_their_numbers(given: dict, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        PhantomSettings(**{**SMALL, **given})


def test_the_lines_of_a_screen_capture_are_a_24th_of_it_high_and_as_far_apart() -> None:
    voxels = np.zeros((12, 96, 128), np.int16)
    (capture, _) = [each["slice"] for each in draw_ghosts(voxels, 0)["slices"]]
    lines = np.flatnonzero((voxels[capture][8:-8, 8:-8] == TEXT_HU).any(axis=1)) + 8
    assert lines.tolist() == [row for top in range(12, 88, 8) for row in range(top, top + 4)]
