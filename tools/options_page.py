# SPDX-License-Identifier: Apache-2.0
"""Write docs/options.md: every option of ``ggwarp run``, from the code.

python tools/options_page.py
"""

from __future__ import annotations

from pathlib import Path

from ggwarp.config.options import Option, option_table

PAGE = Path(__file__).parents[1] / "docs" / "options.md"

_HEAD = """# Options

<!-- Written by tools/options_page.py from the code; do not edit. -->

Every option of `ggwarp run`, which is also `python -m ggwarp.run`; `--help-all` prints them. A preset or
a saved `config.toml` (`--config FILE`) is where the others start from. Defaults are of the preset
`gg-slam`.
"""


def page() -> str:
    """Return the page's text."""
    groups: dict[str, list[Option]] = {}
    for option in option_table():
        groups.setdefault(option.group, []).append(option)
    parts = [_HEAD]
    for group, options in groups.items():
        title = group if " " in group else f"`--{group}.*`"
        rows = "\n".join(_row(option) for option in options)
        parts.append(f"## {title}\n\n| option | meaning | default |\n|---|---|---|\n{rows}\n")
    return "\n".join(parts)


def _row(option: Option) -> str:
    values = [value for value in option.choices if value not in ("yes", "no")]
    flag = f"`{option.flag}`" + (f" {', '.join(f'`{value}`' for value in values)}" if values else "")
    return f"| {flag} | {option.help} | {option.default} |".replace("  ", " ")


if __name__ == "__main__":
    PAGE.write_text(page())
