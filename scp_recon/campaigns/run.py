"""Run the cases of a study that have no row yet, and keep every row when its case ends."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from scp_recon.campaigns.axes import SOLUTIONS, Case
from scp_recon.campaigns.results import (
    FIXED,
    MEASURED,
    OWN,
    RESULTS,
    ROWS,
    cell,
    needing_parquet,
    open_rows,
    write_results,
)
from scp_recon.campaigns.study import VERSION, Study
from scp_recon.errors import InputError, option
from scp_recon.files import check_writable, only_run_in, unwritable, write_atomically
from scp_recon.jobs.cluster import executor_for
from scp_recon.jobs.job import Done, Executor, Job, Key
from scp_recon.jobs.processes import Limits
from scp_recon.jobs.store import Row, run, versions

SCHEMA, FILE_NAME = "scp_recon.campaign/1", "campaign.json"

Observer = Callable[[int, int, Mapping[str, Any] | None], None]
"""Called with the number of rows so far, of all, and the last row."""
CaseWork = Callable[[Case], Row]
"""Makes a case's row and files; must pickle, and depend on the case alone."""


def executor_of(
    study: Study, workers: int, scheduler: str | None, say: Callable[[str], None] = lambda _: None
) -> Executor:
    """Choose the executor of a study's cases, each within the study's limits: see `executor_for`."""
    asked = sorted(study.campaign.model_fields_set & {"limit_s", "memory_mb"})
    if asked and not workers and scheduler is None:
        say(f"{' and '.join(asked)}: not kept with --workers 0, where no case can be ended")
    limits = Limits(study.campaign.limit_s, memory_mb=study.campaign.memory_mb)
    return executor_for(workers, scheduler, limits, say)


def run_study(
    study: Study,
    folder: Path,
    work: CaseWork,
    executor: Executor,
    observe: Observer | None = None,
) -> Path:
    """Run the cases of a study that have no row yet, and return the file `results.parquet`.

    Rows of the same study in the folder are kept and continued.

    Raises:
        InputError: if the folder cannot be written, is in use, or holds another campaign.
    """
    needing_parquet()
    check_writable(folder, FILE_NAME, option("out"))
    cases, observe = study.cases, observe or (lambda _done, _total, _row: None)
    own = FIXED | OWN[study.campaign.do] | MEASURED
    columns = {"case": int} | study.kinds | {"seed": int} | own
    with only_run_in(folder, option("out")):
        _take(folder, study)
        if (folder / RESULTS).is_file():
            observe(len(cases), len(cases), None)
            return folder / RESULTS
        with open_rows(folder, study.hash, columns) as rows:

            def on_done(_: Key, row: Mapping[str, Any]) -> None:
                observe(len(rows), len(cases), row)

            observe(len(rows), len(cases), None)
            jobs = (Job(number, cases[number]) for number in range(len(cases)))
            run(work, jobs, rows, executor, row_of=partial(_row_of, study), on_done=on_done)
            if len(rows) != len(cases):
                raise RuntimeError(f"{len(rows)} rows of {len(cases)} cases")
            return write_results(folder, rows)


def _row_of(study: Study, done: Done) -> Row:
    """Row of a case that has ended."""
    case: Case = study.cases[int(done.key)]
    found: Row = done.value
    if done.failure is not None:
        found = Row({"status": done.failure.status, "message": done.failure.message})
    changes = {entry: cell(case.changes[entry], kind) for entry, kind in study.kinds.items()}
    took = {"seconds": done.seconds, "cpu_s": done.cpu_s, "tries": done.tries}
    values = {"case": case.number, **changes, "seed": case.seed, **found.values, **took}
    return Row(values, found.files)


def _take(folder: Path, study: Study) -> None:
    """Claim a folder for this campaign.

    Raises:
        InputError: if it holds another campaign, or rows of an unknown one.
    """
    identity = {
        "hash": study.hash,
        "cases": len(study.cases),
        "entries": list(study.entries),
        "version": VERSION,
        "versions": versions(),
        "study": study.tables,
        "base": study.base.model_dump(mode="json", exclude_none=True),
    }
    path = folder / FILE_NAME

    def refused(given: str, allowed: str = "") -> InputError:
        allowed = f"must be a folder of its own{allowed}"
        return InputError(option("out"), f"{folder}, {given}", allowed)

    kept = (SOLUTIONS,) if study.campaign.keep_solutions else ()
    for name in (RESULTS, ROWS, *kept):
        if (folder / name).exists() and not path.is_file():
            raise refused(f"with {name} but no {FILE_NAME}")
    try:
        if not path.is_file():
            content = {"schema": SCHEMA, **identity}
            write_atomically(path, json.dumps(content, indent=1, default=str) + "\n")
            return
        found = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise unwritable(folder, option("out"), error) from None
    except ValueError:
        found = None
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        raise refused(f"whose {FILE_NAME} is damaged or of another version")
    if found.get("hash") != identity["hash"]:
        same = ", or of the same study and files that it names"
        if found.get("version") != VERSION:
            same += f", and version {VERSION} of the work, not {found.get('version')}"
        raise refused("which holds another campaign", same)
