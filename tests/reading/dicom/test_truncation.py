"""A file cut at every byte: refused by name, or read as it was; never anything else, and never another volume."""

from __future__ import annotations

import numpy as np
import pytest
from hostile_bytes import Seed, phantom_seeds
from variants import daily

from clrecon.errors import ClreconError, RefusedInputError
from clrecon.reading import list_series, read_volume

PIXEL_STRIDE = 7
SERIES_STRIDE = 11
"""Odd, so that cuts meet every byte of the heads of elements; a listing of the one file is cut at every byte."""
SEEDS = phantom_seeds()


def lengths_to_cut(seed: Seed) -> list[int]:
    """Every byte up to the pixel data and over its head, then some of the value, then every byte of the end."""
    value = len(seed.data) if seed.deflated_from >= 0 else seed.elements[-1].value
    strided = range(value + 8, len(seed.data) - 16, PIXEL_STRIDE)
    return sorted({*range(min(value + 8, len(seed.data))), *strided, *range(len(seed.data) - 16, len(seed.data))})


@pytest.mark.fuzz
@pytest.mark.parametrize("name", daily(1, SEEDS))
def test_series_with_a_slice_cut_anywhere_is_refused_unless_no_pixel_is_lost(tmp_path, name, capfd):
    seed = SEEDS[name]
    folder = tmp_path / "ct"
    folder.mkdir()
    for k, data in enumerate(seed.series):
        (folder / f"{k}").write_bytes(data)
    whole = read_volume(folder)
    cut = folder / f"{len(seed.series) // 2}"

    for length in lengths_to_cut(seed)[::SERIES_STRIDE]:
        cut.write_bytes(seed.data[:length])
        try:
            volume = read_volume(folder)
        except RefusedInputError as error:
            text = str(error)
            assert text.isprintable()
            assert cut.name in text or len(seed.series) == 1
        except ClreconError:
            assert len(seed.series) == 1  # nothing is left of the only file
            assert length < 140  # preamble and mark are 132, the head of the first element 8
        else:
            if length == 0:  # an empty file without an extension is nobody's slice
                assert volume.voxels.shape[0] == len(seed.series) - 1
                assert volume.report["files"]["skipped"] == {"not DICOM": 1}
                continue
            # Nothing is missed where a few bytes of padding, or the end mark of the last item, are gone.
            assert length >= len(seed.data) - 8
            assert np.array_equal(volume.voxels, whole.voxels)
    assert capfd.readouterr() == ("", "")


@pytest.mark.fuzz
@pytest.mark.parametrize("name", daily(1, SEEDS))
def test_file_cut_within_its_header_or_pixels_is_listed_with_a_problem_or_refused(tmp_path, name):
    seed = SEEDS[name]
    outcomes = set()
    for length in lengths_to_cut(seed)[:: 1 if len(seed.series) > 1 else 2]:
        (tmp_path / "0").write_bytes(seed.data[:length])
        try:
            (series,) = list_series(tmp_path).series
        except ClreconError as error:
            outcomes.add(type(error).__name__)
        else:
            assert series.problems
            outcomes.add("listed")
    assert {"NoDicomError", "RefusedInputError"} <= outcomes <= {"NoDicomError", "RefusedInputError", "listed"}
