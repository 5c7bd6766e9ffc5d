# SPDX-License-Identifier: Apache-2.0
"""The distinct of many integers, such as labels and voxels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_DENSE = 32
"""A table of all integers from the least to the largest tells them apart, where these are at most so many
times those given: it then costs no more than sorting, and far less where they are as close as labels."""
_DENSE_COUNTS = 2
"""The same of a table of counts, which is eight times as large, while no places are to be found."""


def ranked(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.intp]]:
    """Return [k] the distinct of integer ``values`` (any shape), rising, and the place of each value in them.

    As ``numpy.unique`` does that returns the inverse, ten times as fast where they are close together.
    """
    least, span = _span(values)
    if span > _DENSE * values.size:
        distinct = np.unique(values)
        return distinct, np.searchsorted(distinct, values)
    at = np.subtract(values, least, dtype=np.intp)
    there = np.zeros(span, bool)
    there[at] = True
    distinct = np.flatnonzero(there)
    ranks = np.empty(span, np.intp)
    ranks[distinct] = np.arange(len(distinct))
    return (distinct + least).astype(values.dtype), ranks.take(at)


def counted(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Return [k] the distinct of integer ``values`` [n], rising, and how often each is there.

    As ``numpy.unique`` does that returns counts, ten times as fast where they are close together.
    """
    least, span = _span(values)
    if span > _DENSE_COUNTS * values.size:
        return np.unique(values, return_counts=True)
    counts = np.bincount(values - least, minlength=span)
    distinct = np.flatnonzero(counts)
    return (distinct + least).astype(values.dtype), counts[distinct]


def _span(values: NDArray[Any]) -> tuple[int, int]:
    """Return the least of integer ``values``, and how many integers there are from it to the largest."""
    least = int(values.min(initial=np.iinfo(values.dtype).max))
    return least, int(values.max(initial=least)) - least + 1
