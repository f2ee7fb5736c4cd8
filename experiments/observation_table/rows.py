"""Define the rows of the observation-time table: how to design the burns, and the printed figures.

The real flight's states come from the user's SPK; impulses fitted to them make a row, and a start.
Variants change one reading or choice of the default plan, and stand beside the table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.optimize import least_squares

from formulations.arrays import Array
from formulations.problem.flyby import Iterate
from scp_recon.api.options import PlanOptions
from scp_recon.api.planning import plan_mission
from scp_recon.bodies.catalogue import J2000_TDB
from scp_recon.errors import InputError
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution, ballistic_arc, evaluated, make_solution
from scp_recon.scenario.schema import Scenario

Guess = Callable[[Mission], Iterate]

OSIRIS_REX_ID, BENNU_ID = -64, 2101955
"""NAIF codes in the kernels of the mission."""
KERNEL = "orx_191101_200225_200214_od223_v1.bsp"
"""The flight's SPK of 21 January 2020 in NAIF's public archive of the mission."""


@dataclass(frozen=True)
class Printed:
    """A row of the paper's table of observation times (Echigo et al., arXiv 2412.06816)."""

    name: str
    mean_s: float
    worst_1_sigma_s: float


PRINTED_WINDOW_S = 3397.0
"""Length of the window, and every row's observation time without uncertainty."""

PRINTED_CLOSEST_M = 667.24
"""Distance from the centre at the 0.003 quantile, of "the solution trajectory" of either start."""

OSIRIS_REX = Printed("OSIRIS-REx", 2930.0, 2785.0)
WARM = Printed("Proposed Method with Warm Start", 3043.0, 3017.0)
COLD = Printed("Proposed Method with Cold Start", 3271.0, 3397.0)


@dataclass(frozen=True)
class Row:
    """A row of our table.

    Attributes:
        key: name of its folder.
        label: its name in the table.
        role: "reference" for the practice with which the planner is compared; a "variant" is no row
            of the paper's table.
        printed: the paper's row.
        design: function that finds the burns.
        init: its start, as in its solution file.
        anew: whether to find the burns in every run, because a file of the user's may have changed.
        caveat: why its agreement with the printed row is no evidence.
        changes: entries of the default scenario that are others here.
    """

    key: str
    label: str
    role: Literal["reference", "planned", "variant"]
    printed: Printed
    design: Callable[[Mission], Solution]
    init: str
    anew: bool = False
    caveat: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)

    def mission(self, default: Mission) -> Mission:
        """The mission that the row is of."""
        if not self.changes:
            return default
        return Mission.from_scenario(default.scenario.replace(self.changes))

    def began_elsewhere(self, folder: Path) -> bool:
        """Whether the folder holds a design from another start."""
        try:
            return read_solution(folder).init != self.init
        except InputError:  # nothing of use is there
            return False


FRAME_CAVEAT = (
    "no independent evidence: the frame of the printed states, which the paper does not name there, "
    "was chosen because this row then comes near the printed mean"
)


@dataclass(frozen=True)
class Start:
    """An initial guess, and its name in the solution file."""

    init: str
    guess: Guess


AS_FLOWN: tuple[str, str, Literal["reference"], Printed] = (
    "as_flown",
    "OSIRIS-REx as flown (SPK)",
    "reference",
    OSIRIS_REX,
)


def rows(*, ipopt: bool = True, as_flown: tuple[Path, Path] | None = None) -> tuple[Row, ...]:
    """The table's rows in its order.

    Args:
        ipopt: whether to plan by IPOPT too.
        as_flown: the flight's kernel and where to write the states read from it. The warm rows then
            start from the flight, as the paper's do; else from the ballistic arc.
    """
    cold, warm = Start("cold", initial_guess.cold), Start("warm", initial_guess.ballistic)
    label, anew = "warm start", as_flown is not None
    if as_flown:
        warm = Start("as_flown", partial(flown_guess, *as_flown))
        label = "warm start from the flight"
    found = [
        Row(
            "ballistic",
            "OSIRIS-REx surrogate: ballistic two-impulse arc",
            "reference",
            OSIRIS_REX,
            ballistic_arc,
            "ballistic",
        ),
        Row(
            "p3",
            "OSIRIS-REx surrogate: P3 design, no uncertainty",
            "reference",
            OSIRIS_REX,
            partial(_planned, PlanOptions(problem="P3"), cold),
            cold.init,
            caveat=FRAME_CAVEAT,
        ),
    ]
    methods = {"SCP": PlanOptions()} | ({"IPOPT": PlanOptions(method="ipopt")} if ipopt else {})
    for name, options in methods.items():
        key, by_warm, by_cold = (
            name.lower(),
            partial(_planned, options, warm),
            partial(_planned, options, cold),
        )
        found += [
            Row(f"{key}_warm", f"{name}, {label}", "planned", WARM, by_warm, warm.init, anew),
            Row(f"{key}_cold", f"{name}, cold start", "planned", COLD, by_cold, cold.init),
        ]
    if as_flown:
        given = partial(_as_flown, *as_flown)
        found.append(Row(*AS_FLOWN, given, warm.init, anew))
    return tuple(found)


def variants(scenario: Scenario) -> tuple[Row, ...]:
    """The default plan from the cold start with another reading of the paper, or another choice."""
    cold = Start("cold", initial_guess.cold)
    state = np.array(
        [*scenario.boundary.initial_position_m, *scenario.boundary.initial_velocity_m_s]
    )
    sigma = np.abs(state) * scenario.uncertainty.initial_sigma_fraction
    spread = {
        "uncertainty.initial_sigma_position_m": sigma[:3].tolist(),
        "uncertainty.initial_sigma_velocity_m_s": sigma[3:].tolist(),
        "uncertainty.initial_frame": "sun_north",
    }
    measured = {"uncertainty.initial_sigma_fraction": 0.03, "uncertainty.execution_error": 0.1}
    tangent = {"polytopes.ball": "tangent", "polytopes.cone": 12}
    literal = {"boundary.frame": "j2000"}
    again = PlanOptions(facet_rounds=1)
    made: tuple[tuple[str, str, PlanOptions, Mapping[str, Any]], ...] = (
        ("facets_again", "facets chosen again at the solution", again, {}),
        ("cones_24", "cones of 24 facets", PlanOptions(), {"polytopes.cone": 24}),
        ("tangent", "tangent spheres, cones of 12 facets", PlanOptions(), tangent),
        ("tangent_again", "the same, facets chosen again", again, tangent),
        (
            "spread_printed",
            "initial covariance diagonal in the printed frame",
            PlanOptions(),
            spread,
        ),
        (
            "errors_table_1",
            "the errors of the paper's table 1, 3 % and 10 %",
            PlanOptions(),
            measured,
        ),
        ("p3_j2000", "P3, boundary states read as J2000", PlanOptions(problem="P3"), literal),
        ("p2_j2000", "P2, boundary states read as J2000", PlanOptions(), literal),
    )
    return tuple(
        Row(
            key,
            label,
            "variant",
            COLD,
            partial(_planned, options, cold),
            cold.init,
            changes=changes,
        )
        for key, label, options, changes in made
    )


def _as_flown(kernel: Path, table: Path, mission: Mission) -> Solution:
    burns, distance_m = as_flown_burns(mission, kernel, table)
    message = (
        f"Not a plan: impulses fitted to {kernel.name}, "
        f"which they follow within {distance_m:.1f} m in the observation window."
    )
    return evaluated(mission, burns, "as_flown", message)


def _planned(options: PlanOptions, start: Start, mission: Mission) -> Solution:
    return make_solution(plan_mission(mission, start.guess(mission), options, init=start.init))


def as_flown_burns(mission: Mission, kernel: Path, table: Path) -> tuple[Array, float]:
    """Fit impulses at the firing times to the kernel.

    The states at the nodes are written to `table`, a CSV that `--init` takes as well. The flight also
    fired at other times, and its forces are not quite the planner's; so all burns but the last are
    fitted to the positions by least squares. The last one meets the final velocity.

    Returns:
        Burns in m/s, shape (m, 3), and the largest distance from the kernel in the window, m.

    Raises:
        InputError: if spiceypy is missing, or the kernel does not cover the flight.
    """
    states = read_states(mission, kernel)
    start = _tabulated(mission, states, table)
    scale = mission.units.length_m
    target = states[:-1, :3] / scale

    def flight(free: Array) -> Array:
        """Node states with the free burns and no last one."""
        burns = np.vstack([free.reshape(-1, 3), np.zeros(3)])
        return mission.dynamics.rollout(mission.problem.initial_state, burns)

    def miss(free: Array) -> Array:
        return (flight(free)[:-1, :3] - target).ravel()

    free = least_squares(miss, start.burns[:-1].ravel(), x_scale="jac", method="lm").x
    flown = flight(free)
    last = mission.problem.final_state[3:] - flown[-1, 3:]
    window = mission.window_nodes
    off = np.linalg.norm(flown[window, :3] - target[window], axis=1) * scale
    burns = np.vstack([free.reshape(-1, 3), last]) * mission.units.speed_m_s
    return burns, float(off.max())


def flown_guess(kernel: Path, table: Path, mission: Mission) -> Iterate:
    """The flight as an initial guess: the paper's warm start.

    It is the one that `--init` makes of `table`, which is written.

    Raises:
        InputError: if spiceypy is missing, or the kernel does not cover the flight.
    """
    return _tabulated(mission, read_states(mission, kernel), table)


def _tabulated(mission: Mission, states: Array, table: Path) -> Iterate:
    _write_table(table, mission.times_s, states)
    return initial_guess.from_table(mission, table)


def read_states(mission: Mission, kernel: Path) -> Array:
    """States of OSIRIS-REx about Bennu at the mission's nodes, J2000, m and m/s, shape (n, 6).

    Raises:
        InputError: if spiceypy is missing, or the kernel does not cover the flight.
    """
    spice = _spiceypy()
    epoch = (mission.scenario.epoch.tdb - J2000_TDB).total_seconds()
    try:
        spice.furnsh(str(kernel))
    except spice.SpiceyError as error:
        raise _unusable(kernel, error, "must be a readable SPK or meta-kernel") from None
    try:
        states = [
            spice.spkgeo(OSIRIS_REX_ID, epoch + time, "J2000", BENNU_ID)[0]
            for time in mission.times_s.tolist()
        ]
    except spice.SpiceyError as error:
        allowed = (
            f"must give {OSIRIS_REX_ID} about {BENNU_ID} from {mission.scenario.epoch.tdb} TDB "
            f"for {mission.times_s[-1]:g} s"
        )
        raise _unusable(kernel, error, allowed) from None
    finally:
        spice.unload(str(kernel))
    return 1000.0 * np.array(states)


def _spiceypy() -> Any:
    try:
        import spiceypy
    except ImportError:
        raise InputError(
            "--as-flown", "no spiceypy to read it with", "needs the extra [spice]"
        ) from None
    return spiceypy


def _unusable(kernel: Path, error: Exception, allowed: str) -> InputError:
    """SPICE's short message, without its traceback."""
    short = getattr(error, "short", "") or str(error).strip().splitlines()[0]
    return InputError(f"--as-flown {kernel}", short, allowed)


def _write_table(path: Path, times_s: Array, states: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [",".join(initial_guess.COLUMNS.values())]
    lines += [
        ",".join(repr(float(x)) for x in (time, *state))
        for time, state in zip(times_s, states, strict=True)
    ]
    write_atomically(path, "\n".join(lines) + "\n")
