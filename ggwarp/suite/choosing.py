# SPDX-License-Identifier: Apache-2.0
"""Which setting? The fastest one that is nearly as good as the best, as a configuration for ``--config``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ggwarp.io.atomic import atomic_write
from ggwarp.suite.definition import Choice, Suite, SuiteError
from ggwarp.suite.results import Results
from ggwarp.suite.run_options import toml_lines

_QUALITIES = ("heldout_psnr", "psnr")
"""What is compared, the first that every run has measured: views that the map was not fitted to, if any."""


@dataclass(frozen=True)
class Candidate:
    """How a setting has done, on average over sequences.

    Attributes:
        setting: its name.
        psnr: dB. fps: frames a second. frames_lost: of a sequence.
    """

    setting: str
    psnr: float
    fps: float
    frames_lost: float


@dataclass(frozen=True)
class Chosen:
    """What was chosen, and from what.

    Attributes:
        best: the candidate of the highest PSNR.
        chosen: the fastest that keeps within so many dB of it, and loses no more frames.
        quality: name of the PSNR that was compared.
    """

    best: Candidate
    chosen: Candidate
    quality: str

    @property
    def line(self) -> str:
        """It, in one line."""
        best, chosen = self.best, self.chosen
        if chosen == best:
            return f"{best.setting}: {best.psnr:.2f} dB at {best.fps:.2f} fps; no faster one is so near it"
        return (
            f"{chosen.setting}: {chosen.psnr:.2f} dB at {chosen.fps:.2f} fps; "
            f"the best, {best.setting}: {best.psnr:.2f} dB at {best.fps:.2f} fps"
        )


def choose(results: Results, choice: Choice) -> Chosen:
    """Return the fastest setting that keeps within ``choice.within_db`` of the best.

    Raises:
        SuiteError: no setting was measured on every sequence.
    """
    for quality in _QUALITIES:
        found = [_candidate(results, setting, quality) for setting in results.settings]
        candidates = [candidate for candidate in found if candidate is not None]
        if candidates:
            best = max(candidates, key=lambda c: c.psnr)
            good = [c for c in candidates if c.psnr >= best.psnr - choice.within_db]
            chosen = max((c for c in good if c.frames_lost <= best.frames_lost), key=lambda c: c.fps)
            return Chosen(best, chosen, quality)
    raise SuiteError("no setting was measured on every sequence; see what failed, and start it again")


def write_choice(suite: Suite, chosen: Chosen, path: Path) -> None:
    """Write the options of the setting that was chosen, for ``ggwarp run --config``.

    Raises:
        OSError: it cannot be written.
    """
    options = next(s.options for s in suite.settings if s.name == chosen.chosen.setting)
    lines = [f"# {suite.name}: {chosen.line}", *toml_lines(options)]
    with atomic_write(path) as file:
        file.write(("\n".join(lines) + "\n").encode(errors="replace"))


def _candidate(results: Results, setting: str, quality: str) -> Candidate | None:
    psnr, fps, lost = (results.average(setting, metric) for metric in (quality, "fps", "frames_lost"))
    return None if psnr is None or fps is None else Candidate(setting, psnr, fps, lost or 0.0)
