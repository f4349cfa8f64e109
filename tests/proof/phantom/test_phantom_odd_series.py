"""Phantoms whose series is uneven, gapped or phased are read and told as real ones are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tolerances
from refusals import refused
from report_schemas import find_faults
from variants import daily

from clrecon.errors import RefusedInputError, UsageError
from clrecon.proof.phantom import PhantomSettings, apply_point_spread, make_phantom, parse_missing, write_phantom
from clrecon.proof.phantom.series import place_slices
from clrecon.proof.phantom.settings import TEXT_HU, draw_ghosts
from clrecon.proof.phantom.spine import draw_spine
from clrecon.reading import list_series, read_volume

SMALL = {"size": (24, 20), "slices": 20, "spacing": (11.0, 10.0, 2.5)}
CLEAN = {"noise": 0.0, "point_spread_mm": 0.0}


@pytest.fixture(
    scope="module", params=daily(1, [{}, {"tilt": 12.0, "oblique": (5.0, 0.0, 10.0)}]), ids=["straight", "tilted"]
)
def uneven_series(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, PhantomSettings, dict]:
    """Folder, settings and truth of a series whose slices lie up to 0.8 mm beside an even plan of 2.5 mm."""
    settings = PhantomSettings(**SMALL, **request.param, uneven_mm=0.8)
    folder = tmp_path_factory.mktemp("uneven") / "ct"
    return folder, settings, write_phantom(folder, settings)


def test_uneven_slices_lie_where_the_truth_says(uneven_series: tuple[Path, PhantomSettings, dict]) -> None:
    folder, settings, truth = uneven_series
    volume = read_volume(folder)

    found = volume.ijk_to_lps([(0, 0, k) for k in range(settings.slices)])

    expected = np.array(truth["series"]["slice_positions_lps_mm"])
    assert volume.uneven
    assert found == pytest.approx(expected, abs=tolerances.DICOM_PLACE_MM)


def test_gaps_of_uneven_slices_differ_from_the_mean_by_no_more_than_asked(
    uneven_series: tuple[Path, PhantomSettings, dict],
) -> None:
    folder, settings, truth = uneven_series
    affine = read_volume(folder).affine
    normal = np.cross(affine[:3, 0], affine[:3, 1])

    heights = np.array(truth["series"]["slice_positions_lps_mm"]) @ normal / np.linalg.norm(normal)

    _, _, mean_gap = settings.spacing
    largest_difference = np.abs(np.diff(heights) - mean_gap).max()
    assert 0.3 < largest_difference <= settings.uneven_mm  # mm; measured 0.62: the gaps do differ


def test_uneven_slices_are_warned_of(uneven_series: tuple[Path, PhantomSettings, dict]) -> None:
    folder, _, _ = uneven_series
    (series,) = list_series(folder).series
    assert any("unevenly spaced" in text for text in series.warnings)


def test_voxels_of_written_uneven_slices_are_those_of_the_phantom(
    uneven_series: tuple[Path, PhantomSettings, dict],
) -> None:
    folder, settings, _ = uneven_series
    voxels, _, _ = make_phantom(settings)
    assert np.array_equal(read_volume(folder).voxels, voxels)


@pytest.mark.release
def test_uneven_slices_show_what_is_at_their_place() -> None:
    settings = PhantomSettings(size=(40, 36), slices=5, spacing=(6.0, 6.0, 2.5), **CLEAN)
    affine = place_slices(settings).affine
    moved_affine = affine.copy()
    moved_affine[:3, 3] += 0.4 * affine[:3, 2]

    moved_by_places = draw_spine(settings, affine, places=np.arange(5) + 0.4)[0]

    moved_by_affine, unmoved = (draw_spine(settings, given)[0] for given in (moved_affine, affine))
    assert np.abs(moved_by_places - moved_by_affine).max() < 0.5  # HU: coordinates in float32; measured 0
    assert np.abs(moved_by_places - unmoved).max() > 100.0  # HU; measured 633


def test_blur_of_slices_at_even_places_is_that_of_an_even_volume() -> None:
    affine = np.diag((1.0, 1.0, 2.0, 1.0))
    noise = np.random.default_rng(0).normal(0.0, 100.0, (9, 6, 5)).astype(np.float32)

    by_affine = apply_point_spread(noise.copy(), affine, sigma_mm=1.5)
    by_places = apply_point_spread(noise.copy(), affine, sigma_mm=1.5, places=np.arange(9.0))

    middle = 4  # the ends differ: beyond them one of both has nothing
    assert by_places[middle] == pytest.approx(by_affine[middle], abs=0.2)  # HU; weights end at four sigma


def test_blur_between_uneven_slices_leaves_a_constant_volume_as_it_is() -> None:
    affine = np.diag((1.0, 1.0, 2.0, 1.0))
    constant = np.full((9, 6, 5), 7.0, np.float32)
    uneven_places = np.arange(9) + np.array([0, 0.2, -0.1, 0.1, 0, -0.2, 0.1, 0, 0])
    blurred = apply_point_spread(constant.copy(), affine, sigma_mm=1.5, places=uneven_places)
    assert blurred == pytest.approx(constant, abs=1e-5)  # sums in float32


@pytest.fixture(scope="module")
def series_with_gaps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """Folder and truth of a series of 20 slices without the 8th, the 9th and the 15th."""
    folder = tmp_path_factory.mktemp("gaps") / "ct"
    return folder, write_phantom(folder, PhantomSettings(**SMALL, missing=(9, 8, 15)))


def test_missing_slices_have_no_files(series_with_gaps: tuple[Path, dict]) -> None:
    folder, truth = series_with_gaps
    numbers = {int(path.stem.removeprefix("IM")) for path in folder.glob("IM*.dcm")}
    assert numbers == {*range(1, 21)} - {8, 9, 15}
    assert truth["shape_ijk"][2] == 20 - 3


def test_series_with_missing_slices_is_refused_with_its_two_gaps(series_with_gaps: tuple[Path, dict]) -> None:
    folder, _ = series_with_gaps
    gaps = 2  # slices 8 and 9, and slice 15
    with refused(RefusedInputError, "allow_gaps=True", gaps):
        read_volume(folder)


def test_series_with_allowed_gaps_has_the_other_slices_and_the_number_of_missing_ones(
    series_with_gaps: tuple[Path, dict],
) -> None:
    folder, _ = series_with_gaps
    volume = read_volume(folder, allow_gaps=True)

    whole, _, _ = make_phantom(PhantomSettings(**SMALL))
    assert np.array_equal(volume.voxels, np.delete(whole, [8 - 1, 9 - 1, 15 - 1], axis=0))
    assert volume.report["slices_missing"] == 3


def test_voxels_of_a_phantom_with_missing_slices_are_those_of_the_others() -> None:
    whole, _, _ = make_phantom(PhantomSettings(**SMALL))
    with_gaps, _, _ = make_phantom(PhantomSettings(**SMALL, missing=(9, 8, 15)))
    assert np.array_equal(with_gaps, np.delete(whole, [8 - 1, 9 - 1, 15 - 1], axis=0))


@pytest.fixture(scope="module")
def series_of_three_phases(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three times 20 slices without noise."""
    folder = tmp_path_factory.mktemp("phases") / "ct"
    write_phantom(folder, PhantomSettings(**SMALL, **CLEAN, phases=3))
    return folder


@pytest.mark.release
def test_series_of_three_phases_is_listed_with_the_slices_of_each(series_of_three_phases: Path) -> None:
    (entry,) = list_series(series_of_three_phases).series
    assert [phase["slices"] for phase in entry.phases] == [20, 20, 20]
    assert entry.slices == 60


@pytest.mark.release
def test_series_of_three_phases_is_refused_unless_one_is_named(series_of_three_phases: Path) -> None:
    with refused(RefusedInputError, "phases", 3):
        read_volume(series_of_three_phases)


@pytest.mark.release
def test_last_phase_differs_from_the_first_in_vessels_that_are_180_hu_brighter(series_of_three_phases: Path) -> None:
    first, last = (read_volume(series_of_three_phases, phase=n).voxels for n in (1, 3))
    assert np.array_equal(first, make_phantom(PhantomSettings(**SMALL, **CLEAN))[0])
    assert 0.001 < (first != last).mean() < 0.2  # of the voxels; measured 0.05
    assert (last - first).max() == 180  # HU


@pytest.mark.parametrize(("text", "numbers"), [("20-22,40", (20, 21, 22, 40)), (" 3 ", (3,)), ("5-5", (5,))])
def test_missing_slices_are_read_from_numbers_and_ranges(text: str, numbers: tuple[int, ...]) -> None:
    assert parse_missing(text) == numbers


@pytest.mark.parametrize("text", ["", "a", "3-", "5-3", "1.5", "-2", "3,,4", "\u0663"])
def test_text_that_names_no_slices_is_refused_with_an_example(text: str) -> None:
    with refused(UsageError, 20, 22):  # "such as 20-22"
        parse_missing(text)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        pytest.param({"missing": (1,)}, "missing slice must be a whole number from 2 to 19, got 1", id="first missing"),
        pytest.param({"missing": (20,)}, "from 2 to 19, got 20", id="last missing"),
        pytest.param({"missing": (5, 5)}, "named more than once", id="missing twice"),
        pytest.param({"missing": ("5",)}, "whole number.*got 5", id="number as text"),
        pytest.param({"uneven_mm": 1.01}, r"from 0 to 1 mm \(0.4 of the mean gap\), got 1.01", id="too uneven"),
        pytest.param({"uneven_mm": -0.1}, "unevenness.*got -0.1", id="negative unevenness"),
        pytest.param({"phases": 0}, "phases must be a whole number from 1 to 20, got 0", id="no phase"),
        pytest.param(
            {"phases": 20, "slices": 500}, "20 phases of 500 slices are more than 9999 files", id="too many files"
        ),
        pytest.param(
            {"ghosts": True, "phases": 2}, "ghosts are for an even series of one phase", id="ghosts in two phases"
        ),
        pytest.param(
            {"kind": "sphere", "uneven_mm": 0.5},
            "a sphere has no uneven slices: they are for the spine",
            id="uneven sphere",
        ),
        pytest.param(
            {"kind": "sphere", "phases": 2}, "a sphere has no phases: they are for the spine", id="phases of a sphere"
        ),
    ],
)
def test_settings_of_an_impossible_series_are_refused_with_their_numbers(given: dict, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        PhantomSettings(**{**SMALL, **given})


def test_text_of_a_screen_capture_has_lines_of_a_24th_of_its_height_as_far_apart_from_the_third_on() -> None:
    rows, margin = 96, 8  # a frame lies within the margin, and ends above the last line
    voxels = np.zeros((12, rows, 128), np.int16)

    capture, _ = (ghost["slice"] for ghost in draw_ghosts(voxels, seed=0)["slices"])

    within_the_margin = voxels[capture, margin:-margin, margin:-margin]
    text_rows = margin + np.flatnonzero((within_the_margin == TEXT_HU).any(axis=1))
    height = rows // 24
    tops = range(3 * height, rows - margin, 2 * height)
    expected = [row for top in tops for row in range(top, top + height)]
    assert text_rows.tolist() == expected


@pytest.mark.parametrize(
    "given",
    [
        pytest.param({"kind": "sphere", "radius_mm": 30.0}, id="shape"),
        pytest.param({"kind": "limb"}, id="scene"),
        pytest.param({"levels": "L3-L4", "facet_gap_mm": 0.5}, id="chosen levels"),
        pytest.param({"ghosts": True}, id="ghosts"),
        pytest.param({"uneven_mm": 0.5, "missing": (3,), "phases": 2}, id="uneven, gapped and phased"),
    ],
)
def test_truth_of_a_phantom_is_as_its_schema_says(given: dict) -> None:
    _, _, truth = make_phantom(PhantomSettings(size=(20, 20), slices=12, spacing=(8.0, 8.0, 8.0), **given))

    assert find_faults(truth, "phantom") == []
