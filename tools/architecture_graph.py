# SPDX-License-Identifier: Apache-2.0
"""Draw who imports whom: docs/architecture.mmd from the table in tests/test_architecture.py.

    python tools/architecture_graph.py

An arrow that follows from others is left out.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "tests" / "test_architecture.py"
GRAPH = ROOT / "docs" / "architecture.mmd"


def allowed() -> dict[str, set[str]]:
    """Return room -> the rooms it may import, as the test has it."""
    wanted = ("_VALUES", "_DEVICE", "_MAP", "_SYSTEM", "ALLOWED")
    names: dict[str, dict[str, set[str]]] = {}
    for node in ast.parse(TABLE.read_text()).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        name = getattr(targets[0], "id", "")
        if name.startswith("_") or name in wanted:
            assert isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None
            try:
                names[name] = eval(compile(ast.Expression(node.value), str(TABLE), "eval"), {}, names)
            except NameError:
                continue
    return names["ALLOWED"]


def arrows(table: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Return the pairs (importer, imported) that do not follow from others."""
    reached: dict[str, set[str]] = {}

    def reach(room: str) -> set[str]:
        if room not in reached:
            reached[room] = set()  # a room and its sub-rooms may name each other
            direct = table[room] - {room}
            reached[room] = direct.union(*(reach(other) for other in direct))
        return reached[room]

    return [
        (room, other)
        for room in table
        for other in sorted(table[room] - {room})
        if not any(other in reach(between) for between in table[room] - {room, other})
    ]


def drawn(table: dict[str, set[str]]) -> str:
    """Return the graph as a fenced block of Mermaid."""

    def node(room: str) -> str:
        return f'{room.replace(".", "_")}["{room.replace(".", "/")}"]'

    pairs = arrows(table)
    lonely = [room for room in table if not any(room in pair for pair in pairs)]
    lines = [
        "```mermaid",
        "graph TD",
        *(f"  {node(a)} --> {node(b)}" for a, b in pairs),
        *map(node, lonely),
        "```",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    GRAPH.write_text(drawn(allowed()))
