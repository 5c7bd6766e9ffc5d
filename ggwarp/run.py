# SPDX-License-Identifier: Apache-2.0
"""The command: ``ggwarp run --seq office0``, or ``python -m ggwarp.run --seq office0``."""

from __future__ import annotations

import contextlib
import sys
import time

from ggwarp.interruption import Interruption, end_program_after, leave_compilers

TYPE_CHECKING = False  # not typing's: no signal is heard before this module is imported
if TYPE_CHECKING:
    from collections.abc import Sequence

    from ggwarp.console import Display
    from ggwarp.viewer.live import LiveViewer

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
    from ggwarp.pipeline.loops.localisation import NotFoundError
    from ggwarp.session import FAILED, Session

    display: Display | None = None
    try:
        if interruption.requested:
            raise KeyboardInterrupt
        command = parse(arguments)
        display = open_display(command.verbosity)
        with contextlib.ExitStack() as stack:
            viewer = None
            if command.viewer or command.viewer_at is not None:
                viewer, display = _open_viewer(command.viewer_at, display)
                stack.callback(viewer.close)
            session = Session(
                command.run,
                display,
                interruption,
                started=started,
                interval=command.interval,
                resumed=command.resumed,
                earlier=command.earlier,
                viewer=viewer,
            )
            return session.run()
    except (ConfigError, DatasetError) as error:
        return _refuse(display, str(error))
    except NotFoundError as error:
        return _refuse(display, str(error), FAILED)
    except MemoryError:
        return _refuse(display, "out of memory: try a smaller --scale, or fewer --frames")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(display, f"{where}{error.strerror or error}")
    finally:
        if display is not None:
            display.close()


def _open_viewer(at: str | None, display: Display) -> tuple[LiveViewer, Display]:
    """Start the page at ``at``, and say where it is; return it and the display that it shows, too."""
    from ggwarp.config import ConfigError
    from ggwarp.results.saved_run import RunError

    try:
        from ggwarp.viewer import live, server

        host, port = server.parse_address(at or f"{server.LOCAL}:{server.PORT}", "--viewer-at")
        viewer = live.LiveViewer(host, port)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"--viewer: {error.name} is not installed; pip install 'ggwarp[viewer]' brings it"
        ) from None
    except RunError as error:
        raise ConfigError(str(error)) from None
    display.note(f"{viewer.url} ({server.reach(host)})")
    return viewer, live.ShownDisplay(display, viewer)


def _refuse(display: Display | None, message: str, code: int = USER_ERROR) -> int:
    from ggwarp.io.printable import printable

    if display is not None:
        display.close()
    with contextlib.suppress(OSError):  # the terminal may have gone
        print(f"ggwarp: {printable(message)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
