# SPDX-License-Identifier: Apache-2.0
"""ggwarp doctor in made-up environments: what is missing is said, with how to get it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import pytest

from ggwarp.commands import doctor
from ggwarp.commands.doctor import Finding

GPU = SimpleNamespace(alias="cuda:0", name="A GPU", arch=90, total_memory=80 << 30)


def _by_subject(findings: Iterable[Finding]) -> dict[str, Finding]:
    return {f.subject: f for f in findings}


def test_all_packages_are_there() -> None:
    found = _by_subject(doctor.packages(lambda package: "1.2.3"))
    assert found["torch"].state == "1.2.3" and found["extra export"].state == "gaussforge 1.2.3"
    assert not any(f.remedy for f in found.values())


def test_what_is_missing_comes_with_its_pip_line() -> None:
    there = {"numpy": "2.0", "opencv-python": "4.9"}
    found = _by_subject(doctor.packages(there.get))
    assert found["torch"] == Finding("torch", "not installed", "pip install torch", essential=True)
    assert found["opencv"].state == "4.9", "another build of it does as well"
    assert found["extra benchmark"].remedy.startswith("pip install 'ggwarp[benchmark]'")
    assert not found["extra benchmark"].essential


def test_machines_with_a_gpu_and_without() -> None:
    warp = SimpleNamespace(get_cuda_devices=lambda: [GPU], get_cuda_driver_version=lambda: (12, 8))
    found = _by_subject(doctor.machine(warp))
    assert found["cuda:0"].state == "A GPU, sm_90, 80 GiB" and found["driver"].state == "CUDA 12.8"
    found = _by_subject(doctor.machine(SimpleNamespace(get_cuda_devices=list)))
    assert "CPU" in found and found["GPU"].remedy and not found["GPU"].essential


def test_the_kernel_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "module.o").write_bytes(bytes(3 << 20))
    [warm] = doctor.kernel_cache(tmp_path, 29, 0)
    assert warm.state == f"{tmp_path}, 3 MiB, 29 of 29 modules compiled" and not warm.remedy
    [cold] = doctor.kernel_cache(tmp_path / "new" / "er", 29, 29)
    assert "0 of 29" in cold.state and "first run compiles" in cold.remedy and not cold.essential
    monkeypatch.setattr(doctor, "_writable", lambda folder: False)
    [closed] = doctor.kernel_cache(tmp_path, 29, 5)
    assert closed.essential and "WARP_CACHE_PATH" in closed.remedy


def test_the_data_root(tmp_path: Path) -> None:
    [absent] = doctor.data(tmp_path / "absent")
    assert "ggwarp download" in absent.remedy and not absent.essential
    (tmp_path / "Replica" / "office0").mkdir(parents=True)
    (tmp_path / "mine").mkdir()
    found = _by_subject(doctor.data(tmp_path))
    assert found["Replica"].state == "office0" and not found["Replica"].remedy
    assert found["TUM"].remedy == "ggwarp download tum fr1/xyz" and found["other folders"].state == "mine"
    (tmp_path / "rgbd_dataset_freiburg1_xyz").mkdir()
    found = _by_subject(doctor.data(tmp_path))
    assert found["TUM"].state == "rgbd_dataset_freiburg1_xyz" and found["other folders"].state == "mine"


def test_the_report_ends_with_what_matters(capsys: pytest.CaptureFixture[str]) -> None:
    fine, missing = (
        Finding("numpy", "2.0"),
        Finding("torch", "not installed", "pip install torch", essential=True),
    )
    assert doctor.report(iter([fine])) == 0
    assert "ggwarp run --seq office" in capsys.readouterr().out
    assert doctor.report(iter([fine, missing])) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("! torch") and lines[2].strip() == "pip install torch"
    assert lines[-1] == "no run is possible yet: torch"


def test_this_machine(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert doctor.main(["--data", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    for subject in ("ggwarp ", "Python", "warp-lang", "kernel cache", "data root"):
        assert subject in shown


def test_a_warp_that_does_not_start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def broken() -> None:
        raise OSError("no native library")

    monkeypatch.setattr("ggwarp.runtime.loading.init_quietly", broken)
    found = _by_subject(doctor.examine(tmp_path))
    assert found["Warp"].essential and "no native library" in found["Warp"].state
