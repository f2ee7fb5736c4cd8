"""A plan as a table, CSV or Parquet: a row a state, with its covariance, in SI, J2000, body-centred.

At a burn's time there are two rows: the last of one coast and the first of the next. `--init` and
`python -m scp_recon.new --from-csv` take the CSV.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from scp_recon.errors import needing
from scp_recon.exchange.heading import Export, heading
from scp_recon.physics.time_scales import iso_tdb, iso_utc

AXES = ("x", "y", "z", "vx", "vy", "vz")
STATE = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
COVARIANCE_UNITS = ("m2", "m2_s", "m2_s2")


def columns(export: Export) -> dict[str, list[Any]]:
    """Names with units to values: time in three ways, coast, state, upper triangle of the covariance.

    `coast` counts the burns before: 0 until the first one.
    """
    coasts = export.path.coasts
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
    """With the heading in lines that begin with #."""
    found = columns(export)
    text = io.StringIO()
    text.writelines(f"# {line}\n" for line in heading(export))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(found)
    writer.writerows(zip(*found.values(), strict=True))
    return text.getvalue()


def parquet_bytes(export: Export) -> bytes:
    """With the heading as metadata `scp_recon`.

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
    """The package pyarrow, with its module for Parquet.

    Raises:
        InputError: if there is none.
    """
    with needing("--format", "parquet", "pyarrow"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow
