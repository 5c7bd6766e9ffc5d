# SPDX-License-Identifier: Apache-2.0
"""tools/gpu_day: its cases run on a CPU, where results must agree with themselves."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from ggwarp import open_dataset
from gpu_day import check, frame_profile
from gpu_day.cases import CASES, TOLERANCES
from gpu_day.office_sequence import main as write_office

SCRIPTS = Path(__file__).parents[2] / "tools" / "gpu_day"


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    path = tmp_path_factory.mktemp("gpu_day") / "reference.npz"
    assert check.main(["save", str(path), "--device", "cpu"]) == 0
    return path


def test_what_is_saved_compares_equal(reference, capsys):
    assert set(TOLERANCES) <= set(CASES)
    only = [name for name in CASES if name != "office"]
    assert check.main(["compare", str(reference), "--device", "cpu", "--only", *only]) == 0
    said = capsys.readouterr().out
    assert said.count("ok  ") == len(only) and "DIFF" not in said
    assert {name.split(".")[0] for name in np.load(reference).files} == set(CASES)


def test_a_difference_and_a_failure_are_counted(reference, tmp_path, capsys, monkeypatch):
    spoilt = dict(np.load(reference))
    spoilt["loss.d_image"] = spoilt["loss.d_image"] * 1.01
    spoilt["render_4.median_depth"] = spoilt["render_4.median_depth"][:-1]
    np.savez(tmp_path / "spoilt.npz", **spoilt)

    def broken(device):
        raise RuntimeError("no such kernel")

    monkeypatch.setitem(CASES, "observation", broken)
    names = ["loss", "render_4", "observation", "registration"]
    assert check.main(["compare", str(tmp_path / "spoilt.npz"), "--device", "cpu", "--only", *names]) == 3
    said = capsys.readouterr().out
    assert "DIFF loss" in said and "d_image: 9.90e-03" in said and "losses: 0.00" in said
    assert "DIFF render_4" in said and "median_depth: shape" in said
    assert "FAIL observation: RuntimeError: no such kernel" in said and "ok   registration" in said


def test_mapping_is_repeatable(capsys):
    assert check.main(["repeatable", "--device", "cpu"]) == 0
    assert "to the bit" in capsys.readouterr().out
    assert check.main(["two-threads", "--device", "cpu"]) == 0


def test_the_office_in_files_is_a_data_set(tmp_path):
    assert write_office(["2", "0.1", str(tmp_path / "office"), "cpu"]) == 0
    dataset = open_dataset(str(tmp_path / "office"), data_root=tmp_path)
    assert len(dataset) == 2 and dataset.has_depth and dataset.has_masks
    assert dataset[1].T_wc is not None and write_office([]) == 2


def test_a_frame_is_taken_apart(tmp_path, capsys):
    assert write_office(["14", "0.1", str(tmp_path / "office"), "cpu"]) == 0
    arguments = [str(tmp_path / "office"), "--warm", "2", "--frames", "3", "--device", "cpu"]
    assert frame_profile.main(arguments) == 0
    said = capsys.readouterr().out
    assert "frame: tracking: median" in said and "keyframe: mapping: median" in said
    assert "Ordered by: internal time" in said and "Ordered by: cumulative time" in said
    assert "ms a frame in all" in said


@pytest.mark.parametrize("script", sorted(SCRIPTS.glob("*.sh")), ids=lambda p: p.name)
def test_the_scripts_parse(script):
    subprocess.run(["bash", "-n", script], check=True)
    if shutil.which("shellcheck"):
        subprocess.run(["shellcheck", "--severity=warning", script], check=True)
    assert not [word for word in script.read_text().split() if word.startswith("tests/") and not _there(word)]


def _there(word):
    return (SCRIPTS.parents[1] / word.strip("\"';")).exists()
