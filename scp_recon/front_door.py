"""What a notebook or a script needs, in SI: `import scp_recon as sr`.

The functions have names that no command has, because `import scp_recon.solve` makes `solve` a module.
Paths may be strings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from formulations.problem.flyby import Iterate
from scp_recon.certification.certify import certify
from scp_recon.cli.keeping import keep_plan
from scp_recon.errors import InputError, one_of, shortened, whole_number
from scp_recon.files import check_writable, unwritable
from scp_recon.in_flight.delivery import Delivery
from scp_recon.in_flight.parent import FlownPlan
from scp_recon.in_flight.replanning import mission_left, replan
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.certifying import flights_needed
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.sampling import ErrorModel, TruthModel
from scp_recon.monte_carlo.summary import Summary, summarise
from scp_recon.planning import planner
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import FACET_ROUNDS_MAX, PROBLEMS, check_exact, scp_method
from scp_recon.planning.plan import Plan
from scp_recon.planning.starts import SEED_MAX, STARTS_MAX, WORKERS_MAX, plan_from_several
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status
from scp_recon.solution.comparison import Comparison, compare
from scp_recon.solution.file import FILE_NAME, Solution, read_solution
from scp_recon.solution.from_plan import make_solution
from scp_recon.solution.start import start_from
from scp_recon.solution.verdict import Verification
from scp_recon.verification.reintegration import verify

__all__ = [
    "check",
    "fly",
    "load_scenario",
    "plan",
    "plan_again",
    "run_campaign",
    "save",
    "side_by_side",
    "write_report",
]

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]


def plan(
    scenario: Scenario | str | Path = "recon_b",
    init: Plan | str | Path | Array = "cold",
    *,
    problem: Literal["P3", "P2"] = "P2",
    formulation: str = "condensed",
    algorithm: str = "scvx",
    solver: str = "CLARABEL",
    facet_rounds: int = 0,
    certified: bool | None = None,
    starts: int = 1,
    seed: int = 0,
    workers: int = 1,
) -> Plan:
    """Plan a flyby.

    >>> import scp_recon as sr
    >>> found = sr.plan(sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8}))
    >>> print(found.status.value.name, f"{found.total_dv_m_s:.3f} m/s")
    converged 0.155 m/s

    Args:
        scenario: what to plan; the name of a packaged one, or a file.
        init: "cold", a straight line; "warm", a ballistic arc; a plan, a solution or its folder; a CSV
            of states, or such a table as an array (n, 7): t, x, y, z, vx, vy, vz, J2000, SI.
        problem: with uncertainty (P2) or without (P3).
        formulation: condensed, lifted, frozen-stm or frozen-covariance.
        algorithm: scvx, ptr or scvx-star.
        solver: a conic solver that CVXPY finds.
        facet_rounds: how often to choose the facets again at the solution.
        certified: with exact risk, whether to plan until flights certify the probability; they do
            unless it is False.
        starts: the plan is the best from `init` and from so many random flights less one; its `starts`
            lists the distinct local optima.
        seed: of the random flights.
        workers: processes for the starts; the plan does not depend on their number.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    one_of("problem", problem, PROBLEMS)
    method = scp_method(formulation, algorithm, solver)
    whole_number("facet_rounds", facet_rounds, 0, FACET_ROUNDS_MAX)
    whole_number("starts", starts, 1, STARTS_MAX)
    whole_number("seed", seed, 0, SEED_MAX)
    whole_number("workers", workers, 1, WORKERS_MAX)
    mission = Mission.from_scenario(_scenario(scenario))
    if mission.scenario.risk.allocation == "exact":
        check_exact("scp", method.formulation, facet_rounds)
    to_certify = is_to_certify(mission, problem, certified)

    make_plan = partial(
        planner.plan,
        problem=problem,
        formulation=method.formulation,
        algorithm=method.algorithm,
        solver=method.solver,
        facet_rounds=facet_rounds,
    )
    start, called = start_from(mission, init), _called(init)
    best = None
    if starts > 1:
        best = plan_from_several(
            mission, start, make_plan, starts=starts, seed=seed, workers=workers, init=called
        )
        if not to_certify or best.status is not Status.CONVERGED:
            return best
        start, called = from_burns(mission, best.burns_m_s), best.provenance.init

    def once(mission: Mission, start: Iterate, aim: float | None = None) -> Plan:
        return make_plan(mission, start, aim=aim, init=called)

    found = certify(mission, start, once) if to_certify else once(mission, start)
    return replace(found, starts=best.starts) if best else found


def plan_again(
    plan: Plan | Solution | str | Path,
    at_s: float,
    state: npt.ArrayLike,
    covariance: npt.ArrayLike | None = None,
    *,
    frame: str = "j2000",
    covariance_frame: str | None = None,
    measured_burns: Mapping[int, npt.ArrayLike] | None = None,
    overrides: Sequence[str] = (),
    certified: bool | None = None,
) -> Plan:
    """Plan what is left of a flight from a state in it.

    Burns at or before that time are flown. The next one keeps the scenario's decision lead time; what
    is left of the observation window counts. With fewer than two burns left the final state is met as
    nearly as they can: `check` says how much is missed.

    Args:
        plan: that is flown; nodes and spread of a solution, or its file, are held against its burns.
        at_s: time of the state past the plan's epoch, s.
        state: after the burns flown, m and m/s, body-centred, shape (6,).
        covariance: of it, m and m/s, shape (6, 6); the scenario's initial one if not given.
        frame: axes of state and measured burns, "j2000" or "sun_north", at the epoch.
        covariance_frame: axes of the covariance, these or "rtn" of the state; `frame` if not given.
        measured_burns: burns flown as telemetry saw them, by their number in the flight from 1, m/s.
        overrides: `section.entry=value` each, as of `load_scenario`, for what is left.
        certified: as in `plan`.

    Returns:
        A plan of the burns that are left, whose `parent` names the one that is flown.

    Raises:
        InputError: naming the argument, what was given and what is allowed.
    """
    if isinstance(overrides, str) or not all(isinstance(text, str) for text in overrides):
        raise InputError("overrides", shortened(overrides), "must be a list of section.entry=value")
    flown = FlownPlan.of(plan)
    delivery = Delivery.of(
        at_s,
        state,
        frame=frame,
        covariance=covariance,
        covariance_frame=covariance_frame,
        measured=measured_burns,
    )
    mission = mission_left(flown, delivery, overrides)
    to_certify = is_to_certify(mission, flown.problem, certified)
    return replan(flown, mission, certified=to_certify)


def is_to_certify(mission: Mission, problem: str, certified: bool | None) -> bool:
    """Whether flights have to stand behind a plan.

    Raises:
        InputError: if they cannot, or would be too many.
    """
    exact = mission.scenario.risk.allocation == "exact" and problem == "P2"
    if certified not in (None, True, False):
        raise InputError("certified", shortened(certified), "must be True, False or None")
    if certified is not None and not exact:
        raise InputError(
            "certified",
            shortened(certified),
            "goes with risk.allocation = exact and problem P2 only",
        )
    if exact and certified is not False:
        flights_needed(mission.scenario.risk.p_chance, "certified=False")
        return True
    return False


def _scenario(given: Scenario | str | Path) -> Scenario:
    if isinstance(given, Scenario):
        return given
    if not isinstance(given, str | Path):
        raise InputError("scenario", shortened(given), "must be a scenario, its name, or a file")
    return load_scenario(given)


def _called(init: Plan | str | Path | Array) -> str:
    """What the solution file calls a start."""
    if isinstance(init, np.ndarray):
        return "a table"
    return "a plan" if isinstance(init, Plan) else str(init)


def fly(
    plan: Plan,
    samples: int = 10_000,
    seed: int = 0,
    *,
    truth: TruthModel = "planner",
    errors: ErrorModel | None = None,
    workers: int = 1,
) -> Summary:
    """Fly a plan many times with errors: `flights.probability["emission"]` has value, low and high.

    Args:
        plan: to fly.
        samples: flights.
        seed: of all draws.
        truth: dynamics flown, the planner's or harmonics.
        errors: of the burns, "componentwise" or "gates"; the scenario's without it.
        workers: processes; the result does not depend on their number.

    Raises:
        InputError: naming the argument, what was given and what is allowed.
    """
    _require_plan(plan)
    config = FlightConfig(plan.mission, plan.burns_m_s, seed, truth, errors)
    flown = fly_many(config, samples=samples, workers=workers)
    return summarise(flown, make_solution(plan))


def check(plan: Plan) -> Verification:
    """Verify a plan without the solver: `ok`, and what `failed`.

    Raises:
        InputError: if it is no plan.
    """
    _require_plan(plan)
    return verify(plan.mission, make_solution(plan))


def save(plan: Plan, folder: str | Path) -> Path:
    """Verify a plan and write its `solution.json` into a folder, whole or not at all.

    A plan that is not verified goes beside a verified one that is there, as `solution_unverified.json`;
    what was made of another plan is set aside (`old_montecarlo.json`).

    Raises:
        InputError: if it is no plan, or the folder cannot be written.
    """
    _require_plan(plan)
    path = Path(folder)
    check_writable(path, FILE_NAME, "folder")
    try:
        return keep_plan(_solution(plan), path)[0]
    except OSError as error:
        raise unwritable(path, "folder", error) from None


def _require_plan(given: object) -> None:
    if not isinstance(given, Plan):
        raise InputError("plan", shortened(given), "must be a plan, which `plan` returns")


def side_by_side(*plans: Plan | Solution | str | Path) -> Comparison:
    """Compare plans, solutions or their files; the paths are held against the first one's.

    Raises:
        InputError: if there is none, or one is no plan and no file of a solution.
    """
    if not plans:
        raise InputError("plans", "none", "must be one or more")
    for given in plans:
        if not isinstance(given, Plan | Solution | str | Path):
            raise InputError("plan", shortened(given), "must be a plan, a solution or its file")
    names, solutions = [], []
    for number, given in enumerate(plans, start=1):
        named = given if isinstance(given, str | Path) else f"plan {number}"
        names.append(str(named))
        solutions.append(_solution(given))
    return compare(names, solutions)


def write_report(*plans: Plan | Solution | str | Path, file: str | Path = "report.html") -> Path:
    """Write the page that shows plans, laid over each other; it needs nothing else to be looked at.

    Args:
        plans: one to six, of one body; what lies beside a plan's file is shown with it.
        file: to write.

    Raises:
        InputError: if one is no plan and no file of a solution, the extra [report] is missing, or the
            file cannot be written.
    """
    from scp_recon.report import write

    write.check_extra()
    for given in plans:
        if not isinstance(given, Plan | Solution | str | Path):
            raise InputError("plan", shortened(given), "must be a plan, a solution or its file")
    found = [_solution(p) if isinstance(p, Plan | Solution) else Path(p) for p in plans]
    return write.write_report(found, Path(file))


class CampaignOutput(NamedTuple):
    """What `run_campaign` returns.

    Attributes:
        table: a row a case, as in results.parquet.
        figures: by name; a map and the shape of sites, else curves.
    """

    table: pandas.DataFrame
    figures: dict[str, Figure]


def run_campaign(
    study: str | Path | Mapping[str, Any],
    folder: str | Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    yes: bool = False,
) -> CampaignOutput:
    """Run the cases of a study that have no row in a folder yet; see docs/campaigns.md.

    Needs the extras [campaign] and [report], with a scheduler [cluster].

    Args:
        study: a file, or its tables, with files relative to the current folder.
        folder: for the results.
        workers: processes; 0 runs the cases in this one, where none can be ended.
        scheduler: address of a Dask cluster's, in their place.
        yes: whether more than 100,000 cases are meant.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    from scp_recon.campaign import engine, outcome, report, studies

    report.check_extras()
    whole_number("workers", workers, 0, studies.WORKERS_MAX)
    given = studies.study_of(study, yes=yes)
    path = Path(folder)
    engine.run_study(given, path, studies.runner_of(given, workers, scheduler))
    results = outcome.read_campaign(path)
    from scp_recon.campaign.figures import figures

    return CampaignOutput(results.table, figures(results))


def _solution(given: Plan | Solution | str | Path) -> Solution:
    """A plan's verified, or what is one already."""
    if isinstance(given, Plan):
        solution = make_solution(given)
        return solution.model_copy(update={"verification": verify(given.mission, solution)})
    return given if isinstance(given, Solution) else read_solution(Path(given))
