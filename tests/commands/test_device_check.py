# SPDX-License-Identifier: Apache-2.0
"""ggwarp doctor --gpu: devices that agree, and what is said of one that does not."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from ggwarp.commands import device_check, doctor
from ggwarp.commands.device_check import Agreement, DeviceRun, agreements


@pytest.fixture(scope="module")
def on_cpu() -> DeviceRun:
    return device_check.run_on("cpu", device_check.office_frames()[:3])


def test_a_device_agrees_with_itself(on_cpu: DeviceRun) -> None:
    found = {a.what: a for a in agreements(on_cpu, on_cpu)}
    assert set(found) == set(device_check.LIMITS) and all(a.good for a in found.values())
    assert found["poses, mm"].found < 1e-9 and found["colours, dB"].found > 100.0
    assert on_cpu.frame_ms > 0.0 and on_cpu.iteration_ms > 0.0


@pytest.mark.parametrize(
    ("spoilt", "change"),
    [
        ("colours, dB", {"rgb": 0.05}),
        ("depth, mm", {"median_depth": 0.01}),
        ("depth, mm", {"median_depth": np.nan}),
        ("objects, % of pixels", {"objects": 1}),
    ],
)
def test_a_render_that_differs_is_found(on_cpu: DeviceRun, spoilt: str, change: dict) -> None:
    [(name, by)] = change.items()
    view = dataclasses.replace(on_cpu.view, **{name: getattr(on_cpu.view, name) + by})
    bad = [a.what for a in agreements(on_cpu, dataclasses.replace(on_cpu, view=view)) if not a.good]
    assert bad == [spoilt]


def test_a_pose_that_differs_is_found(on_cpu: DeviceRun) -> None:
    moved = on_cpu.reports[-1].T_wc.copy()
    moved[0, 3] += 0.002
    reports = [*on_cpu.reports[:-1], dataclasses.replace(on_cpu.reports[-1], T_wc=moved)]
    bad = [a for a in agreements(on_cpu, dataclasses.replace(on_cpu, reports=reports)) if not a.good]
    assert [a.what for a in bad] == ["poses, mm"] and bad[0].found == pytest.approx(2.0)


def test_the_doctor_says_it(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("ggwarp.runtime.loading.init_quietly", lambda: None)
    monkeypatch.setattr(wp, "get_cuda_devices", list)
    assert doctor.main(["--gpu"]) == 1 and "none: nothing to check" in capsys.readouterr().out
    monkeypatch.setattr(wp, "get_cuda_devices", lambda: [SimpleNamespace(name="A GPU")])
    run = SimpleNamespace(frame_ms=12.0, iteration_ms=1.5)
    for value, code in ((0.2, 0), (20.0, 1)):
        found = [Agreement("poses, mm", value, 1.0), run, run]
        monkeypatch.setattr(device_check, "check_devices", lambda device, found=found: iter(found))
        assert doctor.main(["--gpu"]) == code
        said = capsys.readouterr().out
        assert "A GPU" in said and "1.50 ms a mapping iteration" in said
        assert ("please report it" in said) == bool(code)


@pytest.mark.skipif(not wp.get_cuda_devices(), reason="no GPU")
def test_this_gpu_computes_what_the_cpu_does() -> None:
    results = list(device_check.check_devices(wp.get_cuda_devices()[0]))
    assert [r for r in results if isinstance(r, Agreement) and not r.good] == []
