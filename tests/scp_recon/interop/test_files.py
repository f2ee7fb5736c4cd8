"""Tables of a plan, and a plan started from one."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from scp_recon.interop.export import Export
from scp_recon.interop.files import columns, csv_text, parquet_bytes


def test_the_csv_is_the_path_to_the_last_digit(export: Export) -> None:
    lines = [line for line in csv_text(export).splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert len(rows) == export.path.size
    states = np.concatenate([coast.states for coast in export.path.coasts])
    names = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")
    read = np.array([[float(row[name]) for name in names] for row in rows])
    np.testing.assert_array_equal(read, states)
    sigma = np.sqrt([float(row["cov_vz_vz_m2_s2"]) for row in rows])
    matrices = np.concatenate([coast.covariances for coast in export.path.coasts])
    np.testing.assert_allclose(sigma, np.sqrt(matrices[:, 5, 5]), rtol=1e-12)
    times, coasts = (np.array(columns(export)[name]) for name in ("t_s", "coast"))
    for number, burn in enumerate(export.solution.burns):
        assert coasts[times == burn.t_s].tolist() == [number, number + 1]  # two rows at a burn


def test_parquet_holds_the_same(export: Export) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    table = parquet.read_table(io.BytesIO(parquet_bytes(export)))
    assert table.to_pydict() == columns(export)
    about = table.schema.metadata[b"scp_recon"].decode()
    assert export.solution.plan_hash in about
    assert "J2000" in about
