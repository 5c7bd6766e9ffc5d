# SPDX-License-Identifier: Apache-2.0
"""``python -m ggwarp.suite.child PARENT THREADS ...``: ``ggwarp run ...``, which ends with its parent.

A run whose worker was killed would else go on, and hold memory that the cluster takes for free. It is ended
by SIGTERM: it saves what it has.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # of Linux's prctl


def end_with(parent: int) -> None:
    """Have SIGTERM sent to this process when the thread of ``parent`` that made it ends; on Linux alone."""
    if sys.platform != "linux":
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:  # it has gone already
        os.kill(os.getpid(), signal.SIGTERM)


def main(arguments: list[str]) -> int:
    """Run the command that follows parent and threads; return its exit code."""
    parent, threads, *asked = arguments
    end_with(int(parent))
    from ggwarp.interruption import end_program_after
    from ggwarp.run import main as run
    from ggwarp.runtime.launch import set_cpu_threads

    set_cpu_threads(int(threads))
    end_program_after()
    return run(asked)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
