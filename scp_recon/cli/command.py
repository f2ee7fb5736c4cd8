"""What every command does with trouble: one message on standard error, and an exit status.

A command imports for about a second before its work begins. Its module starts with

    if __name__ == "__main__":
        exit_on_sigint()

above the other imports, so that Ctrl-C ends it in one line from there on; this module is light.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Callable
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING

from scp_recon.errors import InputError, printable
from scp_recon.scp.status import Status

if TYPE_CHECKING:
    from rich.console import Console

BAD_INPUT, NOT_VERIFIED = 2, 4


def exit_on_sigint() -> None:
    """End the process on Ctrl-C at once, unless it is ignored; until `run_command` sees to it."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def _end(*_: object) -> None:
    os.write(2, b"\ninterrupted\n")
    os._exit(Status.INTERRUPTED.value.exit_code)


def run_command(action: Callable[[Console], int]) -> int:
    """Do a command's work, and end with its exit status or with that of what went wrong.

    Args:
        action: prints to the console that it is given, and returns an exit status.
    """
    from rich.console import Console  # which takes longer to import than all the rest here

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # what it cannot encode must not end the command
            stream.reconfigure(errors="backslashreplace")
    errors = Console(stderr=True)

    def fail(message: str) -> int:
        # the terminal, not the message, breaks long lines: a path stays whole for who copies it
        errors.print(
            f"error: {message}", style="red", markup=False, highlight=False, soft_wrap=True
        )
        return BAD_INPUT

    started = signal.getsignal(signal.SIGINT) is _end
    try:
        if started:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with warnings.catch_warnings():
            # What overflows shows in the figures, which have to be finite, and not on the terminal.
            warnings.filterwarnings("ignore", category=RuntimeWarning)
            return action(Console())
    except InputError as error:
        return fail(str(error))
    except MemoryError:
        return fail("not enough memory: take a larger grid.step_max_s")
    except OSError as error:  # files have messages of their own: this is the terminal, or a pipe
        return fail(f"cannot write the output: {error.strerror or error}")
    except KeyboardInterrupt:
        errors.print("\ninterrupted", style="red")
        return Status.INTERRUPTED.value.exit_code
    finally:
        if started:
            exit_on_sigint()


def show_written(console: Console, path: Path) -> None:
    """Where a result is."""
    show_line(console, f"written: {path}")


def show_line(console: Console, text: str) -> None:
    """One line, however long and whatever names are in it."""
    console.print(printable(text), markup=False, highlight=False, soft_wrap=True)
