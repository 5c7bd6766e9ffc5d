# SPDX-License-Identifier: Apache-2.0
"""What the papers name is there: functions, files, options; pages that tools write are up to date."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import architecture_graph
import ggwarp
import options_page
from ggwarp.config.options import option_table

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
STRANGERS_QUESTIONS = {
    "relocalisation": "pipeline/tracking/relocalisation.py",
    "mask association": "objects/masks/association.py",
    "keyframe choice": "pipeline/tracking/keyframe_policy.py",
    "the loss of eq. (5)": "kernels/losses/rgbd.py",
    "hole filling": "editing/inpaint/filling.py",
    "the hash of the neighbour search": "kernels/registration/hash_grid.py",
    "the pose Jacobian": "kernels/raster/project_adjoint.py",
}

pages = pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)


@cache
def names_in(path):
    """Names of the functions, classes and methods that a file defines; a method as Class.method."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        found.add(getattr(node, "name", ""))
        if isinstance(node, ast.ClassDef):
            found |= {
                f"{node.name}.{inner.name}" for inner in node.body if isinstance(inner, ast.FunctionDef)
            }
    return found


@pages
def test_functions_and_files_that_a_page_names_are_there(page):
    spans = re.findall(r"`([^`\n]+)`", page.read_text())
    for path, name in (s.split(":", 1) for s in spans if re.fullmatch(r"[\w/]+\.py:[\w.]+", s)):
        assert name in names_in(ROOT / "ggwarp" / path), f"{path}:{name}"
    for path in (s for s in spans if re.fullmatch(r"[\w./]+/[\w.]+\.(py|sh|md)|[\w/]+/", s)):
        bases = [
            ROOT,
            ROOT / "ggwarp",
            ROOT / "ggwarp/datasets",
            ROOT / "ggwarp/kernels",
            *(ROOT / "ggwarp/pipeline").glob("*/"),
        ]
        places = ["renders/", "color/", "rgb/", "images/", "depth/", "Replica/", "TUM/", "object_mask/"]
        assert path in places or any((base / path).exists() for base in bases), path


@pages
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
        assert (page.parent / target).exists(), target


def test_method_names_a_function_for_every_equation():
    text = (ROOT / "docs/method.md").read_text()
    assert {int(n) for n in re.findall(r"\\tag\{(\d+)\}", text)} == {1, 2, 5, 6, 7, 8, 9, 10}
    assert len(re.findall(r"`[\w/]+\.py:[\w.]+`", text)) > 60


def test_a_stranger_finds_seven_things_within_two_clicks():
    """README -> architecture -> the row; and the path says it by itself."""
    assert "docs/architecture.md" in (ROOT / "README.md").read_text()
    text = (ROOT / "docs/architecture.md").read_text()
    for what, path in STRANGERS_QUESTIONS.items():
        assert f"| {what} | `{path}` |" in text
        assert (ROOT / "ggwarp" / path).is_file()


def test_readme_is_a_page_with_a_picture_first():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 120
    assert any(line.startswith("![") for line in lines[:15])
    assert sum(line.startswith("python3 -m venv ") for line in lines) == 2


@pages
def test_options_that_a_page_names_are_there(page):
    flags = {option.flag for option in option_table()}
    text = page.read_text()
    wanted = set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*\.[a-z0-9.-]*[a-z0-9]", text))
    for line in re.findall(r"^(?:ggwarp run|python -m ggwarp\.run) (.*)", text, re.MULTILINE):
        wanted |= set(re.findall(r"--[a-z][a-z0-9.-]*", line.split("#")[0]))
    assert wanted - {"--help", "--help-all"} <= flags, sorted(wanted - flags)


def test_pages_that_tools_write_are_up_to_date():
    assert options_page.PAGE.read_text() == options_page.page(), "python tools/options_page.py"
    graph = architecture_graph.drawn(architecture_graph.allowed())
    assert architecture_graph.GRAPH.read_text() == graph, "python tools/architecture_graph.py"


def test_one_version():
    assert f"\nversion: {ggwarp.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    newest = re.findall(r"^## \[?([\w.]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    assert newest == ggwarp.__version__
    assert (ROOT / "ggwarp/py.typed").is_file()
