# SPDX-License-Identifier: Apache-2.0
"""Text that somebody else wrote, made fit for a terminal and for one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

_LONGEST = 80
_LONGEST_PATH = 500
"""Characters of a path: lists name files that no disk could hold."""


def printable(text: str) -> str:
    """Return ``text`` with all that is not plainly visible as an escape: ``\\x1b``, ``\\n``, ``\\udcff``.

    What comes back holds no control character, no line break, no mark that turns the direction of writing and
    no half of a surrogate pair, so that it can be printed anywhere. Doing it twice changes nothing.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shown_path(path: str | Path) -> str:
    """Return a path as a message shows it: printable, and as long as those that can exist with some room."""
    return shortened(printable(str(path)), _LONGEST_PATH)


def shown(value: Any) -> str:
    """Return ``value`` as a message shows it: printable, and no longer than about 80 characters."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of thousands of digits; lists in lists in lists
        return f"a {type(value).__name__} beyond all bounds"
    return shortened(printable(text))


def shortened(text: str, most: int = _LONGEST) -> str:
    """Return ``text`` with its end left out where it has more than about ``most`` characters."""
    return text if len(text) <= most else f"{text[: most - 20]}... ({len(text):,} characters)"
