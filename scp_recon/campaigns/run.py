"""Run the cases of a study that have no row yet, keep each row when its case ends, and read the rows.

Rows are in `rows.jsonl`, a store of `jobs`, whose first line has the table's columns, and in
`results.parquet` once all cases have ended.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scp_recon.campaigns.axes import SOLUTIONS, Case
from scp_recon.campaigns.study import VERSION, Study
from scp_recon.errors import InputError, imported, option
from scp_recon.files import check_writable, only_run_in, write_atomically, writing
from scp_recon.jobs.cluster import executor_for
from scp_recon.jobs.job import Done, Executor, Job, Key
from scp_recon.jobs.processes import Limits
from scp_recon.jobs.store import Row, Store, read_head, read_rows, run, versions

if TYPE_CHECKING:
    import pandas

RESULTS, ROWS = "results.parquet", "rows.jsonl"
VERIFIED = "verified"
FIXED: dict[str, type] = {
    "status": str,
    "verdict": str,
    "total_dv_m_s": float,
    "dv99_m_s": float,
    "final_sigma_m": float,
    "probability": float,
    "probability_of": str,
    "asked": float,
    "binds": str,
    "iterations": int,
    "plan_hash": str,
    "warnings": str,
    "message": str,
}
"""Columns of every study. The probability is the lowest of the joint constraints, of nonlinear flights;
`binds` is the limit that an infeasible plan breaks most."""
OWN: dict[str, dict[str, type]] = {
    "plan": {},
    "design": {
        "departure_tdb": str,
        "duration_s": float,
        "burns": int,
    },
    "replan": {"rest_status": str, "rest_dv_m_s": float, "rest_times_s": str},
    "certify": {"certified": float, "certified_low": float, "target": float, "rounds": int},
    "fly": {
        "flights": int,
        "flown_lowest": float,
        "flown_lowest_of": str,
        "flown_whole": float,
        "flown_whole_low": float,
        "flown_whole_high": float,
        "flown_dv99_m_s": float,
        "flown_final_sigma_m": float,
        "flown_shortfalls": str,
    },
    "simulate": {
        "least_charge": float,
        "miss_position_m": float,
        "miss_velocity_m_s": float,
        "simulated_shortfalls": str,
    },
}
"""Columns by the study's `do`."""
MEASURED: dict[str, type] = {"seconds": float, "cpu_s": float, "tries": int}
"""Columns that differ from run to run; all others are the same to the last bit."""
BATCH = 5_000
"""Rows that are held as Python's objects at a time."""
KINDS = {"str": "string", "int": "int64", "float": "float64", "bool": "bool_"}
"""Types of pyarrow by the names of Python's."""
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
    _arrow()
    check_writable(folder, FILE_NAME, option("out"))
    cases, observe = study.cases, observe or (lambda _done, _total, _row: None)
    own = FIXED | OWN[study.campaign.do] | MEASURED
    columns = {"case": int} | study.kinds | {"seed": int} | own
    depends_on = {"campaign": study.hash, "columns": [(n, k.__name__) for n, k in columns.items()]}
    with only_run_in(folder, option("out")):
        _take(folder, study)
        if (folder / RESULTS).is_file():
            observe(len(cases), len(cases), None)
            return folder / RESULTS
        with Store(folder / ROWS, depends_on) as rows:

            def on_done(_: Key, row: Mapping[str, Any]) -> None:
                observe(len(rows), len(cases), row)

            observe(len(rows), len(cases), None)
            jobs = (Job(number, cases[number]) for number in range(len(cases)))
            run(work, jobs, rows, executor, row_of=partial(_row_of, study), on_done=on_done)
            if len(rows) != len(cases):
                raise RuntimeError(f"{len(rows)} rows of {len(cases)} cases")
            buffer = io.BytesIO()
            _arrow().parquet.write_table(_table(folder / ROWS), buffer)
            with writing(folder, option("out")):
                path = write_atomically(folder / RESULTS, buffer.getvalue())
            rows.forget()
            return path


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
    path, kept = folder / FILE_NAME, (SOLUTIONS,) if study.campaign.keep_solutions else ()
    given, allowed, found = "", "", None
    with writing(folder, option("out")):
        if path.is_file():
            with suppress(ValueError):
                found = json.loads(path.read_text("utf-8"))
            if not isinstance(found, dict) or found.get("schema") != SCHEMA:
                given = f"whose {FILE_NAME} is damaged or of another version"
            elif found.get("hash") != identity["hash"]:
                given = "which holds another campaign"
                allowed = ", or of the same study and files that it names"
                if found.get("version") != VERSION:
                    allowed += f", and version {VERSION} of the work, not {found.get('version')}"
        elif there := [name for name in (RESULTS, ROWS, *kept) if (folder / name).exists()]:
            given = f"with {there[0]} but no {FILE_NAME}"
        else:
            content = {"schema": SCHEMA, **identity}
            write_atomically(path, json.dumps(content, indent=1, default=str) + "\n")
    if given:
        allowed = f"must be a folder of its own{allowed}"
        raise InputError(option("out"), f"{folder}, {given}", allowed)


def cell(value: Any, kind: type) -> Any:
    """Convert a value of an entry to its column's kind; in a column of text other kinds become JSON."""
    if kind is str:
        return value if isinstance(value, str) else json.dumps(value, default=str)
    return kind(value)


def _arrow() -> Any:
    """Pyarrow with its module for Parquet; InputError if it is missing."""
    return imported("campaign", "campaign", "pyarrow", "pyarrow.parquet")


def _table(path: Path) -> Any:
    """Rows in the order of the cases, as a table of pyarrow."""
    arrow = _arrow()
    columns = read_head(path)["columns"]
    schema = arrow.schema([(name, getattr(arrow, KINDS[kind])()) for name, kind in columns])
    parts, rows = [schema.empty_table()], (row for _, row in read_rows(path))
    while batch := list(islice(rows, BATCH)):
        parts.append(arrow.Table.from_pylist(batch, schema=schema))
    return arrow.concat_tables(parts).sort_by("case")


def read_results(folder: Path) -> pandas.DataFrame:
    """Read the rows of a campaign by case, finished or not; unknown values are missing.

    Raises:
        InputError: if the folder holds no campaign, or the extra is missing.
    """
    arrow = _arrow()
    imported("campaign", "campaign", "pandas")
    path = folder / RESULTS
    try:
        table = arrow.parquet.read_table(path) if path.is_file() else _table(folder / ROWS)
    except FileNotFoundError:
        raise InputError("folder", f"{folder}, without rows", "must hold a campaign") from None
    except (OSError, ValueError, KeyError, arrow.ArrowException) as error:
        raise InputError("folder", str(error)[:200], "must hold a campaign") from None
    if not len(table):
        raise InputError("folder", f"{folder}, without rows", "must hold a campaign")
    found: pandas.DataFrame = table.to_pandas()
    return found
