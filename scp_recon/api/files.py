"""Read, keep, show and export plans: what the functions of `api.plan_verbs` do with files.

A verified plan is overwritten only by a verified one. A plan that is not verified is written beside
it, under a name of its own.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from scp_recon.errors import (
    InputError,
    option,
    shortened,
)
from scp_recon.files import check_own, check_writable, only_run_in, set_aside, writing
from scp_recon.interop.export import Export
from scp_recon.jobs.cores import one_thread
from scp_recon.planning.plan import Plan
from scp_recon.results.read import is_pointer, new_run, read_solution, resolve_run
from scp_recon.results.solution import FILE_NAME, Solution, make_solution
from scp_recon.verification import reintegration

AnyPlan = Plan | Solution | str | Path
"""A plan, a solution, or the file or folder of one."""

SPACECRAFT_MIN = -99_999
"""NAIF's numbers of spacecraft are below zero; their axes have a thousand times that, and SPICE counts
to 2^31."""
FIELD_MAX_DEG, PIXELS_MAX = 170.0, 1_000_000
CAMPAIGN, PLANS_ALONE = "campaign.json", "plans, not with a campaign"


def solution_of(given: AnyPlan) -> Solution:
    """The solution of a plan; a plan that was not verified stays so."""
    return make_solution(given) if isinstance(given, Plan) else stored(given)


def stored(plan: AnyPlan) -> Solution:
    """See `plan_verbs.load`."""
    if isinstance(plan, Plan):
        return verified(make_solution(plan))
    if isinstance(plan, Solution):
        return plan
    require_some((plan,))
    return read_solution(resolve_run(Path(plan)))


@one_thread
def verified(solution: Solution) -> Solution:
    """A solution with its verification, without the solver."""
    return solution.with_verification(reintegration.verify(solution.mission, solution))


def shown_of(plans: tuple[AnyPlan, ...]) -> list[Solution | Path]:
    """Plans as a report takes them: solutions, or paths, which have results beside them."""
    return [stored(p) if isinstance(p, Plan | Solution) else Path(p) for p in plans]


def is_campaign(plans: tuple[AnyPlan, ...]) -> bool:
    """Whether the argument is the folder of a campaign."""
    given = plans[0]
    return len(plans) == 1 and isinstance(given, str | Path) and (Path(given) / CAMPAIGN).is_file()


def require_some(plans: tuple[object, ...]) -> None:
    """Refuse no plans, and what is no plan."""
    if not plans:
        raise InputError("plans", "none", "must be one or more")
    for given in plans:
        if not isinstance(given, Plan | Solution | str | Path):
            raise InputError("plan", shortened(given), "must be a plan, a solution or its file")


class Exported(NamedTuple):
    """The files of an export.

    Attributes:
        files: paths of the files.
        export: verdict, frame, path and burns, as in the files' headings.
    """

    files: list[Path]
    export: Export

    def __repr__(self) -> str:
        """One line."""
        return f"<Exported: {', '.join(file.name for file in self.files)}>"


# --- the folder of a run: all files there belong to one plan -------------------------------------

UNVERIFIED = "solution_unverified.json"
"""Name of the file of a plan that is not verified, beside a verified one."""
OLD = "old_"
"""Prefix of results of an earlier plan in the folder."""
EXPORTS = "export"
"""Folder of the plan's exports there."""
MARK = b'"schema": "scp_recon.solution/'
"""Text in every file of a plan."""


@contextmanager
def run_folder(out: Path | None, name: str) -> Iterator[Path]:
    """Yield the folder of a run, locked against other runs; new folders that stay empty are removed.

    Without `out` it is a new one that is named after the scenario.
    """
    if out is not None and is_pointer(out):
        given = f"{out}, which points to the last finished run"
        raise InputError(option("out"), given, "must be a folder of its own")
    folder = new_run(name) if out is None else out
    try:
        check_folder(folder, option("out"))
        with only_run_in(folder, option("out")):
            yield folder
    finally:
        if out is None:
            with suppress(OSError):  # it is not empty, or those above it are not
                os.removedirs(folder)


def check_folder(folder: Path, entry: str) -> None:
    """Make a folder for a plan, and refuse one that cannot be written or has another solution.json."""
    check_writable(folder, FILE_NAME, entry)
    for name in (FILE_NAME, UNVERIFIED):
        check_own(folder / name, entry, MARK)


Kept = tuple[Path | None, tuple[Path, ...]]
"""The file of a plan, if it is kept; and results of other plans, under the names that they have now."""


def keep(solution: Solution, folder: Path | None, entry: str | None = None) -> Kept:
    """Write a plan into a folder, if one is given, and set aside results of other plans there."""
    if folder is None:
        return None, ()
    with writing(folder, entry or option("out")):
        with suppress(InputError):  # there is no plan yet
            if not _is_verified(solution) and _is_verified(read_solution(folder)):
                return solution.write(folder, UNVERIFIED), ()
        path = solution.write(folder)
        (folder / UNVERIFIED).unlink(missing_ok=True)
        return path, tuple(_set_aside(solution, folder))


@contextmanager
def results_beside(
    folder: Path, solution: Solution, name: str, entry: str, mark: bytes
) -> Iterator[None]:
    """Context in which results of a plan are made and written into a folder that only this run uses.

    Raises:
        InputError: if the folder cannot be written, holds another plan or a file of that name without
            the mark (see `check_own`), or is in use; names the entry.
    """
    check_writable(folder, name, entry)
    check_own(folder / name, entry, mark)
    if (folder / FILE_NAME).exists() and read_solution(folder).plan_hash != solution.plan_hash:
        given = f"{folder}, which holds another plan"
        raise InputError(entry, given, "must be a folder of its own")
    with only_run_in(folder, entry):
        yield


def _is_verified(solution: Solution) -> bool:
    return solution.verification is not None and solution.verification.ok


def _set_aside(solution: Solution, folder: Path) -> Iterator[Path]:
    """Rename results of other or unknown plans, and move exports of other plans.

    No pattern of names then finds exports of two plans; other files stay.
    """
    for path in (*folder.glob("montecarlo*.json"), *folder.glob("simulation*.npz")):
        if path.is_file() and _plan_hash(path) != solution.plan_hash:
            yield set_aside(path, folder / f"{OLD}{path.name}")
    exports, old = folder / EXPORTS, folder / f"{OLD}{EXPORTS}"
    if not exports.is_dir():
        return
    from scp_recon.interop.files import plan_in

    found = {path: plan_in(path.name) for path in exports.iterdir()}
    others = [path for path, plan in found.items() if plan and solution.plan_hash[:8] != plan]
    if others:
        old.mkdir(exist_ok=True)
        for path in others:
            set_aside(path, old / path.name)
        with suppress(OSError):  # other files are there
            exports.rmdir()
        yield old


def _plan_hash(path: Path) -> str | None:
    """Hash of a result's plan; None if it cannot be read."""
    from scp_recon.monte_carlo.summary import read_summary  # not where there are no results
    from scp_recon.simulation.record import read_record

    try:
        found = read_summary(path) if path.suffix == ".json" else read_record(path)
    except InputError:
        return None
    return found.plan_hash
