"""What is done with plans from Python: fly, check, save, compare, show them."""

from __future__ import annotations

from pathlib import Path

from scp_recon.cli.keeping import keep_plan
from scp_recon.errors import InputError, shortened
from scp_recon.files import check_writable, unwritable
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.sampling import ErrorModel, TruthModel
from scp_recon.monte_carlo.summarise import summarise
from scp_recon.monte_carlo.summary import Summary
from scp_recon.planning.plan import Plan
from scp_recon.solution.comparison import Comparison, compare
from scp_recon.solution.file import FILE_NAME, Solution
from scp_recon.solution.from_plan import make_solution
from scp_recon.solution.read import read_solution
from scp_recon.solution.verdict import Verification
from scp_recon.verification.reintegration import verify


def fly(
    plan: Plan,
    samples: int = 10_000,
    seed: int = 0,
    *,
    truth: TruthModel = "planner",
    errors: ErrorModel | None = None,
    workers: int = 1,
) -> Summary:
    """Fly a plan many times with errors.

    >>> import scp_recon as sr
    >>> emission = sr.fly(sr.plan(), samples=1000).probability["emission"]
    >>> print(f"{emission.value:.3f}, 95 % interval {emission.low:.3f} to {emission.high:.3f}")
    0.982, 95 % interval 0.972 to 0.989

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

    >>> import scp_recon as sr
    >>> sr.check(sr.plan())
    <Verification: verified>

    Raises:
        InputError: if it is no plan.
    """
    _require_plan(plan)
    return verify(plan.mission, make_solution(plan))


def save(plan: Plan, folder: str | Path) -> Path:
    """Verify a plan and write its `solution.json` into a folder, whole or not at all.

    A plan that is not verified goes beside a verified one that is there, as `solution_unverified.json`;
    what was made of another plan is set aside (`old_montecarlo.json`).

    >>> import scp_recon as sr
    >>> sr.save(sr.plan(), "runs/mine").name
    'solution.json'

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


def _require_readable(plans: tuple[object, ...]) -> None:
    for given in plans:
        if not isinstance(given, Plan | Solution | str | Path):
            raise InputError("plan", shortened(given), "must be a plan, a solution or its file")


def side_by_side(*plans: Plan | Solution | str | Path) -> Comparison:
    """Compare plans, solutions or their files; the paths are held against the first one's.

    >>> import scp_recon as sr
    >>> table = sr.side_by_side(sr.plan(), sr.plan(problem="P3"))
    >>> print(*(f"{dv:.3f} m/s" for dv in table["total delta-v"]))
    0.140 m/s 0.108 m/s

    Raises:
        InputError: if there is none, or one is no plan and no file of a solution.
    """
    if not plans:
        raise InputError("plans", "none", "must be one or more")
    _require_readable(plans)
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
    _require_readable(plans)
    found = [_solution(p) if isinstance(p, Plan | Solution) else Path(p) for p in plans]
    return write.write_report(found, Path(file))


def _solution(given: Plan | Solution | str | Path) -> Solution:
    """A plan's verified, or what is one already."""
    if isinstance(given, Plan):
        solution = make_solution(given)
        return solution.model_copy(update={"verification": verify(given.mission, solution)})
    return given if isinstance(given, Solution) else read_solution(Path(given))
