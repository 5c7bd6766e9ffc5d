# SPDX-License-Identifier: Apache-2.0
"""Each of examples/ runs, with small settings, and reads as a tutorial."""

import importlib.util
import io
from pathlib import Path

import pytest

from ggwarp import load_run
from ggwarp.datasets import KINDS
from ggwarp.datasets.live.stream import open_stream
from ggwarp.pipeline.tracking.tracker import TRACKERS

EXAMPLES = Path(__file__).parents[1] / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda p: p.stem)
def test_an_example_is_short_and_tested(path):
    lines = path.read_text().splitlines()
    assert len(lines) < 60 and f"python examples/{path.name}" in lines[3]
    assert f'example("{path.stem}")' in Path(__file__).read_text()


def test_own_loop(tmp_path, capsys):
    example("own_loop").main(tmp_path / "run", frames=3, scale=0.12)
    assert "frame 2: converged" in capsys.readouterr().out
    assert len(load_run(tmp_path / "run").poses) == 3


def test_train_one_image():
    training = example("train_one_image")
    assert training.main(count=400, steps=12, scale=0.05) < training.main(count=400, steps=1, scale=0.05)


def test_own_dataset(tmp_path, capsys):
    kinds = list(KINDS)
    try:
        example("own_dataset").main(tmp_path / "own", frames=3, scale=0.1)
    finally:
        KINDS[:] = kinds
    assert capsys.readouterr().out.split() == 3 * ["converged"]


def test_own_tracker(capsys):
    trackers = dict(TRACKERS)
    try:
        example("own_tracker").main(frames=3, scale=0.1)
    finally:
        TRACKERS.clear()
        TRACKERS.update(trackers)
    assert "frame 2: converged" in capsys.readouterr().out


def test_edit_objects(tmp_path, capsys):
    example("edit_objects").main(tmp_path, frames=3, scale=0.15)
    assert "poster removed" in capsys.readouterr().out
    before, after = load_run(tmp_path / "before"), load_run(tmp_path / "after")
    assert len(after.edits) == 3 and before.find("poster").count > 0
    assert "poster" not in [record.name for record in after.objects]


def test_send_frames():
    pipe = io.BytesIO()
    example("send_frames").main(pipe, "office", frames=2, scale=0.1)
    pipe.seek(0)
    dataset = open_stream(pipe)
    assert dataset.camera.width == 120
    for i in range(2):
        assert (dataset[i].depth > 0).all()
