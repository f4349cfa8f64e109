"""Masks of bands of HU and of lists of voxels."""

from __future__ import annotations

import pytest

from clrecon.errors import UsageError
from clrecon.operators.masks.voxel_mask import check_shape


def test_masks_too_large_are_refused():
    with pytest.raises(UsageError, match="masks hold rows of up to 65,535"):
        check_shape((65_536, 2, 2))
    with pytest.raises(UsageError, match="up to 2,147,483,647 words"):
        check_shape((65_000, 65_000, 20))
