# SPDX-License-Identifier: Apache-2.0
"""The command: ``ggwarp run --seq office0``, or ``python -m ggwarp.run --seq office0``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from ggwarp.config import ConfigError
from ggwarp.config.command_line import parse
from ggwarp.console import Display, Interruption, open_display
from ggwarp.datasets import DatasetError
from ggwarp.io.printable import printable
from ggwarp.session import Session

USER_ERROR = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code.

    0; 1: a failure on the way, what there was is saved; 2: the user's mistake; 130: Ctrl-C.
    """
    started = time.perf_counter()
    display: Display | None = None
    try:
        command = parse(sys.argv[1:] if arguments is None else list(arguments))
        display = open_display(command.verbosity)
        with Interruption() as interruption:
            return Session(command.run, display, interruption, started=started).run()
    except (ConfigError, DatasetError) as error:
        return _refuse(display, str(error))
    except MemoryError:
        return _refuse(display, "out of memory: try a smaller --scale, or fewer --frames")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(display, f"{where}{error.strerror or error}")
    except KeyboardInterrupt:
        return _refuse(display, "interrupted; nothing was saved", INTERRUPTED)


def _refuse(display: Display | None, message: str, code: int = USER_ERROR) -> int:
    if display is not None:
        display.close()
    print(f"ggwarp: {printable(message)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
