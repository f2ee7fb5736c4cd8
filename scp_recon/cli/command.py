"""Run a command: parse its options, end with an exit status, and report errors in one message.

A command needs about a second for imports before its work begins. A module that is run as a program
therefore starts with

    if __name__ == "__main__":
        exit_on_sigint()

above the other imports, so that Ctrl-C ends it at any time with one line. This module imports
little.

With --json one document goes to standard output, and all text for people to standard error:

    {"schema": "scp_recon.command/1", "command": ..., "status": ..., ...}

`status` is the exit status. Bad input adds `error` with `entry`, `given` and `allowed`, and with
`file` if a scenario's file holds the entry.
"""

from __future__ import annotations

import difflib
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import TextIOWrapper
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from scp_recon.cli.options import Option, joined, parameters, parser_of
from scp_recon.errors import InputError, printable
from scp_recon.scp.status import Status

if TYPE_CHECKING:
    import argparse

    from rich.console import Console

BAD_INPUT, NOT_VERIFIED = 2, 4
EXIT_STATUSES = {
    "0": "converged, no buffer in use, and verified; with or without warnings",
    "2": "bad input: one message names the entry, what was given and what is allowed; nothing is "
    "written",
    "3": "infeasible: the least violation found, constraint by constraint, what binds, and a `--set` "
    "line that would be feasible; files are written",
    "4": "not converged, or converged and not verified; of `montecarlo`: an estimated probability "
    "below `risk.p_chance`, or an interval wider than `--until`; of `simulate`: a battery below its "
    "floor, a load not served, a mode too short or steady too late; of `export`: a plan that is not "
    "verified; files are written",
    "5": "of `replan`: lost, the final state is missed by more than three sigma of what the flown plan "
    "predicts; files are written",
    "130": "interrupted: the best plan so far is written",
}
"""The meaning of each exit status."""
DOCUMENT = "scp_recon.command/1"
SCRIPT = "scp-recon"
WIDE = 200
"""Columns where no terminal says how many there are: wide enough for every table."""


class Answer(NamedTuple):
    """End of a command: its exit status, and the values for --json, in SI with units in the keys."""

    status: int
    document: Mapping[str, Any]


@dataclass(frozen=True)
class Command:
    """A command, `scp-recon NAME`, of a function of that name.

    Attributes:
        function: does the work with a console and its options. Its module is light; it imports what it
            needs when it is called.
        owner: function of `api` whose options the command takes; None for a command without.
        spelt: parameters that this command spells in another way than the others.
    """

    function: Callable[..., Answer]
    owner: Callable[..., Any] | None = None
    spelt: Mapping[str, Option] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the command."""
        return self.function.__name__

    def parser(self) -> argparse.ArgumentParser:
        """Parser of its options."""
        return parser_of(self.function, self.owner, self.spelt, f"{SCRIPT} {self.name}")

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run the command line; returns the exit status."""
        options = parse(self.parser(), joined(sys.argv[1:] if arguments is None else arguments))
        use_one_thread()
        names = (one.name for one in parameters(self.function, self.owner))
        given = {name: getattr(options, name) for name in names}
        return run_command(lambda console: self.function(console, **given), options)


def command(
    owner: Callable[..., Any] | None = None, **spelt: Option
) -> Callable[[Callable[..., Answer]], Command]:
    """Decorator that makes a command of a function: see `Command`."""
    return lambda function: Command(function, owner, spelt)


def use_one_thread() -> None:
    """Give NumPy's linear algebra one thread, before NumPy is imported; only for a whole process.

    Several threads wait for each other in busy loops: a certified plan took 7.5 s of the processor
    with two, and 3.8 s with one. A number that the user gave to the libraries is kept.
    """
    if "numpy" not in sys.modules and "OMP_NUM_THREADS" not in os.environ:
        for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ.setdefault(name, "1")


def parse(p: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read a command line with --json and --quiet; pass the result to `run_command`.

    Raises:
        SystemExit: 0 after --help, 2 after a bad command line, which --json reports in its
            document.
    """
    add_output_options(p)
    words = sys.argv[1:] if arguments is None else arguments

    def error(message: str) -> NoReturn:
        known = [*p._option_string_actions]
        message = f"{_in_our_words(message, words, known)} ({p.prog} --help says more)"
        if "--json" in words:
            _print_document(p.prog, BAD_INPUT, {"error": {"message": message}})
        p.exit(BAD_INPUT, f"error: {printable(message)}\n")

    p.error = error  # type: ignore[method-assign]  # errors go into the document too
    found = p.parse_args(arguments)
    found.prog = p.prog
    found.flags = {
        action.dest: action.option_strings[-1]
        if action.option_strings
        else str(action.metavar or action.dest)
        for action in p._actions
    }
    return found


def _in_our_words(message: str, words: Sequence[str], known: Sequence[str]) -> str:
    """Rewrite argparse's message as option, value found and value expected, like all other messages.

    A misspelt option gets the nearest of those that are known.
    """
    if match := re.fullmatch(r"argument (?:\S+/)?(\S+): expected one argument", message):
        option = match[1]
        at = words.index(option) + 1 if option in words else len(words)
        value = words[at] if at < len(words) else ""
        if re.match(r"-[\d.]", value):
            return (
                f"{option}: got {value!r}, which begins as an option does; write {option}={value}"
            )
        return f"{option}: got nothing; must have a value"
    if match := re.fullmatch(r"argument (?:\S+/)?(\S+): (.*)", message, re.DOTALL):
        return f"{match[1]}: {match[2]}"
    if match := re.fullmatch(r"unrecognized arguments: (.*)", message, re.DOTALL):
        first = (match[1].split() or [""])[0].partition("=")[0]
        near = difflib.get_close_matches(first, known, n=1)
        meant = f"; did you mean {near[0]}?" if near else ""
        return f"got {match[1]}; there is no such option or argument{meant}"
    if match := re.fullmatch(r"the following arguments are required: (.*)", message):
        return f"{match[1]}: got nothing; must be given"
    return message


def add_output_options(p: argparse.ArgumentParser) -> None:
    """Options of every command."""
    p.add_argument(
        "--json",
        action="store_true",
        help="one JSON document on standard output, in SI; all else goes to standard error",
    )
    p.add_argument(
        "--quiet", action="store_true", help="nothing but errors, and with --json its document"
    )


def exit_on_sigint() -> None:
    """End the process at once on Ctrl-C, unless it is ignored, until `run_command` handles it."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def _end(*_: object) -> None:
    os.write(2, b"\ninterrupted\n")
    os._exit(Status.INTERRUPTED.value.exit_code)


def run_command(
    action: Callable[[Console], int | Answer], options: argparse.Namespace | None = None
) -> int:
    """Run a command's work; return its exit status, or that of its error.

    `options` is the result of `parse`; None for a command without --json and --quiet.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # what it cannot encode must not end the command
            stream.reconfigure(errors="backslashreplace")
    as_json, quiet = getattr(options, "json", False), getattr(options, "quiet", False)
    errors = make_console(stderr=True)

    def end(status: int, document: Mapping[str, Any]) -> int:
        if as_json and options is not None:
            _print_document(options.prog, status, document)
        return status

    def fail(message: str, **error: str) -> int:
        # the terminal, not the message, breaks long lines: a path stays whole for who copies it
        show_line(errors, f"error: {message}", "red")
        return end(BAD_INPUT, {"error": {"message": message, **error}})

    started = signal.getsignal(signal.SIGINT) is _end
    try:
        if started:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with warnings.catch_warnings():
            # What overflows shows in the figures, which have to be finite, and not on the terminal.
            warnings.filterwarnings("ignore", category=RuntimeWarning)
            answer = action(make_console(stderr=as_json, quiet=quiet))
        return end(*answer) if isinstance(answer, Answer) else end(answer, {})
    except InputError as caught:
        error = caught.for_command(getattr(options, "flags", {}))
        parts = {"entry": error.entry, "given": error.given, "allowed": error.allowed}
        return fail(str(error), **parts, **({"file": error.file} if error.file else {}))
    except MemoryError:
        return fail("not enough memory: take a larger grid.step_max_s")
    except OSError as error:  # files have messages of their own: this is the terminal, or a pipe
        return fail(f"cannot write the output: {error.strerror or error}")
    except KeyboardInterrupt:
        errors.print("\ninterrupted", style="red")
        return end(Status.INTERRUPTED.value.exit_code, {})
    finally:
        if started:
            exit_on_sigint()


def make_console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """Make a console as wide as the terminal, or without one as the widest table."""
    from rich.console import Console  # which takes longer to import than all the rest here

    is_terminal = (sys.stderr if stderr else sys.stdout).isatty()
    width = None if is_terminal or "COLUMNS" in os.environ else WIDE
    return Console(stderr=stderr, quiet=quiet, width=width)


def progress_console(console: Console) -> Console:
    """Make a console for progress bars on standard error; it shows nothing with --quiet."""
    return make_console(stderr=True, quiet=console.quiet)


def _print_document(prog: str, status: int, document: Mapping[str, Any]) -> None:
    import json

    command = prog.removeprefix(f"{SCRIPT} ").removeprefix("python -m ")
    whole = _finite({"schema": DOCUMENT, "command": command, "status": status, **document})
    try:
        sys.stdout.write(json.dumps(whole, allow_nan=False, default=str) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:  # as rich ends, without a word
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        raise SystemExit(1) from None


def _finite(value: Any) -> Any:
    """Values with null for figures that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def show_written(console: Console, path: Path) -> None:
    """Show the path of a result."""
    show_line(console, f"written: {path}")


def show_line(console: Console, text: str, style: str | None = None) -> None:
    """Show one line without wrapping and without markup."""
    console.print(printable(text), style=style, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C was pressed; a second Ctrl-C stops at once.

    The function is always false if Ctrl-C is ignored, or outside the main thread.
    """
    before = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if not main or before is not signal.default_int_handler:
        yield lambda: False
        return
    came: list[int] = []

    def notice(number: int, _: object) -> None:
        came.append(number)
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, notice)
    try:
        yield lambda: bool(came)
    finally:
        signal.signal(signal.SIGINT, before)
