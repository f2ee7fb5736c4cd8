"""Sessions, tables and flights that several tests of this wing use."""

import csv
from argparse import Namespace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console

from experiments.evidence import Evidence
from experiments.harness import Record, Session
from experiments.observation_rows import BENNU_ID, OSIRIS_REX_ID
from experiments.spacecraft.uncertainty_sources.flights import SETS, STATE, TRANSLATION
from formulations.arrays import Array
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.mission.mission import Mission
from scp_recon.results.solution import Solution
from scp_recon.simulation.vehicle import Vehicle

SAMPLES = 1500


def session_in(out: Path, name: str = "study", version: int = 1) -> Session:
    """A session of a study that writes into a folder, in silence."""
    return Session(name, Namespace(), out, Console(quiet=True), Evidence(name, version))


QUICK = ("--quick", "--skip-ipopt", "--samples", str(SAMPLES))


def table_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "observation_table.csv").open(encoding="utf-8", newline="") as file:
        return {row["row"]: row for row in csv.DictReader(file)}


def simulated(solution: Solution, _: Vehicle, job: tuple[str, int]) -> Record:
    """A flight that ends 0.1 m off the plan for each source that errs, 100 m for those of the path."""
    error_sources, seed = job
    scale = sum(100.0 if source in TRANSLATION else 0.1 for source in SETS[error_sources])
    off = scale * np.random.default_rng([seed, len(error_sources)]).standard_normal(6)
    state = np.array(solution.nodes.state[-1]) + off * np.repeat([1.0, 1e-4], 3)
    return flown(error_sources, seed, state, 1e-4)


def flown(error_sources: str, seed: int, state: ArrayLike, off_rad: float = 0.0) -> Record:
    ends = dict(zip(STATE, np.asarray(state).tolist(), strict=True))
    return {"error_sources": error_sources, "seed": seed, **ends, "attitude_error_rad": off_rad}


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
