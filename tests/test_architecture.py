# SPDX-License-Identifier: Apache-2.0
"""The house's plan, read from the source: who may import whom, and how large a room may be."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "ggwarp"
FILES = sorted(PACKAGE.rglob("*.py"))
EVERY_FILE = [
    p for top in ("ggwarp", "tools", "tests", "examples") for p in sorted((ROOT / top).rglob("*.py"))
]

_VALUES = {"types", "geometry"}
_DEVICE = _VALUES | {"runtime", "kernels"}
_MAP = _DEVICE | {"solvers", "map"}
_SYSTEM = {"pipeline", "pipeline.tracking", "pipeline.loops", "pipeline.mapping"}
ALLOWED: dict[str, set[str]] = {
    "types": set(),
    "geometry": {"types"},
    "runtime": {"types"},
    "kernels": _VALUES | {"runtime"},
    "solvers": _DEVICE,
    "ops": _DEVICE | {"solvers"},
    "map": _DEVICE | {"solvers"},
    "io": _VALUES | {"map"},
    "objects": _MAP | {"io"},
    "datasets": _DEVICE | {"io"},
    "evaluation": _VALUES | {"runtime", "map", "io"},
    "pipeline.moving_pixels": _DEVICE,
    "pipeline.tracking": _MAP | {"pipeline.moving_pixels"},
    "pipeline.loops": _MAP | {"pipeline.tracking"},
    "pipeline.mapping": _MAP | {"objects", "pipeline.moving_pixels"},
    "pipeline": _MAP | {"objects", "io", "results", *_SYSTEM},
    "results": _VALUES | {"map", "io", "objects", "evaluation"},
    "editing": _MAP | {"io", "objects", "evaluation", "results"},
    "export": _MAP | {"io", "objects", "results", "editing", "datasets", "config"},
    "viewer": _MAP | {"io", "objects", "results", "editing", "config", "console", "datasets"},
    "report": _VALUES | {"map", "io", "objects", "evaluation", "results", "config"},
    "config": {"types", "geometry", "io", "datasets", "console", "results", *_SYSTEM},
    "console": {"io"},
    "messages": {"types", "io", "config", "console", "datasets", "results", "pipeline.loops"},
    "saving": {"types", "map", "console", "messages", "results", "report"},
    "checkpointing": {"runtime", "io", "datasets", "results", "config", "console", *_SYSTEM},
    "interruption": set(),
    "preparation": {"runtime", "map", "datasets", "results", "config", "console", *_SYSTEM},
    "session": {"types", "runtime", "io", "datasets", "evaluation", "results"}
    | {"config", "console", "interruption", "preparation", "messages", "saving", "checkpointing", *_SYSTEM}
    | {"viewer"},
    "run": {"io", "datasets", "config", "console", "interruption", "session", "results", "viewer"}
    | {"pipeline.loops"},
    "suite": {"runtime", "io", "datasets", "results", "config", "console", "interruption", "run"}
    | {"pipeline", "pipeline.tracking"},
    "commands": {"types", "geometry", "runtime", "io", "datasets", "evaluation", *_SYSTEM},
}  # fmt: skip
"""Room -> the rooms it may import (itself aside). A room is a folder and all in it, or a file at the top."""

LARGEST_FOLDER = 16
LONGEST_FILE = 330


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


def _room_of(name: str) -> str:
    """Return the room of the module or symbol ``name``, such as ``ggwarp.pipeline.mapping.mapper.Mapper``."""
    parts = name.split(".")[1:]
    two = ".".join(parts[:2])
    return two if two in ALLOWED else parts[0]


def _room(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return _room_of(".".join(p for p in parts if p != "__init__"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path: Path) -> None:
    if path.parent == PACKAGE and path.name in ("__init__.py", "__main__.py"):
        return
    room = _room(path)
    assert room in ALLOWED, f"{room}: give it its place in ALLOWED"
    seen = {_room_of(name) for name in _imports(path) if name.startswith("ggwarp.")}
    assert seen - {room, "__version__"} <= ALLOWED[room]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("pipeline.tracking", "pipeline.mapping"),
        ("pipeline.mapping", "pipeline.tracking"),
        ("pipeline.mapping", "pipeline.loops"),
        ("pipeline.loops", "pipeline.mapping"),
        ("pipeline.tracking", "pipeline.loops"),
        ("editing", "pipeline"),
        ("results", "pipeline"),
        ("pipeline.tracking", "objects"),
    ],
)
def test_what_never_meets(one: str, other: str) -> None:
    """Not through others, either."""
    reached, waiting = {one}, [one]
    while waiting:
        new = ALLOWED[waiting.pop()] - reached
        reached |= new
        waiting += new
    assert not {room for room in reached if room == other or room.startswith(f"{other}.")}


def test_the_device_is_read_on_its_current_stream() -> None:
    for room in ("map", "objects", "pipeline", "solvers", "editing", "export"):
        for path in (PACKAGE / room).rglob("*.py"):
            assert ".numpy()" not in path.read_text(), f"{path}: runtime.streams.to_host(array) instead"


def test_only_ops_need_torch() -> None:
    users = {_room(p) for p in FILES if any(n.split(".")[0] == "torch" for n in _imports(p))}
    assert users <= {"ops", "evaluation", "commands"}, "evaluation: for LPIPS alone; commands: segmenters"


@pytest.mark.parametrize("path", EVERY_FILE, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_are_one_room(path: Path) -> None:
    lines = path.read_text().splitlines()
    assert lines[0] == "# SPDX-License-Identifier: Apache-2.0"
    assert len(lines) <= LONGEST_FILE


def test_folders_hold_few_files_and_say_what_belongs_there() -> None:
    tops = [ROOT / top for top in ("ggwarp", "tools", "tests")]
    counts = Counter(path.parent for top in tops for path in top.rglob("*.py"))
    for folder, count in counts.items():
        assert count <= LARGEST_FOLDER, f"{folder}: {count} files"
    for folder in {path.parent for path in FILES}:
        purpose = ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""
        assert purpose.splitlines()[:1], f"{folder}: __init__.py does not say what belongs there"


def _loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*(m for m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_the_package_imports_light() -> None:
    loaded = _loaded_by("import ggwarp")
    assert not loaded & {"torch", "warp", "cv2", "skimage", "scipy", "rich", "tyro"}


def test_kernels_and_the_command_import_without_torch() -> None:
    files = sorted((PACKAGE / "kernels").rglob("[a-z]*.py"))
    modules = ", ".join(".".join(p.relative_to(ROOT).with_suffix("").parts) for p in files)
    loaded = _loaded_by(f"import {modules}")
    assert "warp" in loaded and not loaded & {"torch", "cv2", "skimage"}
    assert not _loaded_by("import ggwarp.run") & {"torch", "skimage", "scipy"}


def test_public_names_are_there() -> None:
    import ggwarp

    for name in ggwarp.__all__:
        assert getattr(ggwarp, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = ggwarp.nonsense


CREATORS = {"zeros", "empty", "full", "ones", "clone", "zeros_like", "empty_like", "ones_like", "from_numpy"}
READERS = {"numpy", "list", "to_host", "synchronize", "synchronize_device", "synchronize_stream"}
READS_A_COUNT_ON_THE_CPU = {"raster/tiles.py:_bin_on_cpu", "raster/project_adjoint.py:project_adjoint"}
"""On a CPU a launch is done when it returns, and reading waits for nothing."""


def _host_functions() -> list[tuple[str, ast.FunctionDef]]:
    """Return what of ``kernels`` runs on the host, by ``folder/file.py:function``."""
    found = []
    for path in sorted((PACKAGE / "kernels").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and "wp." not in "".join(
                map(ast.unparse, node.decorator_list)
            ):
                found.append((f"{path.relative_to(PACKAGE / 'kernels')}:{node.name}", node))
    return found


def test_launch_functions_allocate_nothing_and_wait_for_nothing() -> None:
    """What CONTRIBUTING.md says of kernels: ``allocate_*`` functions make arrays, and no result is read."""
    allocating, reading = set(), set()
    for name, function in _host_functions():
        for call in ast.walk(function):
            if not isinstance(call, ast.Call):
                continue
            called = ast.unparse(call.func)
            views = any(keyword.arg == "ptr" for keyword in call.keywords)
            if called in {f"wp.{creator}" for creator in CREATORS} or (called == "wp.array" and not views):
                allocating.add(name)
            if called.split(".")[-1] in READERS and called != "list":
                reading.add(name)
    places = {
        name for name in allocating if "allocate_" not in name and not name.startswith("workspaces.py:")
    }
    assert not places and len(allocating) > 3
    assert reading == READS_A_COUNT_ON_THE_CPU
