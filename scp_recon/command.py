"""What every command does with trouble: one message on standard error, and an exit status."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from io import TextIOWrapper

from rich.console import Console

from scp_recon.errors import InputError
from scp_recon.status import Status

BAD_INPUT, NOT_VERIFIED = 2, 4


def guarded(action: Callable[[Console], int]) -> int:
    """Do a command's work, and end with its exit status or with that of what went wrong.

    Args:
        action: prints to the console that it is given, and returns an exit status.
    """
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

    try:
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
