# SPDX-License-Identifier: Apache-2.0
"""What others wrote, fit for one line."""

from pathlib import Path

from ggwarp.io.printable import shown_path


def test_a_path_that_no_disk_holds_is_shortened() -> None:
    assert shown_path(Path("/a/b.png")) == "/a/b.png"
    text = shown_path(Path("/a") / ("9" * 5000 + "\n.png"))
    assert len(text) < 600 and text.startswith("/a/999") and text.isprintable()
