# SPDX-License-Identifier: Apache-2.0
"""Suites from their files: what is run, and what is refused in one line."""

from pathlib import Path

import pytest

from ggwarp.config.command_line import parse
from ggwarp.suite.definition import SHIPPED, SuiteError
from ggwarp.suite.reporting.published import load_published
from ggwarp.suite.suite_file import load_suite, suite_of

SUITE = """
title = "Mine"
seeds = [3, 4]
metrics = ["psnr", "fps"]

[options]
frames = "0:100"
loops = false

[sequences]
office = {}
kitchen = { seq = "scans/kitchen", frames = "0:50" }

[settings.fast]
preset = "fast"

[grid]
mapper.iterations = [2, 5]
fps = [30.0, "uncapped"]

[resources]
cpus = 2
"""
BASE = {"sequences": ["office"]}


def test_runs_are_sequences_times_settings_times_seeds(tmp_path: Path):
    path = tmp_path / "mine.toml"
    path.write_text(SUITE)
    suite = load_suite(str(path))
    jobs = suite.jobs()
    assert (suite.name, suite.title, len(jobs)) == ("mine", "Mine", 2 * 5 * 2)
    assert [setting.name for setting in suite.settings][:3] == [
        "fast",
        "iterations 2, fps 30.0",
        "iterations 2, fps uncapped",
    ]
    assert jobs[0].name == "office/fast/seed-3" and jobs[1].name == "kitchen/fast/seed-3"
    assert jobs[2].name == "office/iterations_2_fps_30.0/seed-3"
    assert len({job.name for job in jobs}) == len(jobs) and jobs[0].resources.cpus == 2


def test_a_job_s_options_are_the_command_s(tmp_path: Path):
    path = tmp_path / "mine.toml"
    path.write_text(SUITE)
    office, kitchen = load_suite(str(path)).jobs()[2:4]
    run = parse(["--seq", office.seq, *office.arguments]).run
    assert (run.frames, run.slam.loops, run.fps) == ("0:100", False, 30.0)
    assert (run.slam.mapper.iterations, run.slam.mapper.seed, run.built_in.seed) == (2, 3, 3)
    run = parse(["--seq", kitchen.seq, *kitchen.arguments]).run
    assert (run.seq, run.frames, run.built_in.seed) == ("scans/kitchen", "0:50", 0), (
        "a sequence's own goes first"
    )


@pytest.mark.parametrize("name", sorted(path.stem for path in SHIPPED.glob("*.toml")))
def test_every_run_of_shipped_suites_is_one_that_the_command_takes(name: str):
    suite = load_suite(name)
    for job in {job.arguments: job for job in suite.jobs()}.values():
        assert parse(["--seq", job.seq, *job.arguments]).run.seq == job.seq
    if suite.published:
        [*_, row] = load_published(suite.published).rows
        assert set(row.values["psnr"]) == {sequence.name for sequence in suite.sequences}


def test_shipped_suites_are_the_papers():
    assert {path.stem for path in SHIPPED.glob("*.toml")} == {
        "replica",
        "tum",
        "scannet",
        "built-in",
        "choose",
    }
    assert len(load_suite("replica").jobs()) == 8 * 4
    assert len(load_suite("built-in").jobs()) == 12


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({}, 'sequences is missing; such as sequences = ["office0"]'),
        (BASE | {"setings": {}}, "unknown key 'setings' (did you mean settings?)"),
        ({"sequences": []}, "sequences = [], but a list of names is needed"),
        ({"sequences": {"a": 3}}, "[sequences.a] = 3, but a table is needed"),
        ({"sequences": {"a": {"seq": 3}}}, "[sequences.a]: seq = 3, but str is needed"),
        ({"sequences": ["webcam:0"]}, "webcam:0: live frames come once; name a recording"),
        (BASE | {"seeds": [0, 0]}, "seeds = [0, 0], but different whole numbers from 0 are needed"),
        (BASE | {"metrics": ["pnsr"]}, "no run measures 'pnsr' (did you mean psnr?)"),
        (BASE | {"options": {"scale": 2.0}}, "[options]: --scale 2: give a number above 0 and at most 1"),
        (BASE | {"settings": {"x": {"preset": "fst"}}}, "[settings.x]: --preset fst: no such preset"),
        (BASE | {"settings": {"x": {"mapper": {"iteratons": 2}}}}, "unknown key 'mapper.iteratons'"),
        (BASE | {"settings": {"x": {"out": "a"}}}, "[settings.x]: out is no option here; every run has"),
        (BASE | {"settings": {"x": {"mapper": {"seed": 2}}}}, "mapper.seed is no option here; list seeds"),
        (BASE | {"settings": {"a/b": {}, "A_b": {}}}, "a/b and A_b would share a folder; rename one of them"),
        (BASE | {"grid": {"preset": "fast"}}, "[grid]: preset = 'fast', but a list of values is needed"),
        (BASE | {"resources": {"cpu": 1}}, "unknown key 'resources.cpu'; known here: cpus, gpus, memory_gb"),
        (BASE | {"resources": {"cpus": 0}}, "[resources]: cpus must be 1 or more"),
        (BASE | {"fetch": "cp a b"}, "say with {folder} where the sequence shall go"),
        (BASE | {"fetch": "cp 'a {folder}"}, "No closing quotation; it is split in words as a shell does"),
        (BASE | {"choice": {"within_db": -1.0}}, "within -1 dB: give a number of dB, 0 or more"),
        (BASE | {"published": "gg-slm"}, "no such rows (did you mean gg-slam?)"),
        ({"sequences": ["a"] * 2000, "grid": {"mapper.iterations": [*range(1000)]}}, "has 2,000,000 runs"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line_with_the_remedy(values, says: str):
    with pytest.raises(SuiteError) as error:
        suite_of(values, "mine")
    assert says in str(error.value) and "\n" not in str(error.value)


def test_the_file_is_named(tmp_path: Path):
    path = tmp_path / "mine.toml"
    path.write_text("seeds = 3")
    for text, says in (("seeds = 3", "sequences is missing"), ("a = [", "mine.toml: ")):
        path.write_text(text)
        with pytest.raises(SuiteError) as error:
            load_suite(str(path))
        assert str(error.value).startswith(str(path)) and says in str(error.value)
    with pytest.raises(SuiteError, match=r"replca: no such file \(did you mean replica\?\); name a"):
        load_suite("replca")


def test_published_rows_agree_with_the_paper_s_own_averages():
    """Its table 2 prints the averages of its rows of table 1; so a slip of the pen here would be seen."""
    rows = {row.system: row for row in load_published("gg-slam").rows}
    own = rows["GG-SLAM, limited to 30 FPS"]
    averages = {metric: own.average(metric, own.sequences) for metric in ("psnr", "ssim", "lpips", "fps")}
    assert averages == pytest.approx({"psnr": 35.94, "ssim": 0.959, "lpips": 0.072, "fps": 29.97}, abs=6e-3)
    assert own.average("psnr", ["room0", "room1"]) == pytest.approx(34.005)
    assert rows["SGS-SLAM"].average("psnr", own.sequences) == 34.66
    assert rows["SGS-SLAM"].average("psnr", ["room0"]) is None, "nothing is printed of one scene"
    assert rows["GS-SLAM"].values["fps"] == {"room0": 8.34}
    assert rows["GS-SLAM"].average("fps", own.sequences) is None, "nor is there an average of a part"


def test_a_folder_does_not_hide_a_shipped_suite(tmp_path: Path, monkeypatch):
    """Such as the one that an earlier start was told to write to."""
    monkeypatch.chdir(tmp_path)
    Path("built-in").mkdir()
    assert load_suite("built-in").title == "Built-in scenes"


def test_public_names_are_there():
    import ggwarp.suite

    for name in ggwarp.suite.__all__:
        assert getattr(ggwarp.suite, name) is not None
