# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

from ggwarp.io import mounts


def test_mounts_of_the_same_file_system_count(tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / "a b"
    folder.mkdir()
    assert mounts.is_mount(Path("/")) and not mounts.is_mount(folder)
    listed = tmp_path / "mountinfo"
    place = str(folder.resolve()).replace(" ", r"\040")
    listed.write_text(f"36 35 98:0 /mnt1 {place} rw,noatime master:1 - ext3 /dev/root rw\n")
    monkeypatch.setattr(mounts, "_MOUNTS", listed)
    assert mounts.is_mount(folder) and not mounts.is_mount(tmp_path)
    monkeypatch.setattr(mounts, "_MOUNTS", tmp_path / "none")
    assert not mounts.is_mount(folder)
