# SPDX-License-Identifier: Apache-2.0
"""Figures of README and docs come from committed results of suites, and only from them."""

import re

import pytest

import results_page
from ggwarp.suite.results import load_results
from ggwarp.suite.suite_file import load_suite

COMMITTED = sorted(results_page.SUITES.glob("*.json"))


@pytest.mark.parametrize("page", results_page.PAGES, ids=lambda page: page.name)
def test_pages_have_the_figures_that_are_committed(page):
    text = page.read_text()
    assert results_page.written(text) == text, "python tools/results_page.py"
    assert (
        text.count("<!-- suite ")
        == text.count("<!-- end of suite -->")
        == len(results_page.BLOCK.findall(text))
    )


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.stem)
def test_committed_results_are_whole_and_of_the_suite_as_it_is(path):
    results = load_results(path)
    assert results.count("done") == len(results.runs) > 0, "nothing that was not run"
    own = path.with_suffix(".toml")
    suite = load_suite(str(own) if own.exists() else path.stem)
    assert [(run.sequence, run.setting, run.seed) for run in results.runs] == [
        (job.sequence, job.setting, job.seed) for job in suite.jobs()
    ]
    assert results.metrics == suite.metrics


def test_figures_stand_where_they_are_looked_for():
    text = "".join(page.read_text() for page in results_page.PAGES)
    used = set(re.findall(r"<!-- suite (\S+): ", text))
    assert used == {path.stem for path in COMMITTED} and len(used) > 0


def test_a_figure_that_is_changed_by_hand_is_seen():
    results = load_results(COMMITTED[0])
    block = f"<!-- suite {results.name}: table -->\n| PSNR | 99.9 |\n<!-- end of suite -->"
    assert "99.9" not in results_page.written(block)
    assert results_page.written(results_page.written(block)) == results_page.written(block)
