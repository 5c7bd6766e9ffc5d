# SPDX-License-Identifier: Apache-2.0
"""Pieces of a page: its frame, tables, figures as text, pictures within it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import ggwarp

NOT_MEASURED = "–"  # noqa: RUF001 - a dash


def document(title: str, body: str) -> str:
    """Return a whole page; nothing in it is fetched from elsewhere."""
    assets = resources.files("ggwarp.report") / "assets"
    style, script = (assets / name for name in ("report.css", "report.js"))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        # An empty icon: a browser would ask for one.
        f'<link rel="icon" href="data:,"><title>{escape(title)}</title>'
        f"<style>{style.read_text('utf-8')}</style></head><body>{body}"
        f"<footer>ggwarp {ggwarp.__version__}</footer>"
        f"<script>{script.read_text('utf-8')}</script></body></html>\n"
    )


def section(title: str, content: str) -> str:
    """Return a part with a heading; empty without ``content``."""
    return f"<section><h2>{escape(title)}</h2>{content}</section>" if content else ""


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, caption: str = "", numbers: str = "") -> str:
    """Return a table.

    Args:
        head: of the columns; none: without a head.
        rows: cells as HTML.
        numbers: a letter a column, n for figures.
    """
    kinds = [' class="n"' if kind == "n" else "" for kind in numbers.ljust(max(map(len, rows), default=0))]
    top = "".join(f"<th{kind}>{escape(name)}</th>" for name, kind in zip(head, kinds, strict=False))
    lines = (
        "".join(f"<td{kind}>{cell}</td>" for cell, kind in zip(row, kinds, strict=False)) for row in rows
    )
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    named = f"<caption>{escape(caption)}</caption>" if caption else ""
    head_row = f"<thead><tr>{top}</tr></thead>" if head else ""
    return f'<div class="scroll"><table>{named}{head_row}<tbody>{body}</tbody></table></div>'


def notes(lines: Sequence[str], *, mild: bool = False) -> str:
    """Return a box of remarks; empty without any."""
    inner = "".join(f"<p>{escape(line)}</p>" for line in lines)
    return f'<div class="notes{" mild" if mild else ""}">{inner}</div>' if lines else ""


def figure(value: Any, digits: int | None = None) -> str:
    """Return a measured value as text; a dash for None.

    Args:
        digits: after the point; None: by its size.
    """
    if value is None or (isinstance(value, float) and value != value):
        return NOT_MEASURED
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return escape(str(value))
    if isinstance(value, int):
        return f"{value:,}"
    if digits is not None:
        return f"{value:,.{digits}f}"
    return f"{value:.4g}" if abs(value) < 1.0 else f"{value:,.2f}"


def picture_uri(path: Path) -> str:
    """Return the picture in ``path`` as a URI that holds it; empty where it cannot be read."""
    try:
        data = path.read_bytes()
    except OSError:
        return ""
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
