"""Write a plan's export in any format: tables, CCSDS messages or SPICE kernels.

A table, CSV or Parquet, has one row per state with its covariance, in SI, J2000, body-centred. A
burn's time has two rows: the last of one coast and the first of the next. `--init` and `scp-recon
new --from-csv` take the CSV.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np

from scp_recon.errors import imported, option
from scp_recon.files import check_own, write_atomically
from scp_recon.interop import ccsds, kernels
from scp_recon.interop.export import Export, heading
from scp_recon.scenario.time_scales import iso_tdb, iso_utc
from scp_recon.simulation.guidance import FlightPlan
from scp_recon.simulation.vehicle import Vehicle

FORMATS = ("oem", "spk", "ck", "csv", "parquet")
KERNELS = ("spk", "ck")
BINARY = (".bsp", "_body.bsp", ".bc")
TEXTS = {
    ".tls": kernels.leap_seconds,
    ".tpc": kernels.body_constants,
    ".tf": kernels.frames,
    ".tsc": kernels.clock,
}
NAME_MAX = 60
AXES = ("x", "y", "z", "vx", "vy", "vz")
STATE = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
COVARIANCE_UNITS = ("m2", "m2_s", "m2_s2")


def stem(export: Export) -> str:
    """Common part of the files' names: scenario, first digits of the plan's hash, spacecraft."""
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", export.mission.scenario.name)[:NAME_MAX]
    drift = f"_miss_{export.miss}" if export.miss else ""
    return f"{name}_{export.solution.plan_hash[:8]}_{abs(export.spacecraft)}{drift}"


def plan_in(name: str) -> str | None:
    """First digits of a plan's hash in the name of an exported file; None for other files."""
    found = re.search(r"_([0-9a-f]{8})_\d+(_miss_\d+)?(_body)?\.[a-z]+$", name)
    return found[1] if found else None


def require(form: str) -> None:
    """Check before the work that a format's extra is installed.

    Raises:
        InputError: if it is not.
    """
    if form in KERNELS:
        imported(option("format"), "spice", "spiceypy")
    elif form == "parquet":
        needing_pyarrow()


def columns(export: Export) -> dict[str, list[Any]]:
    """Columns by name with unit: time in three ways, coast, state, upper triangle of the covariance.

    `coast` is the number of burns before the row.
    """
    coasts = export.coasts
    times = np.concatenate([coast.times_s for coast in coasts])
    instants = [export.instant(time) for time in times.tolist()]
    states = np.concatenate([coast.states for coast in coasts])
    matrices = np.concatenate([coast.covariances for coast in coasts])
    found: dict[str, list[Any]] = {
        "t_s": times.tolist(),
        "tdb": [iso_tdb(when) for when in instants],
        "utc": [iso_utc(when) for when in instants],
        "coast": [i for i, coast in enumerate(coasts) for _ in coast.times_s],
        **{name: states[:, i].tolist() for i, name in enumerate(STATE)},
    }
    for i, j in combinations_with_replacement(range(6), 2):
        unit = COVARIANCE_UNITS[(i > 2) + (j > 2)]
        found[f"cov_{AXES[i]}_{AXES[j]}_{unit}"] = matrices[:, i, j].tolist()
    return found


def csv_text(export: Export) -> str:
    """The table as CSV, with the heading in lines that begin with #."""
    found = columns(export)
    text = io.StringIO()
    text.writelines(f"# {line}\n" for line in heading(export))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(found)
    writer.writerows(zip(*found.values(), strict=True))
    return text.getvalue()


def parquet_bytes(export: Export) -> bytes:
    """The table as Parquet, with the heading as metadata `scp_recon`.

    Raises:
        InputError: if pyarrow is missing.
    """
    pyarrow = needing_pyarrow()
    about: Mapping[str, str] = {"scp_recon": "\n".join(heading(export))}
    table = pyarrow.table(columns(export)).replace_schema_metadata(about)
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(table, buffer)
    return buffer.getvalue()


def needing_pyarrow() -> Any:
    """Import pyarrow with its module for Parquet.

    Raises:
        InputError: if pyarrow is missing.
    """
    return imported(option("format"), "parquet", "pyarrow", "pyarrow.parquet")


def contents(export: Export, form: str, vehicle: Vehicle) -> dict[str, str | bytes]:
    """Contents of a format's files by the ends of their names, but for the list of kernels.

    Raises:
        InputError: if an extra is missing, or the vehicle cannot fly the plan.
    """
    if form == "oem":
        return {".oem": ccsds.oem_text(export), ".opm": ccsds.opm_text(export)}
    if form == "csv":
        return {".csv": csv_text(export)}
    if form == "parquet":
        return {".parquet": parquet_bytes(export)}
    texts = {end: text(export) for end, text in TEXTS.items()}
    if form == "ck":
        flight = FlightPlan.of(export.solution, export.mission, vehicle)
        turns = kernels.attitude_segments(export, flight)
        return {".bc": kernels.binary(export, "ck", turns), **texts}
    return {
        ".bsp": kernels.binary(export, "spk", kernels.path_segments(export)),
        "_body.bsp": kernels.binary(export, "spk", kernels.body_segments(export)),
        **texts,
    }


def write_export(export: Export, form: str, folder: Path, vehicle: Vehicle) -> list[Path]:
    """Write a plan in one of `FORMATS` into an existing folder; the first kernel is the one to load.

    A vehicle adds a CK with its attitude.

    Raises:
        InputError: if an extra is missing, the vehicle cannot fly the plan, or there are files of these
            names that this program did not write.
        OSError: if a file cannot be written.
    """
    made, name = contents(export, form, vehicle), stem(export)
    if form in KERNELS:
        ends = [e for e in (*TEXTS, *BINARY) if e in made or (folder / f"{name}{e}").is_file()]
        made[".tm"] = kernels.meta_kernel(export, [f"{name}{end}" for end in ends])
    files = {folder / f"{name}{end}": content for end, content in made.items()}
    for path in files:  # every file holds its plan's hash in the heading
        check_own(path, option("out"), export.solution.plan_hash.encode())
    written = [write_atomically(path, content) for path, content in files.items()]
    return sorted(written, key=lambda path: path.suffix != ".tm")
