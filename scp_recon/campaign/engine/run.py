"""From cases to rows: what is missing is run, and every row is kept as it comes."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from scp_recon.campaign.engine.work import work_of
from scp_recon.campaign.rows.case import Case, Done, Runner, Work
from scp_recon.campaign.rows.table import RESULTS, ROWS, Store, cell, needing_parquet
from scp_recon.campaign.rows.versions import versions
from scp_recon.campaign.runners.child import Limits
from scp_recon.campaign.runners.processes import Processes
from scp_recon.campaign.study.study import Study
from scp_recon.errors import InputError
from scp_recon.files import check_writable, unwritable, write_atomically
from scp_recon.solution.runs import only_run_in

SCHEMA, FILE_NAME = "scp_recon.campaign/1", "campaign.json"
BEFORE: dict[str, type] = {"case": int}
AFTER: dict[str, type] = {"seed": int}
MEASURES: dict[str, type] = {"seconds": float, "cpu_s": float, "tries": int}

Observer = Callable[[int, int, Mapping[str, Any] | None], None]
"""Told how many rows there are, of how many, and the last one."""


def run_study(
    study: Study, folder: Path, runner: Runner | None = None, observe: Observer | None = None
) -> Path:
    """Run the cases of a study that have no row yet.

    Args:
        study: what to run.
        folder: for the results; what it holds of the same study is kept and continued.
        runner: where; one process of its own, if not given.
        observe: called after each row.

    Returns:
        The file `results.parquet`.

    Raises:
        InputError: if the folder cannot be written, is at work, or holds another campaign.
    """
    identity = {
        "hash": study.hash,
        "cases": len(study.cases),
        "entries": list(study.entries),
        "versions": versions(),
        "study": study.tables,
        "base": study.base.model_dump(mode="json", exclude_none=True),
    }
    runner = runner or Processes(1, limits_of(study))
    return run_cases(work_of(study), study.cases, folder, runner, identity, study.kinds, observe)


def limits_of(study: Study) -> Limits:
    """The limits of each case of a study."""
    return Limits(study.campaign.limit_s, study.campaign.memory_mb)


def run_cases(
    work: Work,
    cases: Sequence[Case],
    folder: Path,
    runner: Runner,
    identity: Mapping[str, Any],
    entries: Mapping[str, type],
    observe: Observer | None = None,
) -> Path:
    """Run the cases that have no row yet.

    Args:
        work: what is done with a case.
        cases: all of them, case i at place i.
        folder: for the results.
        runner: where.
        identity: of the campaign, as JSON; its `hash` decides whether what is there is continued.
        entries: kinds of the columns for the cases' changes: str, float or bool.
        observe: called after each row.

    Returns:
        The file `results.parquet`.

    Raises:
        InputError: as `run_study`.
    """
    needing_parquet()
    check_writable(folder, FILE_NAME, "--out")
    with only_run_in(folder, "--out"):
        _take(folder, identity)
        if (folder / RESULTS).is_file():
            if observe:
                observe(len(cases), len(cases), None)
            return folder / RESULTS
        columns = BEFORE | dict(entries) | AFTER | dict(work.columns) | MEASURES
        with closing(Store(folder, columns)) as store:
            if observe:
                observe(len(store.done), len(cases), None)
            missing = (cases[i] for i in range(len(cases)) if i not in store.done)
            over = runner(work, missing)
            try:
                for done in over:
                    row = row_of(done, entries)
                    store.add(row, done.found.files)
                    if observe:
                        observe(len(store.done), len(cases), row)
            finally:
                over.close()
            if len(store.done) != len(cases):
                raise RuntimeError(f"{len(store.done)} rows of {len(cases)} cases")
            return store.finish()


def row_of(done: Done, entries: Mapping[str, type]) -> dict[str, Any]:
    """A case that is over as a row."""
    case = done.case
    changes = {entry: cell(case.changes[entry], kind) for entry, kind in entries.items()}
    took = {"seconds": done.seconds, "cpu_s": done.cpu_s, "tries": done.tries}
    return {"case": case.number, **changes, "seed": case.seed, **done.found.row, **took}


def _take(folder: Path, identity: Mapping[str, Any]) -> None:
    """Make the folder this campaign's.

    Raises:
        InputError: if it is another's.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        _check_empty(folder)
    try:
        if not path.is_file():
            content = {"schema": SCHEMA, **identity}
            write_atomically(path, json.dumps(content, indent=1, default=str) + "\n")
            return
        found = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise unwritable(folder, "--out", error) from None
    except ValueError:
        found = None
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        raise InputError(
            "--out",
            f"{folder}, whose {FILE_NAME} is damaged or of another version",
            "must be a folder of its own",
        )
    if found.get("hash") != identity["hash"]:
        raise InputError(
            "--out",
            f"{folder}, which holds another campaign",
            f"must be a folder of its own, or of the same study{_differing(found, identity)}",
        )


def _check_empty(folder: Path) -> None:
    """No rows are there of which nobody can tell what they are of.

    Raises:
        InputError: if there are.
    """
    for name in (RESULTS, ROWS):
        if (folder / name).exists():
            raise InputError(
                "--out", f"{folder}, with {name} but no {FILE_NAME}", "must be a folder of its own"
            )


def _differing(found: Mapping[str, Any], identity: Mapping[str, Any]) -> str:
    """Which versions are not those that the rows were made with."""
    old, new = found.get("versions", {}), identity.get("versions", {})
    names = [
        f"{name} ({old.get(name)}, now {new[name]})" for name in new if old.get(name) != new[name]
    ]
    listed = f", and versions: {', '.join(names)}" if names else ""
    return f" and files that it names{listed}"
