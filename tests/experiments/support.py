"""What several tests of this wing use."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import numpy.typing as npt

from experiments.observation_table.as_flown import BENNU_ID, OSIRIS_REX_ID
from experiments.uncertainty_sources.flights import SETS, TRANSLATION, Flown
from scp_recon.mission.mission import Mission
from scp_recon.physics.frames import J2000_TDB
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.vehicle import Vehicle

SAMPLES = 1500
QUICK = ("--quick", "--skip-ipopt", "--samples", str(SAMPLES))


def table_of(out: Path) -> dict[str, dict[str, str]]:
    with (out / "observation_table.csv").open(encoding="utf-8", newline="") as file:
        return {row["row"]: row for row in csv.DictReader(file)}


def simulated(solution: Solution, _: Vehicle, job: tuple[str, int]) -> Flown:
    """A flight that ends 0.1 m off the plan for each source that errs, 100 m for those of the path."""
    error_sources, seed = job
    scale = sum(100.0 if source in TRANSLATION else 0.1 for source in SETS[error_sources])
    off = scale * np.random.default_rng([seed, len(error_sources)]).standard_normal(6)
    state = np.array(solution.nodes.state[-1]) + off * np.repeat([1.0, 1e-4], 3)
    return Flown(error_sources, seed, tuple(state.tolist()), 1e-4)


def write_kernel(path: Path, mission: Mission, states: npt.NDArray[np.float64]) -> Path:
    """Node states in m and m/s as an SPK of the flight, cubic between the nodes."""
    import spiceypy

    et = (mission.scenario.epoch.tdb - J2000_TDB).total_seconds() + mission.times_s
    handle = spiceypy.spkopn(str(path), "test", 0)
    spiceypy.spkw13(
        handle, OSIRIS_REX_ID, BENNU_ID, "J2000", et[0], et[-1], "flight", 3, len(et), states / 1e3, et
    )  # fmt: skip
    spiceypy.spkcls(handle)
    return path
