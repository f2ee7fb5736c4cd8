"""Read the plans of a report, with the flights and the simulation beside each file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo import summary as summary_file
from scp_recon.monte_carlo.summary import Summary, read_summary
from scp_recon.results.comparison import path_of
from scp_recon.results.read import read_solution
from scp_recon.results.runs import folder_of, resolve_run
from scp_recon.results.solution import Solution
from scp_recon.scenario.time_scales import instant, iso_tdb
from scp_recon.simulation import record as record_file
from scp_recon.simulation.record import Record, read_record

PLANS_MAX = 6
"""Colours that people without full colour vision tell apart."""
PARTS_PER_ARC = 3
"""Points of a path between two nodes."""


@dataclass(frozen=True, eq=False)
class Subject:
    """A plan with the flights and the simulation of this very plan, if they lie beside it.

    `missed` are flights in which a burn is missed, with the way home if that was planned.
    `passed_over` names the files beside it that belong to another plan, with the reason.
    """

    name: str
    solution: Solution
    summary: Summary | None = None
    record: Record | None = None
    passed_over: tuple[str, ...] = ()
    missed: tuple[Summary, ...] = ()

    @cached_property
    def mission(self) -> Mission:
        """The scenario resolved."""
        return self.solution.mission

    @property
    def nodes_s(self) -> Array:
        """Times of the nodes, shape (n,)."""
        return np.array(self.solution.nodes.t_s)

    @cached_property
    def fine_s(self) -> Array:
        """The nodes' times and even ones between, shape (n,)."""
        nodes, parts = self.nodes_s, np.arange(PARTS_PER_ARC) / PARTS_PER_ARC
        inner = nodes[:-1, None] + np.diff(nodes)[:, None] * parts
        return np.append(inner.ravel(), nodes[-1])

    @property
    def window_s(self) -> tuple[float, float]:
        """Rest of the observation window after the plan's start; empty (end first) once it is over."""
        over = float(self.nodes_s[0]), self.mission.schedule.window_s[1]
        return self.mission.observed_s or over

    def looks_s(self, count: int) -> Array:
        """Even times in the rest of the window, shape (count,); empty after the window."""
        return np.linspace(*self.window_s, count if self.mission.observed_s else 0)

    def positions(self, times_s: Array) -> Array:
        """The planned mean, J2000, m, shape (n, 3): a cubic of the nodes' states between them."""
        return path_of(self.solution)(times_s)


def subjects_of(given: Sequence[Solution | Path]) -> list[Subject]:
    """Plans with what lies beside their files.

    Raises:
        InputError: if there is none or there are too many, one cannot be read, or they are of
            several bodies, or of one at several epochs.
    """
    if not 1 <= len(given) <= PLANS_MAX:
        raise InputError("plans", f"{len(given)}", f"must be 1 to {PLANS_MAX} plans")
    names = [str(resolve_run(one)) if isinstance(one, Path) else one.scenario.name for one in given]
    found = [
        _read(one, name) if isinstance(one, Path) else Subject(name, one)
        for one, name in zip(given, _distinct(names), strict=True)
    ]
    first = found[0].solution.scenario.body
    for subject in found[1:]:
        other = subject.solution.scenario.body
        if other.name != first.name:
            raise InputError(
                f"plan {subject.name}",
                f"body {other.name}",
                f"must be of {first.name}, as the first",
            )
        if subject.mission.rotation != found[0].mission.rotation:
            raise InputError(
                f"plan {subject.name}",
                f"a body that is turned otherwise, t = 0 at {_begins(subject)}",
                f"must be as the first, t = 0 at {_begins(found[0])}: one view shows one body "
                "(`scp-recon compare` shows the figures of any)",
            )
    return found


def _begins(subject: Subject) -> str:
    return f"{iso_tdb(instant(subject.solution.scenario.epoch.tdb))} TDB"


def _distinct(names: list[str]) -> list[str]:
    """Number the names that occur more than once."""
    return [
        f"{name} ({names[: i + 1].count(name)})" if names.count(name) > 1 else name
        for i, name in enumerate(names)
    ]


def _read(path: Path, name: str) -> Subject:
    home = resolve_run(path)
    solution, folder = read_solution(home), folder_of(home)
    passed_over, record = list[str](), None

    def flights(names: str) -> list[Summary]:
        """Those of the plan, in files beside it."""
        found = {file: read_summary(file) for file in sorted(folder.glob(names))}
        others = [file for file, one in found.items() if not one.is_of(solution)]
        passed_over.extend(f"{file}: flights of another plan" for file in others)
        return [one for one in found.values() if one.is_of(solution)]

    summary = next(iter(flights(summary_file.FILE_NAME)), None)
    missed = tuple(one for one in flights(summary_file.MISSES) if one.drift is not None)
    if (folder / record_file.FILE_NAME).is_file():
        record = read_record(folder)
        if record.plan_hash != solution.plan_hash:
            passed_over.append(f"{folder / record_file.FILE_NAME}: a simulation of another plan")
            record = None
    return Subject(name, solution, summary, record, tuple(passed_over), missed)
