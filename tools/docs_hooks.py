# SPDX-License-Identifier: Apache-2.0
"""Hooks of MkDocs: formulas become MathML when the pages are built, so that a reader fetches nothing."""

from __future__ import annotations

import html
import re
from typing import Any

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_TAG = re.compile(r"\\tag\{([^}]*)\}")


def on_page_content(text: str, **_: Any) -> str:
    """Replace each formula of a page."""
    return _FORMULA.sub(_mathml, text)


def _mathml(match: re.Match[str]) -> str:
    # Of the extra "docs": the tests' environment may lack it.
    from latex2mathml.converter import convert  # pyright: ignore[reportMissingImports]

    latex = html.unescape(match[3])
    tag = _TAG.search(latex)
    latex = _TAG.sub("", latex)
    display = "inline" if match[2] == "(" else "block"
    formula = convert(latex, display=display)
    if unknown := re.search(r"\\[a-zA-Z]+", formula):
        raise ValueError(f"{latex.strip()}: {unknown[0]} has no MathML; say it otherwise")
    if display == "inline":
        return formula
    number = f'<span style="float: right">({tag[1]})</span>' if tag else ""
    return f"<div>{number}{formula}</div>"
