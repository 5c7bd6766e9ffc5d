# SPDX-License-Identifier: Apache-2.0
"""tools/benchmark.py: what its figures mean; never how large they are."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from benchmarking import gsplat_peer, kernels, machine, plots, scaling, system, tables, tracking
from benchmarking.endurance import memory
from benchmarking.inputs.clouds import Ours, grown, situation, small_gicp_or_none
from benchmarking.inputs.scene import (
    OBJECTS,
    covering_size,
    object_mask,
    scene_camera,
    scene_gaussians,
    scene_mapper,
)
from benchmarking.machine import Limits
from benchmarking.options import BenchmarkError, cpu_threads, image_size
from benchmarking.record import Check, Record, Section, read_record, write_record
from benchmarking.stages import RENDERING, Stages, efforts, view_load
from benchmarking.timing import Timing, Work, measure
from ggwarp.datasets import SyntheticOffice
from ggwarp.map.gaussian_map import PARAMETERS
from ggwarp.ops.reference.render import project as reference_project
from ggwarp.runtime import launch

SMALL = scene_camera(64, 48)


def small_scene(count: int = 400, *, identity: bool = True):
    size = covering_size(count, SMALL.width, SMALL.height)
    return scene_gaussians(count, SMALL, size=size, identity=identity)


def made_record(**changes) -> Record:
    machine_of = {"device": "cpu", "cpu": "some", "cores": 2, "system": "any", "versions": {"python": "3"}}
    machine_of |= {"commit": "abc", "date": "now", "load": 0.0}
    return Record("kernels", machine_of, {}, **changes)


def test_timing_is_interleaved_and_leaves_preparation_out():
    calls: list[str] = []
    works = {
        "a": Work(lambda: calls.append("a"), prepare=lambda: calls.append("p"), batch=2),
        "b": lambda: calls.append("b"),
    }
    times = measure(works, device="cpu", rounds=3)
    assert "".join(calls) == 4 * "paab", "one round unmeasured, three measured"
    assert [len(t.samples) for t in times.values()] == [3, 3]


def test_a_budget_ends_the_rounds_but_not_before_three():
    times = measure({"a": lambda: None}, device="cpu", rounds=50, budget_s=0.0)
    assert len(times["a"].samples) == 3


def test_medians_spread_and_ratios():
    time = Timing((1.0, 2.0, 3.0, 4.0, 10.0))
    assert time.median == 3.0 and time.best == 1.0
    assert time.spread == pytest.approx((4.0 - 2.0) / 3.0)
    # A slow moment hits both sides of a round: the ratio does not see it.
    assert Timing((2.0, 40.0, 2.0)).over(Timing((1.0, 20.0, 1.0))) == 2.0


def test_checks_compare_with_their_targets():
    assert Check("a", 1.0, "<=", 1.0).met and not Check("a", 1.1, "<=", 1.0).met
    assert Check("a", 11.0, ">=", 10.0).met and not Check("a", 9.0, ">=", 10.0).met
    assert Check("a", None, "<=", 1.0).met is None and Check("a", math.nan, "<=", 1.0).met is None


def test_a_record_survives_json(tmp_path: Path):
    checks = [Check("speed", 3.0, "<=", 2.0, "ms", "why"), Check("other", None, ">=", 1.0)]
    rows = [{"n": np.int64(3), "ms": np.float32(0.5), "bad": math.nan, "text": "x"}]
    record = made_record(checks=checks, sections=[Section("t", rows, "note")], notes=["said"])
    write_record(tmp_path / "deep" / "r.json", record)
    content = json.loads((tmp_path / "deep" / "r.json").read_text())
    assert [c["met"] for c in content["checks"]] == [False, None]
    assert content["machine"]["commit"] == "abc"
    back = read_record(tmp_path / "deep" / "r.json")
    assert back.checks == checks and back.notes == ["said"]
    assert back.section("t") == Section("t", [{"n": 3, "ms": 0.5, "bad": None, "text": "x"}], "note")


def test_the_terminal_shows_value_beside_target(capsys: pytest.CaptureFixture[str]):
    checks = [Check("a check", 3.0, "<=", 2.0, "ms"), Check("no value", None, "<=", 2.0)]
    record = made_record(checks=checks, sections=[Section("rows", [{"x": 1234, "y": None}])])
    tables.show(record, Console(width=120))
    lines = capsys.readouterr().out.splitlines()
    assert any("a check" in li and "3 ms" in li and "<= 2 ms" in li and "no" in li for li in lines)
    assert any("no value" in li and "not measured" in li for li in lines)
    assert any("1,234" in li and "-" in li for li in lines)


def test_the_machine_is_described_and_its_limits_bound_a_roofline():
    about = machine.describe("cpu")
    assert about["device"] == "cpu" and about["cores"] >= 1 and about["versions"]["numpy"] == np.__version__
    limits = Limits(copy=10.0, fma=100.0)
    assert limits.seconds(gflop=50.0, gigabytes=1.0) == 0.5, "arithmetic decides"
    assert limits.seconds(gflop=1.0, gigabytes=5.0) == 0.5, "traffic decides"
    assert limits.best(Limits(20.0, 50.0)) == Limits(20.0, 100.0)


def test_contributions_are_those_of_every_splat_at_every_pixel():
    mapper, frame = scene_mapper(small_scene(), SMALL, device="cpu")
    load = Stages(mapper, frame, SMALL).load
    host = mapper.map.to_host()
    rows = {n: torch.tensor(getattr(host, n), dtype=torch.float64) for n in PARAMETERS}
    p = reference_project(**rows, T_cw=torch.eye(4, dtype=torch.float64), camera=SMALL)
    order = np.argsort(p.depths.numpy())
    means, conics = p.means2d.numpy()[order], p.conics.numpy()[order]
    u, v = np.meshgrid(np.arange(SMALL.width), np.arange(SMALL.height))
    T, counted = np.ones(u.shape), 0
    for (x, y), (a, b, c, opacity) in zip(means, conics, strict=True):
        dx, dy = u - x, v - y
        alpha = np.minimum(0.99, opacity * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy))
        blended = (alpha >= 1.0 / 255.0) & (T >= 1e-4)
        counted += int(blended.sum())
        T[blended] *= 1.0 - alpha[blended]
    assert load.per_pixel == pytest.approx(counted / (SMALL.width * SMALL.height), rel=2e-3)
    assert load.contributions == pytest.approx(counted, rel=2e-3)


def test_the_scene_is_what_the_target_names():
    camera = scene_camera(160, 90)
    for count in (2500, 5000, 10_000):
        batch = scene_gaussians(count, camera, size=covering_size(count, 160, 90), identity=False)
        assert len(np.unique(batch.means[:, 2])) == count, "unique depths"
        mapper, _ = scene_mapper(batch, camera, device="cpu")
        load = view_load(mapper.map, camera)
        assert load.gaussians == count and load.visible > 0.99 * count
        assert 38.0 < load.per_pixel < 48.0
        assert load.pairs >= load.visible and load.pairs_per_splat == load.pairs / load.visible
    assert covering_size(20_000, 320, 180) == pytest.approx(2.0)


def test_an_iteration_leaves_the_scene_as_it_is(device: str):
    batch = small_scene()
    mapper, frame = scene_mapper(batch, SMALL, device=device)
    assert mapper.map.count == len(batch) and mapper.keyframe_indices == [0]
    assert len(np.unique(object_mask(SMALL))) == OBJECTS
    stages = Stages(mapper, frame, SMALL)
    for _ in range(3):
        mapper.iterate()
        for work in stages.works().values():
            work()
    assert mapper.synchronise() > 0.0, "there is something to fit"
    rows = mapper.map.to_host()
    for name in ("means", "log_scales", "opacity_logits", "colours", "identities"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(batch, name), err_msg=name)
    # Quaternions are normalised again.
    np.testing.assert_allclose(rows.quats, batch.quats, atol=1e-6)


def test_efforts_grow_with_what_they_count():
    mapper, _ = scene_mapper(small_scene(), SMALL, device="cpu")
    load = view_load(mapper.map, SMALL)
    few, many = (efforts(load, SMALL, channels, OBJECTS) for channels in (4, 20))
    forward = load.contributions * (32 + 2 * 20) / 1e9
    assert many["composite"].gflop == pytest.approx(forward)
    for name in RENDERING:
        assert many[name].gigabytes >= few[name].gigabytes > 0.0
    assert many["bin"] == few["bin"], "binning does not look at the channels"
    assert many["composite adjoint"].gigabytes > many["composite"].gigabytes


def test_kernels_reports_every_stage_beside_the_limits(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(kernels, "measure_limits", lambda device, threads: Limits(10.0, 100.0))
    options = kernels.KernelsOptions(device="cpu", quick=True, size="64x48", gaussians=400, rounds=3)
    before = launch.cpu_threads()
    record = kernels.run(options)
    assert launch.cpu_threads() == before
    section = record.section(kernels.STAGES)
    assert section is not None
    names = [row["stage"] for row in section.rows]
    assert names == ["project", "bin", "composite", "loss", "cross-entropy", "composite adjoint",
                     "project adjoint", "KL", "Adam"]  # fmt: skip
    scene = record.sections[0].rows[0]
    contributions = scene["contributions a pixel"] * 64 * 48
    for row in section.rows:
        assert row["of the limit %"] == pytest.approx(100.0 * row["least ms"] / row["ms"])
        if row["stage"] in RENDERING:
            assert row["ns/contribution"] == pytest.approx(1e6 * row["ms"] / contributions)
    targets = {c.name: c.target for c in record.checks}
    assert targets["20 channels against 4"] == 1.5
    assert targets["iteration / (forward + adjoint)"] == 1.6
    assert targets["cost of identity: gg-slam iteration / gs-icp's"] == 1.35
    assert "forward + adjoint x FMA peak" not in targets, "that target is for the issue's scene alone"
    assert any("gsplat was not compared" in note for note in record.notes)
    write_record(tmp_path / "k.json", record)
    assert len(read_record(tmp_path / "k.json").sections) == len(record.sections)


def test_exponents_are_those_of_the_data():
    sizes = [10, 100, 1000]
    assert scaling.exponent(sizes, [3.0 * n**0.7 for n in sizes]) == pytest.approx(0.7)
    assert math.isnan(scaling.exponent([5], [1.0]))


@pytest.fixture(scope="module")
def moment():
    return situation(SyntheticOffice(scale=0.2), 3, device="cpu")


def test_a_larger_map_is_the_same_map_to_the_frame(moment):
    larger = grown(moment.target, 3, device="cpu")
    assert larger.count == 3 * moment.target.count
    results = []
    for target in (moment.target, larger):
        work = tracking.tracker_work(moment, target, "cpu")
        work.prepare()
        first = work.run()
        work.prepare()
        assert np.array_equal(work.run().T_wc, first.T_wc), "each repeat starts from the same state"
        results.append(first)
    assert np.array_equal(results[0].T_wc, results[1].T_wc)
    assert not np.allclose(results[0].T_wc, moment.T_previous, atol=1e-4), "the frame has moved"


@pytest.mark.skipif(small_gicp_or_none() is None, reason="small_gicp is not installed")
def test_small_gicp_has_the_same_problem_and_the_same_answer(moment):
    record = made_record()
    rows, answer = tracking.beside(record, moment, 1, "cpu", 3)
    assert answer is not None and answer["apart mm"] < 1e-3 and answer["apart mrad"] < 1e-3
    assert answer["matches"] == answer["small_gicp's matches"]
    by_name = {row["what"]: row for row in rows}
    frame = by_name["frame"]["ours ms"]
    assert frame >= 0.9 * by_name["registration"]["ours ms"]
    registration, step = by_name["registration"]["ours ms"], by_name["a linearisation"]["ours ms"]
    assert registration / step == pytest.approx(answer["linearisations"])
    assert [c.target for c in record.checks] == [1.0]


def test_our_ellipses_are_the_observation_s_axes(moment):
    covariances = Ours(moment, "cpu").fit_ellipses().numpy()
    scales = np.linalg.eigvalsh(covariances)[:, ::-1]
    np.testing.assert_allclose(np.sqrt(np.maximum(scales, 0.0)), moment.seen.scales.numpy(), atol=2e-4)


def test_gsplat_is_given_the_scene_that_we_render():
    mapper, _ = scene_mapper(small_scene(), SMALL, device="cpu")
    peer = gsplat_peer.GsplatScene(mapper, SMALL, "cpu")
    host = mapper.map.to_host()
    rows = {n: torch.tensor(getattr(host, n), dtype=torch.float64) for n in PARAMETERS}
    ours = reference_project(**rows, T_cw=torch.eye(4, dtype=torch.float64), camera=SMALL)
    torch.testing.assert_close(peer.features.double(), ours.features, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(peer.opacities.double(), ours.conics[:, 3], atol=1e-5, rtol=1e-5)
    # Its image plane starts half a pixel before ours.
    projected = (peer.Ks[0] @ peer.means[:, :, None])[..., 0]
    centres = projected[:, :2] / projected[:, 2:] - 0.5
    torch.testing.assert_close(centres.double(), ours.means2d, atol=1e-3, rtol=1e-5)


def test_agreement_tells_noise_from_a_difference():
    rng = np.random.default_rng(0)
    image, gradient = rng.normal(size=(4, 8, 8)), rng.normal(size=(9, 3))
    ours = gsplat_peer.Rendering(image, {"means": gradient})
    near = gsplat_peer.Rendering(image * (1 + 1e-5), {"means": gradient * (1 + 1e-4)})
    far = gsplat_peer.Rendering(image, {"means": -gradient})
    assert [row["agrees"] for row in gsplat_peer.agreement(ours, near)] == [True, True]
    rows = gsplat_peer.agreement(ours, far)
    assert [row["agrees"] for row in rows] == [True, False]
    assert rows[1]["cosine"] == pytest.approx(-1.0) and rows[1]["relative L2"] == pytest.approx(2.0)


def test_options_that_cannot_be_used_are_refused_in_one_line():
    assert image_size("320x180") == (320, 180)
    for text in ("320", "axb", "8x8"):
        with pytest.raises(BenchmarkError, match="--size"):
            image_size(text)
    with cpu_threads(1):
        assert launch.cpu_threads() == 1


def test_plots_are_drawn_or_the_remedy_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rows = [{"stage": "project", "ms": 1.0, "least ms": 0.1}, {"stage": "bin", "ms": 2.0, "least ms": 0.2}]
    record = made_record(sections=[Section(kernels.STAGES, rows)])
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "matplotlib", None)
        with pytest.raises(plots.NoMatplotlibError, match=r"ggwarp\[benchmark\]"):
            plots.draw(record, tmp_path / "k")
    pytest.importorskip("matplotlib")
    assert plots.draw(record, tmp_path / "k") == [tmp_path / "k.png"]
    assert (tmp_path / "k.png").read_bytes().startswith(b"\x89PNG")


def test_every_subcommand_has_its_plot(tmp_path: Path):
    pytest.importorskip("matplotlib")
    named = {"sequence": "office", "preset": "fast", "cap": "5"}
    grown_rows = [{"map points": n, "frame ms": 9.0, "map, once a keyframe, ms": n / 1e3} for n in (10, 100)]
    beside = [{"what": "frame", "threads": 1, "ours ms": 1.0, "small_gicp ms": 2.0}]
    sizes = [{"Gaussians": n, "pixels": n, "ms": n / 7.0} for n in (10, 100)]
    growth = Section(tracking.GROWTH, grown_rows)
    scales = [Section(t, sizes) for t in (scaling.COVERED, scaling.SAME_SIZE, scaling.PIXELS)]
    runs = [
        Section(system.SPEED, [{**named, "FPS": 4.0}]),
        Section(system.STAGES, [{**named, "tracking %": 30.0, "mapping %": None, "rest %": 5.0}]),
        Section(system.QUALITY, [{**named, "PSNR": 30.0}]),
    ]
    sections = {"tracking": [Section(tracking.BESIDE, beside), growth], "scaling": [*scales, growth]}
    columns = (
        "resident MB",
        "images in memory MB",
        "in the file MB",
        "Gaussians",
        "Gaussians in memory",
        "trackable points",
    )
    course = [dict.fromkeys(("frames", *columns, "tracking ms", "mapping ms"), k) for k in (10, 20)]
    sections |= {"system": runs, "memory": [Section(memory.COURSE, course)]}
    for name, content in sections.items():
        record = made_record(sections=content)
        record.benchmark = name
        assert plots.draw(record, tmp_path / name) == [tmp_path / f"{name}.png"]
        record.sections = []
    assert plots.draw(record, tmp_path / "nothing") == [], "no run, no picture"
