# SPDX-License-Identifier: Apache-2.0
"""How often a run writes a checkpoint."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ggwarp.config.run_config import ConfigError
from ggwarp.io.printable import shown


@dataclass(frozen=True)
class CheckpointInterval:
    """Every so many frames, or every so many seconds; with 0 and 0 none.

    Attributes:
        frames: of the sequence; in a refinement, iterations.
        seconds: by the clock.
    """

    frames: int = 0
    seconds: float = 0.0

    @property
    def is_off(self) -> bool:
        return not self.frames and not self.seconds


def checkpoint_interval(text: str) -> CheckpointInterval:
    """Return what ``--checkpoint-every`` means.

    Raises:
        ConfigError: it is of no such form.
    """
    if text == "off":
        return CheckpointInterval()
    match = re.fullmatch(r"(\d{1,9})(?:(\.\d{1,9})?s)?", text, re.ASCII)
    if match is None:
        raise ConfigError(
            f"--checkpoint-every {shown(text)}: give frames such as 100, seconds such as 60s, or off"
        )
    if text.endswith("s"):
        return CheckpointInterval(seconds=float(text[:-1]))
    return CheckpointInterval(frames=int(text))
