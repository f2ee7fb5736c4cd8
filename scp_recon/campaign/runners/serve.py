"""What runs in a case's own process: `child.Child` begins it, and speaks to it through pipes.

The kernel ends it when a case takes too long, whatever it is stuck in: SIGALRM's default action needs
no Python. It ends itself when its parent is gone.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import sys
import threading
import time
import warnings
from pathlib import Path

from scp_recon.campaign.rows.case import attempt
from scp_recon.campaign.runners.child import READY, Limits, read_message, write_message

LOOK_S = 1.0
"""Seconds between looks whether the parent is there."""


def main() -> int:
    """Run cases until there are no more."""
    source = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a case prints is no answer
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    pickled, limits = read_message(source)
    try:
        work = pickle.loads(pickled)
    except Exception as error:  # a module that is not here, or is another
        write_message(answers, f"{type(error).__name__}: {error}")
        return 1
    write_message(answers, READY)
    _limit_memory(limits)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=RuntimeWarning)  # as `run_command` does
        while True:
            try:
                case = read_message(source)
            except EOFError:
                return 0
            signal.setitimer(signal.ITIMER_REAL, limits.seconds)
            done = attempt(work, case)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            write_message(answers, done)


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)


def _limit_memory(limits: Limits) -> None:
    """Beyond what the process has now, where the system tells it and keeps the limit."""
    own = Path("/proc/self/statm")
    if own.exists():
        pages = int(own.read_text("ascii").split()[0])
        most = pages * resource.getpagesize() + limits.memory_mb * 1_000_000
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        if hard == resource.RLIM_INFINITY or most < hard:
            resource.setrlimit(resource.RLIMIT_AS, (most, hard))


if __name__ == "__main__":
    sys.exit(main())
