# SPDX-License-Identifier: Apache-2.0
"""The command: ``ggwarp run --seq office0``, or ``python -m ggwarp.run --seq office0``."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ggwarp.interruption import Interruption, end_program_after, leave_compilers
from ggwarp.io.printable import printable

if TYPE_CHECKING:
    from ggwarp.console import Display

USER_ERROR = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code.

    0; 1: a failure on the way, what there was is saved; 2: the user's mistake; 130, 143, 129: SIGINT, SIGTERM
    or SIGHUP ended it.
    """
    started = time.perf_counter()
    if arguments is None:
        end_program_after()
    with Interruption() as interruption:
        try:
            return _main(sys.argv[1:] if arguments is None else list(arguments), interruption, started)
        except BaseException as error:
            # A library that is interrupted while it is imported may say so in its own way.
            if isinstance(error, KeyboardInterrupt) or (
                interruption.requested and interruption.at_once and not isinstance(error, SystemExit)
            ):
                code = _refuse(None, "interrupted; nothing was saved", interruption.exit_code)
                leave_compilers(code)
                return code
            raise


def _main(arguments: list[str], interruption: Interruption, started: float) -> int:
    # Here, not above: importing them takes seconds, in which the command can be interrupted, too.
    from ggwarp.config import ConfigError
    from ggwarp.config.command_line import parse
    from ggwarp.console import open_display
    from ggwarp.datasets import DatasetError
    from ggwarp.session import Session

    display: Display | None = None
    try:
        if interruption.requested:
            raise KeyboardInterrupt
        command = parse(arguments)
        display = open_display(command.verbosity)
        session = Session(
            command.run,
            display,
            interruption,
            started=started,
            interval=command.interval,
            resumed=command.resumed,
        )
        return session.run()
    except (ConfigError, DatasetError) as error:
        return _refuse(display, str(error))
    except MemoryError:
        return _refuse(display, "out of memory: try a smaller --scale, or fewer --frames")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(display, f"{where}{error.strerror or error}")
    finally:
        if display is not None:
            display.close()


def _refuse(display: Display | None, message: str, code: int = USER_ERROR) -> int:
    if display is not None:
        display.close()
    with contextlib.suppress(OSError):  # the terminal may have gone
        print(f"ggwarp: {printable(message)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
