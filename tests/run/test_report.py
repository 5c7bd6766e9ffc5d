# SPDX-License-Identifier: Apache-2.0
"""``report.html`` of six kinds of runs: whole, small, and quiet in a browser."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import re
import shutil
import signal
from html.parser import HTMLParser
from pathlib import Path

import pytest

from browser import opened
from ggwarp import run, saving, session
from ggwarp.report.__main__ import main as report_main
from ggwarp.types import Verdict

MOST_BYTES = 5_000_000
RUN = ["--seq", "room9", "--device", "cpu", "--out", "o", "-q"]
SECTIONS = (
    "Path",
    "Frames and renders",
    "Frame by frame",
    "What the recording was taken for",
    "All figures",
    "Versions",
)
KINDS = ("whole", "no masks", "no truth", "mono", "lost frames", "interrupted", "failed evaluation")


class _Page(HTMLParser):
    """Gathers what a page refers to, and whether its tags fit together."""

    VOID = ("meta", "link", "img", "input", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("script", "style"):
            self.text.append(data)


def checked(folder: Path) -> str:
    """Return what the report of ``folder`` says, having looked at its form."""
    data = (folder / "report.html").read_bytes()
    assert len(data) <= MOST_BYTES
    page = _Page(data.decode())
    assert page.open == [] and all(ref.startswith("data:") for ref in page.references), "one file, no network"
    return " ".join(page.text)


def make(kind: str, scene: Path, fake, monkeypatch) -> int:
    """Make a run of ``kind`` in ``o``; return its exit code."""
    options: list[str] = []
    if kind == "no masks":
        shutil.rmtree(scene / "object_mask")
    elif kind == "no truth":
        (scene / "traj.txt").unlink()
    elif kind == "mono":
        options = ["--mono"]
    elif kind == "lost frames":
        whole = fake._report

        def lost(slam, frame, iterations):
            step = whole(slam, frame, iterations)
            if frame.index not in (2, 3):
                return step
            return dataclasses.replace(step, verdict=Verdict.LOST, reason="<b>too & few</b> points")

        monkeypatch.setattr(fake, "_report", lost)
    elif kind == "interrupted":

        def interrupt(index):
            if index == 3:
                os.kill(os.getpid(), signal.SIGINT)

        monkeypatch.setattr(fake, "on_map", staticmethod(interrupt))
    elif kind == "failed evaluation":

        def broken(*arguments, **options):
            raise OSError(5, "Input/output error", "here")

        monkeypatch.setattr(session, "compare", broken)
    with monkeypatch.context():
        return run.main([*RUN, *options])


@pytest.mark.parametrize("kind", KINDS)
def test_every_run_has_a_report(kind: str, scene: Path, fake, monkeypatch) -> None:
    code = make(kind, scene, fake, monkeypatch)
    assert code == {"interrupted": 130, "failed evaluation": 1}.get(kind, 0)
    said, metrics = checked(Path("o")), json.loads(Path("o/metrics.json").read_text())
    assert f"{metrics['tracking_keyframes'] + metrics['mapping_keyframes']} keyframes" in said
    for section in SECTIONS:
        assert section in said, section
    expected = {
        "whole": "mIoU",
        "no masks": "no masks to compare with",
        "no truth": "no truth",
        "mono": "sim3",
        "lost frames": "frame 2 lost: <b>too & few</b> points",
        "interrupted": "The run was interrupted",
        "failed evaluation": "evaluation failed: here: Input/output error",
    }[kind]
    assert expected in said
    pictures = (Path("o") / "pictures").is_dir()
    assert pictures == (kind not in ("interrupted", "failed evaluation"))
    assert ("No pictures" in said) != pictures
    assert ("lost" in said.split("Frames and renders")[0].split("Path")[1]) == (kind == "lost frames")


def test_warnings_of_the_terminal_are_in_it_once(scene: Path, fake, monkeypatch, capsys) -> None:
    whole = fake._report

    def warned(slam, frame, iterations):
        logging.getLogger("ggwarp").warning("the lens <i>is</i> dusty")
        lost = Verdict.LOST if frame.index == 2 else Verdict.CONVERGED
        return dataclasses.replace(whole(slam, frame, iterations), verdict=lost, reason="no points")

    monkeypatch.setattr(fake, "_report", warned)
    assert run.main(RUN) == 0
    warnings = json.loads(Path("o/metrics.json").read_text())["warnings"]
    assert warnings.count("the lens <i>is</i> dusty") == 1 and "frame 2 lost: no points" in warnings
    assert [line for line in capsys.readouterr().err.splitlines() if "dusty" not in line] == [
        f"warning: {line}" for line in warnings if "dusty" not in line
    ]
    said = checked(Path("o"))
    assert said.count("the lens <i>is</i> dusty") == said.count("frame 2 lost: no points") == 1


def test_a_report_that_cannot_be_written_costs_nothing_else(scene: Path, fake, monkeypatch, capsys) -> None:
    def broken(folder):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(saving, "write_report", broken)
    assert run.main(RUN) == 1
    assert "writing the report failed: ZeroDivisionError: a bug" in capsys.readouterr().err
    assert {"map.ply", "metrics.json", "frames.csv", "trajectory.txt"} <= {
        p.name for p in Path("o").iterdir()
    }
    [failure] = json.loads(Path("o/metrics.json").read_text())["failures"]
    assert failure.startswith("writing the report failed")


def test_it_is_made_anew_whatever_is_missing_or_damaged(scene: Path, fake, capsys) -> None:
    assert run.main(RUN) == 0
    before = (Path("o") / "report.html").read_text()
    (Path("o") / "report.html").unlink()
    assert report_main(["o"]) == 0
    assert (Path("o") / "report.html").read_text() == before
    for name in (
        "metrics.json",
        "map.ply",
        "view.json",
        "objects.json",
        "camera.json",
        "config.toml",
        "frames.csv",
    ):
        (Path("o") / name).write_bytes(b"\xff[nonsense")
        assert report_main(["o"]) == 0
        said = checked(Path("o"))
        assert re.search(rf"Not in this report: (--config )?o/{name}", said) or name == "frames.csv", name
    for name in (
        "metrics.json",
        "map.ply",
        "trajectory_live.txt",
        "trajectory_gt.txt",
        "objects.json",
        "frames.csv",
    ):
        (Path("o") / name).unlink()
    shutil.rmtree("o/pictures")
    assert report_main(["o"]) == 0
    assert "There is no metrics.json" in checked(Path("o"))
    capsys.readouterr()
    for folder in ("nowhere", "data"):
        assert report_main([folder]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"ggwarp: {folder}: ")


def test_several_runs_are_compared(scene: Path, fake, monkeypatch) -> None:
    assert run.main(RUN) == 0
    assert run.main(["--seq", "room9", "--device", "cpu", "--out", "p", "-q", "--refine", "3"]) == 0
    assert report_main(["o", "p", "--out", "both.html"]) == 0
    data = Path("both.html").read_text()
    page = _Page(data)
    said = " ".join(page.text)
    assert page.open == [] and len(data) < MOST_BYTES and all(r.startswith("data:") for r in page.references)
    assert "Headline" in said and "The same frames" in said and re.search(r"--refine\s+0\s+3", said)
    assert data.count("data:image/jpeg") == 9, "three frames: recorded, and by each run"


class TestInABrowser:
    """What only a browser can tell."""

    def test_nothing_is_said_on_the_console(self, scene: Path, fake, monkeypatch, tmp_path: Path) -> None:
        frames = []
        for kind in KINDS:
            with monkeypatch.context() as patched:
                if not scene.is_dir():
                    shutil.copytree(tmp_path / "kept", scene)
                elif not (tmp_path / "kept").exists():
                    shutil.copytree(scene, tmp_path / "kept")
                make(kind, scene, fake, patched)
            shutil.rmtree(scene)
            shutil.move("o", kind)
            frames.append(f'<iframe src="{kind}/report.html"></iframe>')
        page = tmp_path / "all.html"
        page.write_text("".join(frames))
        _, console = opened(page, tmp_path / "browser")
        assert console == []
        page.write_text("".join(frames) + "<script>nonsense()</script>")
        _, console = opened(page, tmp_path / "browser")
        assert console and "nonsense" in console[0], "an error would be seen"

    def test_its_buttons_work(self, scene: Path, fake, tmp_path: Path) -> None:
        assert run.main(RUN) == 0
        report = Path("o/report.html")
        actions = """{
            const stage = document.querySelector(".stage"), said = {};
            const [under, over] = stage.querySelectorAll("img");
            said.first = under.src !== over.src;
            const before = under.src;
            document.querySelectorAll(".strip button")[3].click();
            said.changed = under.src !== before;
            document.querySelector('.modes button[value="depth"]').click();
            said.mode = stage.querySelector(".tag.right").textContent;
            const slider = stage.querySelector("input");
            slider.value = 25; slider.dispatchEvent(new Event("input"));
            said.wiped = over.style.clipPath;
            document.getElementById("theme").click();
            said.theme = document.documentElement.dataset.theme;
            document.getElementById("boxes").click();
            said.boxes = getComputedStyle(document.querySelector(".box")).display;
            const chart = document.querySelector(".chart svg"), box = chart.getBoundingClientRect();
            chart.dispatchEvent(new PointerEvent("pointermove", {clientX: box.right, clientY: box.top + 5}));
            said.value = document.querySelector(".chart output").textContent;
            said.wide = document.documentElement.scrollWidth <= innerWidth;
            document.body.dataset.said = JSON.stringify(said);
        }"""
        page = report.read_text().replace("</body>", f"<script>{actions}</script></body>")
        report.write_text(page)
        document, console = opened(report.resolve(), tmp_path / "browser")
        assert console == []
        match = re.search(r'data-said="([^"]*)"', document)
        assert match, "the script did not come to its end"
        said = match[1].replace("&quot;", '"')
        assert '"mode":"depth"' in said and '"changed":true' in said and '"first":true' in said
        assert "inset(0px 75% 0px 0px)" in said and '"theme":"dark"' in said and '"boxes":"inline"' in said
        assert '"value":"5: tracking 1, mapping 2 ms"' in said and '"wide":true' in said
