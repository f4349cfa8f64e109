"""The median is numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.reading.dicom.stack.fit import median


@pytest.mark.parametrize("count", range(1, 10))
def test_the_median_is_that_of_numpy(count: int) -> None:
    random = np.random.default_rng(count)
    for scale in (1e-9, 1.0, 1e9):
        for values in (random.uniform(-scale, scale, count), scale * random.integers(-2, 2, count)):
            assert median(values.tolist()) == median(values) == np.median(values)
