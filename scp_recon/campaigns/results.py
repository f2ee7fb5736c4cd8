"""Keep a row for each case that ends, and write `results.parquet` when all have ended.

Until then the rows are in `rows.jsonl`, a store of `jobs`, whose first line has the table's columns.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scp_recon.errors import InputError, imported, option
from scp_recon.files import unwritable, write_atomically
from scp_recon.jobs.store import Store, read_head, read_rows

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


def needing_parquet() -> Any:
    """Import pyarrow with its module for Parquet.

    Raises:
        InputError: if pyarrow is missing.
    """
    return imported("campaign", "campaign", "pyarrow", "pyarrow.parquet")


def open_rows(folder: Path, identity: str, columns: Mapping[str, type]) -> Store:
    """Open the store of a campaign's rows; columns are str, int, float or bool, one of them `case`.

    `identity` is a hash of everything that the rows depend on.

    Raises:
        InputError: if pyarrow is missing, or the folder cannot be written.
    """
    needing_parquet()
    kinds = {name: kind.__name__ for name, kind in columns.items()}
    return Store(folder / ROWS, {"campaign": identity, "columns": list(kinds.items())})


def write_results(folder: Path, rows: Store) -> Path:
    """Write `results.parquet`, and delete the store of its rows.

    Raises:
        InputError: if the folder cannot be written.
    """
    buffer = io.BytesIO()
    needing_parquet().parquet.write_table(_table(folder / ROWS), buffer)
    try:
        path = write_atomically(folder / RESULTS, buffer.getvalue())
    except OSError as error:
        raise unwritable(folder, option("out"), error) from None
    rows.forget()
    return path


def _table(path: Path) -> Any:
    """Rows in the order of the cases, as a table of pyarrow."""
    arrow = needing_parquet()
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
    arrow = needing_parquet()
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


def cell(value: Any, kind: type) -> Any:
    """Convert a value of an entry to its column's kind; in a column of text other kinds become JSON."""
    if kind is str:
        return value if isinstance(value, str) else json.dumps(value, default=str)
    return kind(value)


def kind_of(values: Iterable[Any]) -> type:
    """Kind of a column for these values; text if they are of several kinds."""
    known = list(values)
    kinds = {type(value) for value in known}
    if kinds == {bool}:
        return bool
    if kinds == {int} and all(abs(value) < 2**63 for value in known):
        return int
    return float if kinds <= {int, float} else str
