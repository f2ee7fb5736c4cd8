"""One case of a campaign as data: what is asked, what is found, and what it took."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, NamedTuple, Protocol

from scp_recon.errors import InputError, printable

SOLUTIONS = "solutions"
REFUSED, FAILED, OUT_OF_MEMORY = "refused", "failed", "out of memory"
TIMED_OUT, DIED = "timed out", "died"


class Case(NamedTuple):
    """What is asked; it depends on the study and its number alone.

    Attributes:
        number: from 0.
        seed: of whatever it draws.
        changes: values by dotted entry of the scenario.
    """

    number: int
    seed: int
    changes: Mapping[str, Any]


class Found(NamedTuple):
    """What a case came to.

    Attributes:
        row: values by column; the case's own columns are added to them.
        files: contents by path in the campaign's folder.
    """

    row: Mapping[str, Any]
    files: Mapping[str, bytes] = {}


class Done(NamedTuple):
    """A case that is over: what it came to, its wall and processor time in s, how often it was tried.

    The processor time is None where its process died, which takes that knowledge with it.
    """

    case: Case
    found: Found
    seconds: float
    cpu_s: float | None
    tries: int


class Work(Protocol):
    """Runs a case. It pickles, and what it finds depends on the case alone.

    Attributes:
        columns: what its rows may hold: str, int, float or bool by column.
    """

    @property
    def columns(self) -> Mapping[str, type]:
        """Kinds by column."""
        ...

    def __call__(self, case: Case, /) -> Found:
        """What the case comes to; whatever it raises becomes a row too."""
        ...


Runner = Callable[[Work, Iterable[Case]], Generator[Done, None, None]]
"""Runs cases, taken one by one, and gives them as they are over; closed early, it ends its work."""


@dataclass
class Stopwatch:
    """Wall and processor time since it was made, s."""

    wall: float = field(default_factory=perf_counter)
    cpu: float = field(default_factory=process_time)

    def read(self) -> tuple[float, float]:
        """Wall and processor time so far, s."""
        return perf_counter() - self.wall, process_time() - self.cpu


def attempt(work: Work, case: Case) -> Done:
    """Run a case; whatever it raises is what it came to.

    Raises:
        KeyboardInterrupt: the user's.
    """
    watch = Stopwatch()
    try:
        found = work(case)
    except InputError as error:
        found = trouble(REFUSED, str(error))
    except MemoryError:
        found = trouble(OUT_OF_MEMORY, "more memory than a case may take")
    except (Exception, SystemExit) as error:  # a case that fails is a row, not an end
        found = trouble(FAILED, f"{type(error).__name__}: {error}")
    return Done(case, found, *watch.read(), 1)


def trouble(status: str, message: str) -> Found:
    """What a case without a result came to: how it ended, and why."""
    return Found({"status": status, "message": printable(message)})


def solution_path(folder: Path, number: int) -> Path:
    """File of a case's solution in a campaign's folder, there if solutions are kept."""
    return folder / solution_name(number)


def solution_name(number: int) -> str:
    """Path of a case's solution in the campaign's folder; it has its own, which every command takes."""
    return f"{SOLUTIONS}/case-{number:07d}/solution.json"
