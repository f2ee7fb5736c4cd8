"""Flights with chosen sources of uncertainty: many of the path alone, some of the whole spacecraft."""

from __future__ import annotations

import csv
import importlib
import json
import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import numpy.typing as npt

from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.solution.file import Solution
from scp_recon.spacecraft.basilisk.optional import needing_basilisk
from scp_recon.spacecraft.vehicle import Vehicle

Array = npt.NDArray[np.float64]

INITIAL, CHEMICAL = "initial_state", "chemical_thruster"
TRANSLATION = (INITIAL, CHEMICAL)
"""Sources that act on the path directly."""

ATTITUDE = ("sun_sensor", "star_tracker", "imu", "micro_thruster")
"""Sources that act on the path by way of the attitude; names are those of the vehicle's errors."""

NO_ERRORS = "none"

SETS: dict[str, tuple[str, ...]] = {
    NO_ERRORS: (),
    **{source: (source,) for source in (*ATTITUDE, *TRANSLATION)},
    "attitude": ATTITUDE,
    "all": (*ATTITUDE, *TRANSLATION),
}
"""What errs together."""

BLOCK = 1000
STATE = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s")


def fly_paths(
    solution: Solution, vehicle: Vehicle, sources: Iterable[str], samples: int, seed: int
) -> Array:
    """Final states of flights in the planner's dynamics, J2000, m and m/s, shape (samples, 6).

    The initial state errs by component and each burn in size: a thrust error does not turn a burn.
    """
    mission = Mission.from_scenario(solution.scenario)
    errors, units, chosen = vehicle.errors, mission.units, set(sources)
    sigma = errors.initial_state * np.abs(mission.initial_state) * (INITIAL in chosen)
    beta = errors.chemical_thruster * (CHEMICAL in chosen)
    ends = []
    for block, first in enumerate(range(0, samples, BLOCK)):
        draws = np.random.default_rng([seed, block]).standard_normal(
            (BLOCK, 6 + len(solution.burns))
        )[: samples - first]
        initial = (mission.initial_state + draws[:, :6] * sigma) / units.state
        executed = solution.burns_m_s * (1.0 + beta * draws[:, 6:, None]) / units.speed_m_s
        ends.append(mission.dynamics.rollout(initial, executed)[-1] * units.state)
    return np.concatenate(ends)


@dataclass(frozen=True)
class Flown:
    """One flight of the whole spacecraft.

    Attributes:
        error_sources: key of `SETS`.
        seed: of its errors.
        state: at the planned end, the last burn done, J2000, m and m/s.
        attitude_error_rad: angle between attitude and command when the last burn begins.
    """

    error_sources: str
    seed: int
    state: tuple[float, ...]
    attitude_error_rad: float


def simulator() -> ModuleType:
    """The simulation of the whole spacecraft, which takes seconds to import.

    Raises:
        InputError: if Basilisk is not there.
    """
    with needing_basilisk("--flights"):
        return importlib.import_module("scp_recon.spacecraft.basilisk.simulation")


def fly_spacecraft(solution: Solution, vehicle: Vehicle, job: tuple[str, int]) -> Flown:
    """Simulate one flight: (error sources, seed).

    Raises:
        InputError: if Basilisk is not there.
    """
    simulation = simulator()
    error_sources, seed = job
    flight = simulation.simulate(
        solution,
        vehicle,
        seed,
        sources=[simulation.Source(name) for name in SETS[error_sources]],
        initial_sigma_fraction=vehicle.errors.initial_state,
    )
    at = int(np.searchsorted(flight.times_s, flight.plan.firings[-1].start_s))
    off = (flight.commands[at].inv() * flight.attitudes[at]).magnitude()
    return Flown(error_sources, seed, tuple(flight.terminal_state.tolist()), float(off))


class Logbook:
    """Flights of the whole spacecraft in a folder, so that a study can go on where it stopped.

    Args:
        folder: of the flights and of what they belong to; flights of another plan or vehicle, or
            such as cannot be read, are forgotten.
        solution: plan.
        vehicle: that flies it.
    """

    def __init__(self, folder: Path, solution: Solution, vehicle: Vehicle) -> None:
        self._file = folder / "uncertainty_flights.csv"
        self._setting = json.dumps(
            {
                "scenario": solution.scenario.model_dump(mode="json"),
                "burns": solution.burns_m_s.tolist(),
                "vehicle": vehicle.model_dump(mode="json"),
            }
        )
        self._belongs = folder / "uncertainty_setting.json"
        self.flown: dict[tuple[str, int], Flown]
        try:
            same = self._belongs.read_text("utf-8") == self._setting
            self.flown = dict(self._read()) if same else {}
        except (OSError, ValueError, KeyError):  # nothing there, or nothing that can be read
            self.flown = {}

    def _read(self) -> Iterator[tuple[tuple[str, int], Flown]]:
        with self._file.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                job = row["error_sources"], int(row["seed"])
                state = tuple(float(row[name]) for name in STATE)
                yield job, Flown(*job, state, float(row["attitude_error_rad"]))

    def add(self, flown: Flown) -> None:
        """Keep a flight."""
        if not self.flown:
            # In this order: flights never lie beside a setting that is not theirs.
            self._belongs.parent.mkdir(parents=True, exist_ok=True)
            self._file.unlink(missing_ok=True)
            write_atomically(self._belongs, self._setting)
        self.flown[flown.error_sources, flown.seed] = flown
        lines = [",".join(("error_sources", "seed", *STATE, "attitude_error_rad"))]
        for one in self.flown.values():
            figures = (*one.state, one.attitude_error_rad)
            lines.append(",".join([one.error_sources, str(one.seed), *map(repr, figures)]))
        write_atomically(self._file, "\n".join(lines) + "\n")


def fly_all(
    logbook: Logbook,
    solution: Solution,
    vehicle: Vehicle,
    jobs: list[tuple[str, int]],
    *,
    workers: int = 1,
    tell: Callable[[], None] = lambda: None,
) -> list[Flown]:
    """Fly the jobs that the logbook lacks; all flights asked for, in the order of the jobs."""
    missing = [job for job in jobs if job not in logbook.flown]
    for _ in range(len(jobs) - len(missing)):
        tell()
    work = partial(fly_spacecraft, solution, vehicle)
    if workers == 1 or len(missing) < 2:
        for job in missing:
            logbook.add(work(job))
            tell()
    else:
        simulator()  # what is missing is to be said once, and here
        # Ctrl-C reaches every process; this one alone answers it.
        with ProcessPoolExecutor(
            workers, initializer=signal.signal, initargs=(signal.SIGINT, signal.SIG_IGN)
        ) as pool:
            try:
                for flown in pool.map(work, missing):
                    logbook.add(flown)
                    tell()
            except BaseException:
                for process in multiprocessing.active_children():
                    process.terminate()  # or the end would wait for whole flights
                pool.shutdown(cancel_futures=True)
                raise
    return [logbook.flown[job] for job in jobs]
