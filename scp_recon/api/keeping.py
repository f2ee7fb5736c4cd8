"""Write a plan into the folder of a run, so that all files there belong to one plan.

A verified plan is overwritten only by a verified one. A plan that is not verified is written beside
it, under a name of its own.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from scp_recon.errors import InputError, option
from scp_recon.files import check_own, check_writable, only_run_in, set_aside, writing
from scp_recon.results.read import read_solution
from scp_recon.results.runs import is_pointer, new_run, point_to
from scp_recon.results.solution import FILE_NAME, Solution
from scp_recon.scp.status import Status

UNVERIFIED = "solution_unverified.json"
"""Name of the file of a plan that is not verified, beside a verified one."""
OLD = "old_"
"""Prefix of results of an earlier plan in the folder."""
EXPORTS = "export"
"""Folder of the plan's exports there."""
MARK = b'"schema": "scp_recon.solution/'
"""In every file of a plan."""


@contextmanager
def run_folder(out: Path | None, name: str) -> Iterator[Path]:
    """Yield the folder of a run, locked against other runs; new folders that stay empty are removed.

    Args:
        out: as the user gave it.
        name: of the scenario, where no folder was given.

    Raises:
        InputError: if it cannot be written, another run is at work in it, or it is `runs/latest`.
    """
    if out is not None and is_pointer(out):
        raise InputError(
            option("out"),
            f"{out}, which points to the last finished run",
            "must be a folder of its own",
        )
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
    """Make a folder for a plan, and refuse one that cannot be written or has another solution.json.

    Raises:
        InputError: if a plan cannot be written there.
    """
    check_writable(folder, FILE_NAME, entry)
    for name in (FILE_NAME, UNVERIFIED):
        check_own(folder / name, entry, MARK)


def point_latest(out: Path | None, folder: Path, status: int) -> None:
    """Let `runs/latest` point to a finished run.

    Args:
        out: as the user gave it; a run in a folder of one's own is not pointed to.
        folder: of the run.
        status: its exit status; an interrupted run is not finished.

    Raises:
        InputError: if the pointer cannot be written.
    """
    if out is None and status != Status.INTERRUPTED.value.exit_code:
        point_to(folder)


class Kept(NamedTuple):
    """Files of a plan.

    Attributes:
        path: of the plan; None if it is not kept.
        aside: results of other plans, under the names that they have now.
    """

    path: Path | None = None
    aside: tuple[Path, ...] = ()

    def then(self, later: Kept) -> Kept:
        """What is kept after a plan was written again."""
        return Kept(later.path, self.aside + later.aside)


def keep(solution: Solution, folder: Path | None, entry: str | None = None) -> Kept:
    """Write a plan into a folder, and set aside results of other plans there.

    Args:
        solution: the plan.
        folder: for its file; None to write none.
        entry: what to name in a message; the option of the folder by default.

    Raises:
        InputError: if the folder cannot be written.
    """
    if folder is None:
        return Kept()
    with writing(folder, entry or option("out")):
        if not _is_verified(solution) and _holds_verified(folder):
            return Kept(solution.write(folder, UNVERIFIED))
        path = solution.write(folder)
        (folder / UNVERIFIED).unlink(missing_ok=True)
        return Kept(path, tuple(_set_aside(solution, folder)))


def check_holds(folder: Path, solution: Solution, entry: str) -> None:
    """Refuse to write results of a plan beside another plan.

    Raises:
        InputError: if the folder holds another plan; names the entry.
    """
    if (folder / FILE_NAME).exists() and read_solution(folder).plan_hash != solution.plan_hash:
        given = f"{folder}, which holds another plan"
        raise InputError(entry, given, "must be a folder of its own")


@contextmanager
def results_beside(
    folder: Path, solution: Solution, name: str, entry: str, mark: bytes
) -> Iterator[None]:
    """Context in which results of a plan are made and written into a folder that only this run uses.

    Args:
        folder: folder for the results.
        solution: the plan.
        name: of the file of the results.
        entry: what to name in a message.
        mark: that such a file has: see `check_own`.

    Raises:
        InputError: if the folder cannot be written, holds another plan or a file of that name that
            this program did not write, or is in use.
    """
    check_writable(folder, name, entry)
    check_own(folder / name, entry, mark)
    check_holds(folder, solution, entry)
    with only_run_in(folder, entry):
        yield


def _is_verified(solution: Solution) -> bool:
    return solution.verification is not None and solution.verification.ok


def _holds_verified(folder: Path) -> bool:
    try:
        return _is_verified(read_solution(folder))
    except InputError:
        return False


def _set_aside(solution: Solution, folder: Path) -> list[Path]:
    """Rename results of other or unknown plans, and move exports of other plans."""
    results = (*folder.glob("montecarlo*.json"), *folder.glob("simulation*.npz"))
    aside = [
        set_aside(path, folder / f"{OLD}{path.name}")
        for path in results
        if path.is_file() and _plan_hash(path) != solution.plan_hash
    ]
    return aside + _set_exports_aside(solution, folder)


def _set_exports_aside(solution: Solution, folder: Path) -> list[Path]:
    """Move exports of other plans, so that no pattern of names finds two plans; other files stay."""
    exports, old = folder / EXPORTS, folder / f"{OLD}{EXPORTS}"
    if not exports.is_dir():
        return []
    from scp_recon.interop.files import plan_in

    found = {path: plan_in(path.name) for path in exports.iterdir()}
    others = [path for path, plan in found.items() if plan and solution.plan_hash[:8] != plan]
    if not others:
        return []
    old.mkdir(exist_ok=True)
    for path in others:
        set_aside(path, old / path.name)
    with suppress(OSError):  # other files are there
        exports.rmdir()
    return [old]


def _plan_hash(path: Path) -> str | None:
    """Hash of a result's plan; None if it cannot be read."""
    from scp_recon.monte_carlo.summary import read_summary  # not where there are no results
    from scp_recon.simulation.record import read_record

    try:
        found = read_summary(path) if path.suffix == ".json" else read_record(path)
    except InputError:
        return None
    return found.plan_hash
