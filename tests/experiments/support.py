"""A session, a table and a kernel that several tests use."""

import csv
from argparse import Namespace
from pathlib import Path

from rich.console import Console

from experiments.evidence import Evidence
from experiments.harness import Session
from experiments.observation_rows import BENNU_ID, OSIRIS_REX_ID, Row, rows
from formulations.arrays import Array
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.mission.mission import Mission

SAMPLES = 1500


def session_in(out: Path, name: str = "study", version: int = 1) -> Session:
    """A session of a study that writes into a folder, in silence."""
    return Session(name, Namespace(), out, Console(quiet=True), Evidence.begun(name, version))


def quick_rows(as_flown: Path | None = None) -> list[Row]:
    """Rows of the table that take no IPOPT."""
    return [row for row in rows(as_flown) if "ipopt" not in row.key]


def table_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "observation_table.csv").open(encoding="utf-8", newline="") as file:
        return {row["row"]: row for row in csv.DictReader(file)}


def write_kernel(path: Path, mission: Mission, states: Array) -> Path:
    """Node states in m and m/s as an SPK of the flight, cubic between the nodes."""
    import spiceypy

    et = (mission.scenario.epoch.tdb - J2000_TDB).total_seconds() + mission.times_s
    handle = spiceypy.spkopn(str(path), "test", 0)
    spiceypy.spkw13(
        handle, OSIRIS_REX_ID, BENNU_ID, "J2000", et[0], et[-1], "flight", 3, len(et), states / 1e3, et
    )  # fmt: skip
    spiceypy.spkcls(handle)
    return path
