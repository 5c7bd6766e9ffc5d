# SPDX-License-Identifier: Apache-2.0
"""The command: ``ggwarp view RUN``."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from ggwarp.geometry.upright import Up
from ggwarp.io.printable import printable
from ggwarp.results.saved_run import RunError, load_run
from ggwarp.results.scene_view import parse_up

USER_ERROR, INTERRUPTED = 2, 130

_DESCRIPTION = """\
Look at a run in the browser, and edit its objects there.

  ggwarp view runs/latest                     a page at 127.0.0.1; Ctrl-C ends it
  ggwarp view runs/latest --save scene.html   one file that any browser opens, without ggwarp
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code: 0, 2 (the user's mistake) or 130 (Ctrl-C)."""
    try:
        return execute(_parse(arguments))
    except RunError as error:
        return _refuse(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(f"{where}{error.strerror or error}")
    except MemoryError:
        return _refuse("out of memory")
    except KeyboardInterrupt:
        return _refuse("interrupted", INTERRUPTED)


def execute(options: argparse.Namespace) -> int:
    """Do what the command line asks for; return the exit code."""
    run, up = load_run(options.run), _up(options.up)
    # Here, not above: without viser a wrong folder is still said to be one.
    from ggwarp.viewer import server as web

    if options.save is not None:
        from ggwarp.viewer.scene_file import write_scene

        write_scene(run, options.save, up)
        print(f"{printable(str(options.save))}: {options.save.stat().st_size / 1e6:.1f} MB")
        return 0
    from ggwarp.editing.device import ready_device
    from ggwarp.viewer.build import open_page

    host, port = web.parse_address(options.at, "--at")
    device = ready_device(options.device)
    page, _, url = open_page(run, host, port, device=device, up=up)
    print(f"{url}\n{web.reach(host)}; Ctrl-C ends it", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        if not page.session.is_saved:
            edits = " then ".join(page.session.commands)
            print(f"\nnot saved: ggwarp objects {printable(str(run.folder))} {printable(edits)}")
    finally:
        web.stop_server(page.server)
    return 0


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="ggwarp view",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="a run folder, such as runs/latest")
    parser.add_argument(
        "--at",
        metavar="HOST:PORT",
        default="127.0.0.1:8080",
        help="where the page is (127.0.0.1:8080: this machine alone; 0.0.0.0: all that reach it)",
    )
    parser.add_argument("--save", type=Path, metavar="FILE", help="write the scene as one HTML file instead")
    parser.add_argument(
        "--up",
        default="auto",
        metavar="AXIS",
        help="which way is up: x, -x, y, -y, z, -z, or X,Y,Z (auto: as the run found)",
    )
    parser.add_argument("--device", help="auto (CUDA if there is one), cpu or cuda:N")
    return parser.parse_args(arguments)


def _up(text: str) -> Up | None:
    try:
        return parse_up(text)
    except ValueError as error:
        raise RunError(str(error)) from None


def _refuse(message: str, code: int = USER_ERROR) -> int:
    print(f"ggwarp view: {printable(message)}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
