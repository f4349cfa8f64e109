"""The gate ``stored_sign``: whether the highest stored bit was read as what it is, a sign or a part of the value.

Where it was not, values wrap around: air becomes the densest of all, or dense bone turns negative inside of bone.  It
shows at neighbours on either side of the highest bit: in a picture they are close together, once wrapped they are
nearly the whole range of the stored bits apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.sources.facts import PixelFacts
from clrecon.sources.sample import sample_slices
from clrecon.sources.stored_values import StoredValues
from clrecon.system.records import Gate, none_of, unmeasured

SIGN_SAID = "neighbouring values that lie nearly the whole range of the stored bits apart: the sign is lost"

FEWEST_BITS = 9
"""An image of 8 bits or fewer has edges from the lowest to the highest value."""
CLOSE = 0.125
"""Neighbours this share of the range apart are close."""
FEWEST_JUMPS, JUMPS, FEWEST_VALUES = 50, 4, 8
"""Fewest pairs of neighbours that are close only if they are read the other way, how many times those that are close as
they were read, and fewest different values of theirs: a mask has two."""


def judge_sign(voxels: NDArray[Any], facts: PixelFacts, slices: Sequence[StoredValues]) -> Gate:
    """Judge the gate ``stored_sign`` by the sampled slices of a volume (nk, nj, ni); `slices` in the order of k."""
    if not slices:
        return unmeasured("stored_sign", 0, None, f"{SIGN_SAID}: the values are no whole numbers")
    close, jumps, pairs, first = 0, 0, [], slices[0]
    for k in sample_slices(len(slices)):
        header = slices[k]
        span = header.slope * 2.0**header.bits_stored
        if header.bits_stored < FEWEST_BITS or facts.hu_max - facts.hu_min < (1.0 - CLOSE) * span or span <= 0.0:
            continue
        left, right = _find_crossings(voxels[k], header)
        apart = np.abs(left - right)
        close += int(np.count_nonzero(apart < CLOSE * span))
        wrapped = apart > (1.0 - CLOSE) * span
        jumps += int(np.count_nonzero(wrapped))
        pairs.append(left[wrapped])
    if jumps < FEWEST_JUMPS or jumps <= JUMPS * close or len(np.unique(np.concatenate(pairs))) < FEWEST_VALUES:
        return none_of("stored_sign", 0, SIGN_SAID)
    count = 2**first.bits_stored
    if first.signed:
        why = "values of dense bone or metal turn negative: the values seem to be stored without a sign, but"
        wrong, right_one = "PixelRepresentation is 1 (signed)", 0
    else:
        why = "no air, and values at the far end of the range: the values seem to be signed, but"
        wrong, right_one = "PixelRepresentation is 0 (unsigned)", 1
    return none_of(
        "stored_sign",
        jumps,
        f"neighbouring values nearly {count:,} apart, the whole range of {first.bits_stored} stored bits, and {why}"
        f" {wrong}; write the files anew with PixelRepresentation {right_one}. Pairs found in the sampled slices",
    )


def _find_crossings(picture: NDArray[Any], header: StoredValues) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return both values of each pair of neighbours in a row of which one has the highest stored bit set."""
    half = 0.0 if header.signed else 2.0 ** (header.bits_stored - 1)
    above = picture >= half * header.slope + header.intercept
    crossing = above[:, 1:] != above[:, :-1]
    return picture[:, :-1][crossing].astype(np.float64), picture[:, 1:][crossing].astype(np.float64)
