# SPDX-License-Identifier: Apache-2.0
"""Tables as papers print them, the page, comparisons; every figure in them is one that was measured."""

import csv
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from ggwarp.suite.choosing import choose, write_choice
from ggwarp.suite.definition import Choice, SuiteError
from ggwarp.suite.reporting.comparison import compare, sign_flip_p
from ggwarp.suite.reporting.files import write_files
from ggwarp.suite.reporting.page import page
from ggwarp.suite.reporting.published import load_published
from ggwarp.suite.reporting.rows import number
from ggwarp.suite.reporting.writers import latex, markdown
from ggwarp.suite.results import Results, RunResult, load_results
from ggwarp.suite.suite_file import load_suite

REASON = "exit code 1: <b>50 % | of & $frames</b>"


def run(sequence: str, setting: str, seed: int = 0, status: str = "done", **metrics: float) -> RunResult:
    folder = f"runs/{sequence}/{setting}/seed-{seed}"
    reason = REASON if status == "failed" else ""
    return RunResult(sequence, setting, seed, status, reason, folder, 1, 10.0, 15.0, metrics)


def results_of(*runs: RunResult, **changes) -> Results:
    sequences, settings = (tuple(dict.fromkeys(getattr(r, n) for r in runs)) for n in ("sequence", "setting"))
    values = {"metrics": ("psnr", "ssim", "fps"), "sequences": sequences, "settings": settings} | changes
    return Results("trial", "A trial", runs=runs, **values)


@pytest.fixture
def results() -> Results:
    return results_of(
        run("room0", "@30", psnr=35.367, ssim=0.9412, fps=29.97),
        run("room1", "@30", psnr=37.8, ssim=0.957),
        run("room0", "@10", status="failed"),
        run("room1", "@10", status="not run"),
        published="gg-slam",
    )


def cells(text: str, system: str, metric: str) -> list[str]:
    """Return the cells of a row of a Markdown table, whose system is named in its first row alone."""
    found, name = [], ""
    for line in text.splitlines():
        parts = [part.strip() for part in line.strip("|").split(" | ")]
        name = parts[0] or name
        if len(parts) > 2 and name.startswith(system) and parts[1].startswith(metric):
            found.append(parts[2:])
    assert len(found) == 1
    return found[0]


def test_rows_are_the_paper_s(results: Results):
    text = markdown(results)
    assert cells(text, "ggwarp, @30", "PSNR ↑") == ["35.37", "37.80", "36.58"]
    assert cells(text, "ggwarp, @30", "SSIM") == [".941", ".957", ".949"]
    assert cells(text, "ggwarp, @30", "FPS") == ["29.97", "-", "-"], "no average of a part"
    assert cells(text, "ggwarp, @10", "PSNR") == ["failed", "not run", "-"]
    assert cells(text, "GG-SLAM, limited to 30 FPS", "PSNR") == ["32.77", "35.24", "34.01"], "of these two"
    assert "SGS-SLAM" not in text, "it prints an average of all eight alone"
    assert "GG-SLAM, table 1" in text and "2 of 4 runs are done" in text


def test_averages_alone_are_shown_beside_the_whole_table():
    eight = load_published("gg-slam").rows[0].sequences
    text = markdown(results_of(*(run(s, "@30", psnr=30.0) for s in eight), published="gg-slam"))
    assert cells(text, "SGS-SLAM", "PSNR") == ["-"] * 8 + ["34.66"]
    assert cells(text, "GG-SLAM, limited to 30 FPS", "PSNR")[-1] == "35.94"


def test_no_published_rows_beside_other_sequences(results: Results):
    other = results_of(run("kitchen", "@30", psnr=30.0), published="gg-slam")
    systems = re.findall(r"^\| ([^|]*?) \|", markdown(other), re.MULTILINE)
    assert not any("Point-SLAM" in system or "limited" in system for system in systems)


def test_means_have_their_spread():
    three = results_of(*(run("office", "fast", seed, psnr=30.0 + seed) for seed in range(3)))
    assert cells(markdown(three), "ggwarp, fast", "PSNR") == ["31.00 ± 1.00", "31.00"]
    assert r"31.00 $\pm$ 1.00" in latex(three) and "over 3 seeds" in markdown(three)


def test_a_seed_that_failed_is_told():
    two = results_of(run("office", "fast", 0, psnr=30.0), run("office", "fast", 1, status="failed"))
    assert cells(markdown(two), "ggwarp, fast", "PSNR") == ["30.00 (1 of 2 seeds)", "30.00"]


def test_numbers_are_printed_as_papers_do():
    assert [number(value, "ssim") for value in (0.9412, 0.0, 0.9999)] == [".941", ".000", "1.000"]
    assert [number(0.0161, "ate_rmse_cm"), number(0.5, "psnr"), number(7.0, "loops_closed")] == [
        "0.016", "0.50", "7.000"
    ]  # fmt: skip


def test_latex_is_balanced_and_escaped(results: Results):
    odd = results_of(run("a_b & c", "50 % #1", psnr=30.0))
    text = latex(odd)
    assert r"a\_b \& c" in text and r"50 \% \#1" in text
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {3}
    assert r"PSNR $\uparrow$" in latex(results) and "Not done" in markdown(results)


def test_csv_has_a_row_a_run_with_all_that_was_measured(results: Results, tmp_path):
    write_files(results, tmp_path)
    with (tmp_path / "suite.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["done", "done", "failed", "not run"]
    assert float(rows[0]["psnr"]) == 35.367 and rows[1]["fps"] == "" and rows[2]["reason"] == REASON


def test_results_are_read_as_they_were_written(results: Results, tmp_path):
    write_files(results, tmp_path)
    assert load_results(tmp_path) == results == load_results(tmp_path / "suite.json")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{}", "is not what ggwarp suite writes"),
        ('{"format": 9}', "is of another version"),
        ('{"format": 1, "runs": [{"a": 1}]}', "is not what ggwarp suite writes"),
        ("[", "is not JSON"),
        (None, "cannot be read"),
    ],
)
def test_results_that_are_none_are_one_line(tmp_path, content, says: str):
    if content is not None:
        (tmp_path / "suite.json").write_text(content)
    with pytest.raises(SuiteError, match=says):
        load_results(tmp_path)


class Reader(HTMLParser):
    """Gathers links, and holds that every tag is closed."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs) -> None:
        if tag not in ("meta",):
            self.open.append(tag)
        self.links += [value for name, value in attrs if name in ("href", "src")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_links_to_what_each_run_left(results: Results, tmp_path):
    (tmp_path / "runs/room0/@30/seed-0").mkdir(parents=True)
    (tmp_path / "runs/room0/@30/seed-0/report.html").touch()
    (tmp_path / "runs/room1/@30/seed-0").mkdir(parents=True)
    text = page(results, tmp_path)
    reader = Reader()
    reader.feed(text)
    assert not reader.open, "every tag is closed"
    runs = [link for link in reader.links if link.startswith("runs/")]
    assert runs.count("runs/room0/%4030/seed-0/report.html") == 1
    assert "runs/room1/%4030/seed-0/" in runs and "runs/room1/%4030/seed-0/report.html" not in runs
    assert not [link for link in reader.links if "://" in link] and "<script" not in text
    assert "<b>50" not in text and "&lt;b&gt;50 % | of &amp; $frames" in text
    assert text.index("1 failed") < text.index("Figures"), "failures first"


def pairs(shift: float, count: int, noise: float = 0.1) -> tuple[Results, Results]:
    """Return later and earlier results, whose PSNR differ by ``shift`` dB and by chance."""
    rng = np.random.default_rng(3)

    def made(mean: float) -> Results:
        values = rng.normal(mean, noise, count).tolist()
        runs = [run("office", "fast", seed, psnr=psnr, fps=5.0) for seed, psnr in enumerate(values)]
        return results_of(*runs, metrics=("psnr", "fps"))

    return made(30.0 + shift), made(30.0)


@pytest.mark.parametrize(
    ("shift", "count", "verdict"),
    [(1.0, 8, "better"), (-1.0, 8, "worse"), (0.0, 8, "no difference seen"), (1.0, 4, "no difference seen")],
)
def test_a_difference_counts_where_it_is_more_than_chance(shift: float, count: int, verdict: str):
    found = compare(*pairs(shift, count), "old")
    psnr, fps = found.rows
    assert (psnr.metric, psnr.pairs, psnr.verdict) == ("psnr", count, verdict)
    assert psnr.difference == pytest.approx(shift, abs=0.15)
    assert (fps.verdict, fps.p) == ("the same", 1.0)
    assert ("too few" in found.note) == (count < 6)


def test_p_is_the_share_of_turns_that_are_as_extreme():
    assert sign_flip_p(np.array([1.0, 2.0, 3.0])) == 2 / 8
    assert sign_flip_p(np.array([1.0, -2.0])) == 1.0
    assert sign_flip_p(np.array([1.0])) is None
    rng = np.random.default_rng(1)
    chance = [sign_flip_p(rng.normal(size=7)) for _ in range(200)]
    assert 0.0 < np.mean([p < 0.1 for p in chance]) < 0.17, "as often as it says"


def test_only_runs_that_both_have_are_compared():
    now = results_of(run("a", "x", psnr=1.0), run("b", "x", psnr=5.0), metrics=("psnr",))
    old = results_of(run("b", "x", psnr=4.0), run("c", "x", psnr=9.0), metrics=("psnr",))
    [row] = compare(now, old, "old").rows
    assert (row.pairs, row.before, row.now, row.p) == (1, 4.0, 5.0, None)


def candidates(**settings: tuple[float, float, float]) -> Results:
    return results_of(
        *(run("walk", name, psnr=p, fps=f, frames_lost=lost) for name, (p, f, lost) in settings.items())
    )


def test_the_fastest_near_the_best_is_chosen():
    found = candidates(slow=(30.0, 1.0, 0), good=(29.6, 3.0, 0), quick=(29.0, 9.0, 0), lossy=(29.9, 20.0, 4))
    for within, name in ((0.5, "good"), (1.0, "quick"), (0.0, "slow"), (0.39, "slow")):
        chosen = choose(found, Choice(within))
        assert (chosen.chosen.setting, chosen.best.setting, chosen.quality) == (name, "slow", "psnr")
    with pytest.raises(SuiteError, match="no setting was measured on every sequence"):
        choose(results_of(run("walk", "slow", status="failed")), Choice())


def test_a_choice_is_a_configuration(tmp_path):
    from ggwarp.config import load_config

    suite = load_suite("choose")
    names = [setting.name for setting in suite.settings]
    fps = {name: float(1 + (name == "fast, iterations 4")) for name in names}
    results = results_of(*(run("walk", name, heldout_psnr=30.0, psnr=1.0, fps=fps[name]) for name in names))
    write_choice(suite, choose(results, Choice()), tmp_path / "chosen.toml")
    config = load_config(tmp_path / "chosen.toml")
    assert (config.preset, config.slam.mapper.iterations, config.frames) == ("fast", 4, None)
    assert json.dumps("fast") in (tmp_path / "chosen.toml").read_text()
