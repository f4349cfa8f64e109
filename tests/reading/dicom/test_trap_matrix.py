"""Every row of the trap matrix: voxels where they were written, or a refusal that says why; nothing is silent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tolerances import AFFINE_MM, FAR_AFFINE_MM, JITTER_AFFINE_MM, ROUNDED_AFFINE_MM
from trap_cases import CASES
from trap_plan import BACKGROUND_HU, BODY_HU, EXACT, REFUSED, WARNED, Case, Marks, Size
from variants import daily

from clrecon.errors import ClreconError, RefusedInputError
from clrecon.geometry import Volume
from clrecon.reading import read_volume

BOUNDS_MM = {"written": AFFINE_MM, "rounded": ROUNDED_AFFINE_MM, "far": FAR_AFFINE_MM, "jitter": JITTER_AFFINE_MM}


def assert_marks(volume: Volume, truth: Marks, bound_mm: float) -> None:
    """Every mark of the stack is there once, at its place, and nothing else is."""
    assert volume.voxels.shape[0] == truth.slices
    kji = np.argwhere((volume.voxels != BACKGROUND_HU) & (volume.voxels != BODY_HU))
    hu = volume.voxels[tuple(kji.T)]
    order, expected = np.argsort(hu), np.argsort(truth.hu)
    assert np.array_equal(hu[order], truth.hu[expected])
    errors = np.linalg.norm(volume.ijk_to_lps(kji[order, ::-1]) - truth.lps_mm[expected], axis=1)
    assert errors.max() < bound_mm, f"a mark lies {errors.max():.2g} mm off"


def assert_warnings(volume: Volume, verdict: str, words: tuple[str, ...]) -> None:
    """There are warnings exactly where the verdict says so, with all of the words."""
    text = "; ".join(volume.report["warnings"])
    assert bool(text) == (verdict == WARNED), text
    for word in words:
        assert word in text


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_each_trap_gets_its_verdict(tmp_path: Path, case: Case) -> None:
    truth = case.write(tmp_path, Size())
    if case.verdict == REFUSED:
        with pytest.raises(ClreconError) as caught:
            read_volume(tmp_path)
        assert isinstance(caught.value, RefusedInputError), caught.value
        for word in case.words:
            assert word in str(caught.value)
        assert "\n" not in str(caught.value)
        return
    volume = read_volume(tmp_path)
    assert_warnings(volume, case.verdict, case.words)
    assert_marks(volume, truth, BOUNDS_MM[case.bound])


@pytest.mark.parametrize(
    "case", daily(8, [c for c in CASES.values() if c.again]), ids=[c.name for c in CASES.values() if c.again]
)
def test_refused_row_is_read_on_request_within_its_bound(tmp_path: Path, case: Case) -> None:
    truth = case.write(tmp_path, Size())
    volume = read_volume(tmp_path, **dict(case.again or {}))
    assert_warnings(volume, EXACT if "series" in dict(case.again or {}) else WARNED, case.again_words)
    assert_marks(volume, truth, BOUNDS_MM[case.bound])


@pytest.mark.parametrize("harm", ["stretched", "reversed"])
def test_check_of_marks_fails_for_a_stack_that_is_stretched_or_reversed(tmp_path: Path, harm: str) -> None:
    truth = CASES["regular, non-square pixels"].write(tmp_path, Size())
    volume = read_volume(tmp_path)
    assert_marks(volume, truth, AFFINE_MM)
    stretched = np.array(volume.affine)
    stretched[:3, 2] *= 1.00001  # 24 slices of a mm and more: off by a hundred times the bound and more
    wrong = Volume(volume.voxels, stretched) if harm == "stretched" else Volume(volume.voxels[::-1], volume.affine)
    with pytest.raises(AssertionError, match="a mark lies"):
        assert_marks(wrong, truth, AFFINE_MM)


def test_trap_cases_cover_every_verdict() -> None:
    verdicts = [case.verdict for case in CASES.values()]
    assert len(verdicts) >= 40  # there are 73: a list that lost cases would pass all other tests
    assert min(verdicts.count(verdict) for verdict in (EXACT, WARNED, REFUSED)) >= 9  # of the fewest, exact, 16


def test_trap_cases_that_are_not_exact_say_with_which_words() -> None:
    assert all(case.words for case in CASES.values() if case.verdict != EXACT)
