"""Missions, an integrator and command lines that several tests of this wing use."""

import contextlib
import copy
import io
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.cli.commands import solve
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.physics.forces import ForceModel, acceleration
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan, plan
from scp_recon.reports import shown as flights
from scp_recon.scenario.load import load_scenario, validate_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.verification import probabilities, reintegration

PROJECT = Path(__file__).parents[2]
COMPANION: dict[str, object] = {
    "name": "Second",
    "gm_m3_s2": 0.05,
    "radius_m": 60.0,
    "semi_major_axis_m": 950.0,
    "eccentricity": 0.05,
    "period_h": 22.99224,
    "pole_ra_deg": 5.0,
    "pole_dec_deg": -10.0,
    "periapsis_deg": 40.0,
    "mean_anomaly_deg": 30.0,
    "epoch_tdb": "2020-01-20T00:00:00",
}
"""A companion of Bennu, made up: 1 % of its GM, with the period of its orbit."""


def sigma_of(mission: Mission) -> Array:
    """1 sigma of each component of the initial state, shape (6,)."""
    return np.linalg.norm(mission.initial_factor, axis=1)


def mission_of(*overrides: str) -> Mission:
    return Mission.from_scenario(load_scenario(None, overrides))


def refusal(make: Callable[..., Any], *given: Any, **named: Any) -> InputError:
    """The error with which something refuses what it is given."""
    with pytest.raises(InputError) as caught:
        make(*given, **named)
    return caught.value


def from_cold(mission: Mission, **options: Any) -> Plan:
    """The plan of a mission from a cold start; options are those of `planner.plan`."""
    return plan(mission, initial_guess.cold(mission), **options)


def fly_few(patch) -> None:
    """Have verifications and reports fly few: where what is tested depends not on their number.

    Drifts after missed burns, too, are few and take long steps.
    """
    for module in (probabilities, reintegration, flights):
        patch.setattr(module, "SAMPLES", 500)
    patch.setattr(probabilities, "DRIFTS", 200)
    patch.setattr(probabilities, "DRIFT_STEP_S", 1800.0)


def flight_beyond(mission: Mission) -> Iterate:
    """A flight of the default scenario that leads P3 to its second optimum.

    It passes the site beyond the cone of the least emission, and P2 is infeasible from there.
    """
    burns = [[-0.81, 0.46, 0.59], [0.03, 0.37, -0.22], [0.0, 0.0, 0.0], [-0.83, 0.33, 0.22]]
    return initial_guess.from_burns(mission, np.array(burns) * mission.units.speed_m_s)


def raising(error: BaseException) -> Callable[..., Any]:
    """Stands for a function, and raises whatever it is given."""

    def raises(*_: object, **__: object) -> None:
        raise error

    return raises


def run_python(
    *words: str, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """A program of Python in a process of its own, from the project's folder, ended."""
    command = [sys.executable, *words]
    return subprocess.run(
        command, cwd=PROJECT, env=env, capture_output=True, text=True, timeout=240, check=False
    )


def file_of(scenario: Scenario, changes: Mapping[str, Any], name: str | None = None) -> Scenario:
    """A scenario written out in full, with entries changed by hand.

    Args:
        scenario: that is written out.
        changes: by entry; None takes it out.
        name: of a body that is not packaged, so that nothing is computed of it; the same if not given.
    """
    tables = scenario.model_dump(mode="json", exclude_none=True)
    if name is not None:
        tables["body"] |= {"name": name}
        for entry in ("naif_id", "radii_m"):
            tables["body"].pop(entry, None)
    for path, value in changes.items():
        table, _, entry = path.partition(".")
        tables[table].pop(entry, None)
        if value is not None:
            tables[table][entry] = value
    return validate_scenario(tables)


def integrate(
    forces: ForceModel, state: Array, times: Sequence[float] | Array, rtol: float = 1e-12
) -> Array:
    """States at `times` by SciPy's DOP853, the first at times[0]; an oracle for the flow map."""

    def rate(t: float, y: Array) -> Array:
        return np.array([*y[3:], *acceleration(y[0], y[1], y[2], forces, forces.moment(t))])

    answer = solve_ivp(
        rate, (times[0], times[-1]), state, "DOP853", times, rtol=rtol, atol=rtol * 1e-3
    )
    return answer.y.T


def fly(mission: Mission, burns_m_s: Array, times: Array) -> Array:
    """Mean states, after the burns, at `times`, which contain every burn's."""
    firing = mission.scenario.burns.times_s
    states = np.empty((len(times), 6))
    state = mission.initial_state.copy()
    for i, begin in enumerate(firing):
        state[3:] += burns_m_s[i]
        states[times == begin] = state
        if i + 1 < len(firing):
            leg = (times >= begin) & (times <= firing[i + 1])
            flown = integrate(mission.forces, state, times[leg])
            states[leg] = flown
            state = flown[-1].copy()
    return states


def burns_of(mission: Mission, burns: Array) -> Array:
    """Nondimensional burns in m/s."""
    return burns * mission.units.speed_m_s


@dataclass(frozen=True)
class CommandLine:
    """A run of `python -m scp_recon.solve`, in this process."""

    exit_code: int
    output: str
    errors: str
    folder: Path


def status_of(main: Callable[[Sequence[str]], int], *arguments: str) -> int:
    try:
        return main(arguments)
    except SystemExit as end:  # argparse ends this way
        return int(end.code or 0)


def run_solve(folder: Path, *arguments: str) -> CommandLine:
    """The command line with its two streams captured, as a terminal 200 columns wide."""
    output, errors = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        patch.setenv("COLUMNS", "200")
        code = status_of(solve.main, *arguments, "--out", str(folder))
    return CommandLine(code, output.getvalue(), errors.getvalue(), folder)


Place = tuple[str | int, ...]


def numbers(data: Any, path: Place = ()) -> Iterator[Place]:
    """Where numbers stand in nested tables and lists, of long lists the first."""
    items = data.items() if isinstance(data, dict) else list(enumerate(data))[:1]
    for key, value in items:
        if isinstance(value, dict | list):
            yield from numbers(value, (*path, key))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield (*path, key)


def with_value(data: Any, path: Place, value: object) -> Any:
    """A copy with another value at a place, or without it for an ellipsis."""
    changed = copy.deepcopy(data)
    inside = changed
    for key in path[:-1]:
        inside = inside[key]
    if value is ...:
        del inside[path[-1]]
    else:
        inside[path[-1]] = value
    return changed
