# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from ggwarp.runtime import memory


def test_a_third_of_the_machine_or_what_is_asked_for(device: str) -> None:
    assert 0 < memory.image_budget(device, None) <= memory.machine_memory() // 3
    assert memory.image_budget("cpu", None) == memory.machine_memory() // 3
    assert memory.image_budget(device, 0.5) == 500_000_000 and memory.image_budget(device, 0.0) == 0


@pytest.mark.parametrize(("said", "limited"), [("1000000\n", True), ("max\n", False), ("", False)])
def test_a_container_has_what_it_is_given(tmp_path: Path, said: str, limited: bool) -> None:
    limit = tmp_path / "memory.max"
    limit.write_text(said)
    found = memory.machine_memory((str(limit), str(tmp_path / "absent")))
    assert (found == 1_000_000) if limited else (found > 1_000_000)


def test_a_machine_that_does_not_say(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(name: str) -> int:
        raise ValueError(name)

    monkeypatch.setattr(memory.os, "sysconf", unknown, raising=False)
    assert memory.machine_memory(()) == 4 << 30
