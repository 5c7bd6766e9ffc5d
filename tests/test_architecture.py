# SPDX-License-Identifier: Apache-2.0
"""The house's plan, read from the source: who may import whom."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "ggwarp"
FILES = sorted(PACKAGE.rglob("*.py"))

_BASE = {"types", "lie"}
ALLOWED: dict[str, set[str]] = {
    "types": set(),
    "lie": set(),
    "kernels": _BASE,
    "ops": _BASE | {"kernels"},
    "map": _BASE | {"kernels", "ops"},
    "objects": _BASE | {"kernels", "ops", "map", "io"},
    "io": _BASE,
    "datasets": _BASE | {"kernels"},
    "evaluation": _BASE | {"map"},
    "pipeline": _BASE | {"kernels", "ops", "map", "objects", "evaluation", "io"},
    "config": {"types", "io", "datasets", "pipeline"},
    "monocular": {"config", "pipeline"},
    "console": set(),
    "session": {"types", "kernels", "datasets", "evaluation", "pipeline", "console"},
    "precompile": {"kernels"},
    "run": {"types", "kernels", "io", "datasets", "pipeline", "config", "monocular", "console", "session"},
}
"""Room -> the rooms it may import (itself aside)."""


def _imports(path: Path) -> set[str]:
    """Return the full names of everything that ``path`` imports, at any depth of the code."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    room = _room(path)
    if room == "__init__":
        return
    assert room in ALLOWED, f"{room}: give it its place in ALLOWED"
    seen = {name.split(".")[1] for name in _imports(path) if name.startswith("ggwarp.")}
    assert seen - {room, "__version__"} <= ALLOWED[room]


def test_tracker_and_mapper_never_meet():
    for one, other in (("tracker", "mapper"), ("mapper", "tracker")):
        names = _imports(PACKAGE / "pipeline" / f"{one}.py")
        assert not any(name.startswith(f"ggwarp.pipeline.{other}") for name in names)


def test_the_device_is_read_on_its_current_stream():
    for room in ("map", "objects", "pipeline"):
        for path in (PACKAGE / room).glob("*.py"):
            assert ".numpy()" not in path.read_text(), f"{path}: kernels.streams.to_host(array) instead"


def test_only_ops_need_torch():
    users = {_room(p) for p in FILES if any(n.split(".")[0] == "torch" for n in _imports(p))}
    assert users <= {"ops", "evaluation"}, "evaluation: for LPIPS alone"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_are_one_room(path):
    lines = path.read_text().splitlines()
    assert lines[0] == "# SPDX-License-Identifier: Apache-2.0"
    assert len(lines) <= 330


def _loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*(m for m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_the_package_imports_light():
    loaded = _loaded_by("import ggwarp")
    assert not loaded & {"torch", "warp", "cv2", "skimage", "scipy", "rich", "tyro"}


def test_kernels_and_the_command_import_without_torch():
    modules = ", ".join(f"ggwarp.kernels.{p.stem}" for p in sorted((PACKAGE / "kernels").glob("[a-z]*.py")))
    loaded = _loaded_by(f"import {modules}")
    assert "warp" in loaded and not loaded & {"torch", "cv2", "skimage"}
    assert not _loaded_by("import ggwarp.run") & {"torch", "skimage", "scipy"}


def test_public_names_are_there():
    import ggwarp

    for name in ggwarp.__all__:
        assert getattr(ggwarp, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = ggwarp.nonsense
