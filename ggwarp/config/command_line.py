# SPDX-License-Identifier: Apache-2.0
"""What ``ggwarp run`` is asked for."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import re
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ggwarp.config.checkpoint_interval import CheckpointInterval, checkpoint_interval
from ggwarp.config.earlier_run import map_checksum, open_earlier
from ggwarp.config.options import GROUPS, Option, option_table
from ggwarp.config.presets import load_config, preset_config
from ggwarp.config.resumed_run import ResumedRun, check_changes, open_resumed
from ggwarp.config.run_config import ConfigError, RunConfig, check
from ggwarp.console import Verbosity
from ggwarp.io.suggestion import did_you_mean
from ggwarp.pipeline.tracking.tracker import TrackerError
from ggwarp.results.saved_run import SavedRun

_COLUMNS = 100
_FLAG_COLUMNS = 20

_EXAMPLES = """\
ggwarp run: follow an RGB-D camera, and learn a map of the room in which every object can be picked.

  ggwarp run --seq office                          a built-in room: nothing to download
  ggwarp run --seq office0 --preset fast           a Replica scene (ggwarp download replica office0)
  ggwarp run --seq ./my_recording --masks none     your own recording, without object masks
"""

_CLOSING = """\
Other: -v says more, -q says less, --help-all shows every option of every part, such as
--gicp.points and --mapper.iterations. Results: ggwarp objects runs/latest list"""


@dataclass(frozen=True)
class Command:
    """Object-level RGB-D Gaussian-splatting SLAM."""

    run: Annotated[RunConfig, tyro.conf.arg(name="")]
    config: Path | None = None
    """A saved config.toml to start from, instead of a preset."""
    resume: Path | None = None
    """A run to go on with, by its folder: it may be done, stopped or killed. It keeps its options."""
    start_from: Path | None = None
    """The run, by its folder, in whose map this one begins. The first frame is looked for there; map and
    objects go on in a new folder, and that run stays as it is."""
    checkpoint_every: str = "60s"
    """Write a checkpoint every so many frames, such as 100, or seconds, such as 60s. The word off means
    never."""
    viewer: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the run in the browser while it goes on, at 127.0.0.1:8080 or as --viewer-at says."""
    viewer_at: str | None = None
    """Show the run in the browser at HOST:PORT, such as 0.0.0.0:8080, which the network reaches."""
    resumed: Annotated[ResumedRun | None, tyro.conf.Suppress, tyro.conf.Fixed] = None
    earlier: Annotated[SavedRun | None, tyro.conf.Suppress, tyro.conf.Fixed] = None
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(aliases=["-v"])] = False
    """Say more: a line for every frame, and what the library logs in detail."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(aliases=["-q"])] = False
    """Say less: only warnings and the closing lines."""

    @property
    def interval(self) -> CheckpointInterval:
        """How often a checkpoint is written."""
        return checkpoint_interval(self.checkpoint_every)

    @property
    def verbosity(self) -> Verbosity:
        return Verbosity.QUIET if self.quiet else Verbosity.VERBOSE if self.verbose else Verbosity.NORMAL


def parse(arguments: list[str]) -> Command:
    """Return what the command line asks for.

    Options override those of that run, of the file given by ``--config``, or of the preset.

    Raises:
        ConfigError: an option cannot be used.
        SystemExit: help was asked for, and shown.
    """
    if "-h" in arguments or "--help" in arguments:
        print(short_help())
        raise SystemExit(0)
    everything = "--help-all" in arguments
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    first.add_argument("--config", type=Path)
    first.add_argument("--preset")
    first.add_argument("--resume", type=Path)
    try:
        start, _ = first.parse_known_args(arguments)
    except argparse.ArgumentError:
        start = argparse.Namespace(config=None, preset=None, resume=None)  # tyro says what is wrong
    if start.config is not None and start.preset is not None:
        raise ConfigError("--config and --preset: give one of them; a saved configuration has its preset")
    if start.resume is not None and (start.config is not None or start.preset is not None):
        raise ConfigError("--resume: a run keeps what it began with; leave --config and --preset out")
    resumed = None if start.resume is None or everything else open_resumed(start.resume)
    if resumed is not None:
        base = resumed.config
    elif start.config is not None:
        base = load_config(start.config)
    else:
        base = preset_config(start.preset or "gg-slam")
    default = Command(base, start.config, start.resume, resumed=resumed)
    command = _parsed(["--help"] if everything else arguments, default)
    if command.quiet and command.verbose:
        raise ConfigError("-q and -v: give one of them")
    if resumed is not None:
        check_changes(resumed.config, command.run)
        whole = dataclasses.replace(command.run, refine=resumed.refined + command.run.refine)
        command = dataclasses.replace(command, run=whole)
    check(command.run)
    _ = command.interval
    return dataclasses.replace(command, earlier=_earlier(command))


def _earlier(command: Command) -> SavedRun | None:
    """Return the run in whose map the command's begins, or began; None: with an empty map."""
    before = None if command.resumed is None else command.resumed.earlier
    where = command.start_from or (None if before is None else before.folder)
    if where is None:
        return None
    if command.resumed is not None and before is None:
        raise ConfigError("--start-from: with --resume a run keeps what it began with, an empty map")
    found = open_earlier(where, command.run.out)
    if before is not None and map_checksum(found) != before.checksum:
        raise ConfigError(f"--start-from {where}: its map is not the one that the run to go on with began in")
    return found


def _parsed(arguments: list[str], default: Command) -> Command:
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(Command, prog="ggwarp run", args=arguments, default=default)
    except TrackerError as error:
        raise ConfigError(f"--tracker {error}") from None
    except SystemExit as stop:
        if stop.code == 0:  # --help
            raise
        reason = _first_sentence(complaint.getvalue())
        raise ConfigError(f"{reason}{_meant(reason)} (--help-all lists the options)") from None


def _meant(reason: str) -> str:
    """Return the option, or its value, nearest to a mistyped one in ``reason``; empty: none is near."""
    options = option_table()
    if unknown := re.search(r"Unrecognized options: (--[\w.-]+)", reason):
        return did_you_mean(unknown[1], [option.flag for option in options])
    if wrong := re.search(r"invalid choice '(.*?)' for argument '(--[\w.-]+)'", reason):
        return did_you_mean(wrong[1], next((o.choices for o in options if o.flag == wrong[2]), ()))
    return ""


def short_help() -> str:
    """Return the help of the options that belong to no single part, after three examples."""
    lines = [_EXAMPLES]
    options = option_table()
    for title in GROUPS:
        lines.append(f"{title}:")
        for option in options:
            if option.group == title:
                lines += textwrap.wrap(
                    f"{_typed(option):{_FLAG_COLUMNS}} {_about(option)}",
                    _COLUMNS,
                    initial_indent="  ",
                    subsequent_indent=" " * (_FLAG_COLUMNS + 3),
                    break_on_hyphens=False,
                )
        lines.append("")
    return "\n".join([*lines, _CLOSING])


def _typed(option: Option) -> str:
    return f"--[no-]{option.flag[2:]}" if option.choices == ("yes", "no") else option.flag


def _about(option: Option) -> str:
    """Return the first sentence of the help, the choices, and the default."""
    first = option.help.partition(". ")[0].removesuffix(".") + "."
    unsaid = [c for c in option.choices if c not in ("yes", "no")]
    values = f" One of {', '.join(unsaid)}." if unsaid else ""
    said = option.help.partition("Default: ")[2].partition(". ")[0].removesuffix(".") or option.default
    return f"{first}{values} Default: {said}." if said else f"{first}{values}"


def _first_sentence(boxed: str) -> str:
    """Return what tyro's box of several lines begins with, on one line."""
    words: list[str] = []
    for line in boxed.splitlines()[1:]:
        text = line.strip("│╰╯─ ")
        if not text and words:
            break
        words += text.split()
    return " ".join(words).removesuffix(".") or boxed.strip()
