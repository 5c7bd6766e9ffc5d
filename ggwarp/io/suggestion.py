# SPDX-License-Identifier: Apache-2.0
"""What somebody who mistyped a name may have meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, names: Iterable[str], *, prefix: str = " ") -> str:
    """Return ``prefix`` and "(did you mean NAME?)" with the nearest of ``names``; empty: none is near."""
    close = difflib.get_close_matches(word, sorted(set(names)), n=1, cutoff=0.65)
    return f"{prefix}(did you mean {close[0]}?)" if close else ""
