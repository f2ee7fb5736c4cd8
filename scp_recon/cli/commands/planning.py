"""The commands that plan: `solve`, `design`, `replan`, `new` and `campaign`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from scp_recon.cli.command import Answer, Command, show_line, show_written
from scp_recon.cli.options import (
    Certify,
    Folder,
    Option,
    Overrides,
    PlanFile,
    RunFolder,
    Scheduler,
    budget,
    numbers,
    start,
)

if TYPE_CHECKING:
    from rich.console import Console


@Command
def solve(
    console: "Console",
    file: Annotated[Path | None, Option("SCENARIO")] = None,
    *,
    scenario: Annotated[Path | None, Option("SCENARIO")] = None,
    init: Annotated[str, Option("cold|warm|FILE", read=start)] = "cold",
    problem: Literal["P3", "P2"] = "P2",
    method: Literal["scp", "ipopt"] = "scp",
    formulation: str | None = None,
    algorithm: str | None = None,
    solver: str | None = None,
    facet_rounds: int = 0,
    certify: Certify = None,
    objective: Literal["delta-v", "probability"] = "delta-v",
    dv_budget_m_s: Annotated[float | None, Option("M_S", "--dv-budget", budget)] = None,
    starts: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    overrides: Overrides = [],  # noqa: B006 -- never changed
    report: bool = False,
    out: RunFolder = None,
) -> Answer:
    """Plan a flyby.

    Args:
        file: in place of `scenario`: a file, or a packaged one's name.
        scenario: a file, complete or with base = another, or the packaged recon_b; other packaged ones
            go with design (default: that of `init`, else recon_b).
        init: straight line; ballistic arc; a solution file (and its scenario, unless `scenario` is
            given) or a CSV of states t, x, y, z, vx, vy, vz in SI, J2000.
        problem: P2, with uncertainty, or P3, without it.
        method: scp, sequential convex programming, or ipopt, the nonlinear programs by IPOPT.
        formulation: with scp condensed, lifted, frozen-stm or frozen-covariance (default: condensed);
            with ipopt printed, tuned or shooting (default: tuned).
        algorithm: with scp scvx, ptr or scvx-star (default: scvx).
        solver: with scp a conic solver that CVXPY finds: CLARABEL and SCS; ECOS and QOCO with the extra
            [compare] (default: CLARABEL).
        facet_rounds: choose the facets again at the solution and solve again, up to this many times; an
            infeasible case is tried again in any case.
        objective: the least delta-v; or with risk.allocation = exact the largest probability, whatever
            risk.p_chance says.
        dv_budget_m_s: with `objective` probability, largest delta-v of the plan, as policy.cost counts
            it, m/s (default: no limit).
        starts: plan from `init`, and from random flights for the other starts; list the distinct local
            optima and keep the best (default: 1).
        seed: of the random flights (default: 0).
        workers: processes for the starts; the plan does not depend on their number (default: 1).
        report: write report.html too, a page to look at; the extra [report].
    """
    from scp_recon.api.inputs import PlanRequest
    from scp_recon.api.keeping import point_latest
    from scp_recon.api.options import PlanOptions
    from scp_recon.api.planning import carry_out
    from scp_recon.cli.plan_run import Shown, show_largest, undoing, write_report_of
    from scp_recon.errors import InputError, option
    from scp_recon.scp.status import Status

    how = PlanOptions(
        problem=problem,
        method=method,
        formulation=formulation,
        algorithm=algorithm,
        solver=solver,
        facet_rounds=facet_rounds,
        certify=certify,
        objective=objective,
        dv_budget_m_s=dv_budget_m_s,
        starts=starts,
        seed=seed,
        workers=workers,
    )
    if report:
        from scp_recon.reports.write import check_extra

        check_extra()
    if file is not None and scenario is not None:
        allowed = f"must be given once, with {option('scenario')} or without"
        raise InputError("SCENARIO", f"{file} and {scenario}", allowed)
    request = PlanRequest(scenario if file is None else file, init, how, overrides)
    with Shown(console, out, undoing(how)) as shown:
        outcome = carry_out(request, shown)
        answer = shown.answer(outcome)
        if how.objective == "probability" and answer.status == 0:
            show_largest(how.dv_budget_m_s, outcome.plan, console)
        if report and answer.status != Status.INTERRUPTED.value.exit_code:
            write_report_of(shown.place, console)
    point_latest(out, shown.place, answer.status)
    return answer


@Command
def design(
    console: "Console",
    scenario: Annotated[Path, Option("SCENARIO")],
    *,
    certify: Certify = None,
    overrides: Overrides = [],  # noqa: B006 -- never changed
    out: RunFolder = None,
) -> Answer:
    """Choose departure, arrival and burn times of a pass from a home orbit, and plan it.

    Args:
        scenario: a file with boundary.home, or a packaged one's name.
        out: folder for solution.json, scenario.toml, design.csv and pictures (default: runs/NAME/UTC
            with the scenario's name, to which runs/latest then points); a verified plan there is
            overwritten only by a verified one.
    """
    from scp_recon.api.designing import design_options, find_pass, plan_pass, trials_table
    from scp_recon.api.inputs import scenario_of
    from scp_recon.api.keeping import point_latest, run_folder
    from scp_recon.api.planning import checked, finite_figures
    from scp_recon.cli import design_view as view
    from scp_recon.cli.plan_run import Shown
    from scp_recon.mission.mission import Mission
    from scp_recon.scenario.load import naming_files, scenario_text
    from scp_recon.scp.status import Status

    given = scenario_of(scenario, overrides)
    how = design_options(given, certify=certify)
    with run_folder(out, given.name) as folder:
        with view.progress(console) as observe, naming_files(scenario, overrides):
            found = find_pass(given, observe)
        view.keep(folder, view.TABLE, trials_table(found).csv())
        if found.scenario is None:
            view.keep_map(folder, found, console, found.best.dv_m_s)
            show_line(console, found.message)
            show_written(console, folder / view.TABLE)
            files = [str(folder / view.TABLE)]
            return Answer(Status.INFEASIBLE.value.exit_code, {"files": files})
        view.keep(folder, view.SCENARIO, scenario_text(found.scenario))
        mission = Mission.from_scenario(found.scenario)
        shown = Shown(console, folder)
        with shown.planning(mission) as watch, finite_figures():
            plan = plan_pass(found, mission, how, watch)
        answer = shown.answer(checked(plan, folder, shown))
        view.keep_map(folder, found, console, answer.document["plan"]["total_dv_m_s"])
        view.keep_primer(folder, console)
    point_latest(out, folder, answer.status)
    return answer


@Command
def replan(
    console: "Console",
    plan: PlanFile,
    *,
    at_s: Annotated[str, Option("T", "--at")],
    state: Annotated[str, Option("STATE")],
    covariance: Path | None = None,
    frame: str = "j2000",
    covariance_frame: str | None = None,
    measured_burns: Annotated[list[str], Option("N=X,Y,Z", "--measured-burn")] = [],  # noqa: B006
    overrides: Overrides = [],  # noqa: B006 -- never changed
    certify: Certify = None,
    out: RunFolder = None,
) -> Answer:
    """Plan the rest of a flight.

    Args:
        at_s: time of the state: s past the plan's epoch, or a date in TDB; burns until then are flown.
        state: x y z in m and vx vy vz in m/s at that time, after burns flown, or a file of these six.
        covariance: six rows of six numbers, m and m/s (default: the scenario's initial covariance).
        frame: axes of state and measured burns, j2000 or sun_north, at the epoch.
        covariance_frame: axes of the covariance, these or rtn of the state (default: those of `frame`).
        measured_burns: a flown burn as telemetry saw it, m/s, by its number in the flight; may be
            repeated.
        overrides: override one entry of the scenario for the rest, e.g. navigation.lead_s=900; may be
            repeated.
    """
    from scp_recon.api.keeping import point_latest, run_folder
    from scp_recon.api.planning import checked, finite_figures
    from scp_recon.api.replans import left_options, plan_left
    from scp_recon.cli.delivery import read_delivery
    from scp_recon.cli.plan_run import Shown
    from scp_recon.errors import InputError, option
    from scp_recon.replanning.flown import FlownPlan
    from scp_recon.replanning.remainder import mission_left
    from scp_recon.results.read import read_solution
    from scp_recon.results.runs import folder_of, resolve_run

    home = resolve_run(plan)
    if out is not None and out.resolve() == folder_of(home).resolve():
        given = f"{out}, which holds the plan in flight"
        raise InputError(option("out"), given, "must be a folder of its own")
    solution = read_solution(home)
    delivery = read_delivery(
        at_s,
        state,
        solution.scenario.epoch.tdb,
        frame=frame,
        covariance=covariance,
        covariance_frame=covariance_frame,
        measured_burns=measured_burns,
    )
    flown = FlownPlan.of(solution, name=str(home))
    mission = mission_left(flown, delivery, overrides)
    left_options(flown, mission, certify=certify)  # refuses what cannot be, at once
    with run_folder(out, mission.scenario.name) as folder:
        shown = Shown(console, folder)
        with shown.planning(mission) as observe, finite_figures():
            left = plan_left(flown, mission, certify=certify, observe=observe)
        answer = shown.answer(checked(left, folder, shown))
    point_latest(out, folder, answer.status)
    return answer


@Command
def new(
    console: "Console",
    name: str,
    *,
    body: str,
    site: Annotated[tuple[float, float], Option("LAT,LON", read=numbers)],
    epoch: Annotated[str | None, Option("TDB")] = None,
    gm: float | None = None,
    radius: float | None = None,
    period: float | None = None,
    pole: Annotated[tuple[float, float] | None, Option("RA,DEC", read=numbers)] = None,
    orbit: Annotated[tuple[float, ...] | None, Option("X,Y,Z,VX,VY,VZ", read=numbers)] = None,
    from_spice: Path | None = None,
    spacecraft: int | None = None,
    from_oem: Path | None = None,
    from_csv: Path | None = None,
    begin: Annotated[str | None, Option("TIME", "--from")] = None,
    end: Annotated[str | None, Option("TIME", "--to")] = None,
) -> Answer:
    """Draft a scenario for one's own site and body.

    Args:
        name: of the scenario, written to NAME.toml.
        body: a packaged one's name; or another, with `gm`, `radius`, `period`, `pole` and `orbit`. A
            packaged body excludes these, and `from_spice` has them.
        site: planetocentric latitude and east longitude, deg.
        epoch: earliest time of the first burn, TDB, e.g. 2020-01-21T20:33:17; with `from_csv` that of
            t_s = 0; left out with `from_spice` and `from_oem`.
        gm: of the body, m^3/s^2.
        radius: of the body as a sphere, m.
        period: sidereal spin period, h, right-handed about the pole.
        pole: right ascension and declination of the spin pole, deg, J2000.
        orbit: the body from the Sun at `epoch`, with `from_oem` at the first state taken, km and km/s,
            J2000.
        from_spice: a meta-kernel: body, Sun, boundary states and start from it, with `spacecraft`,
            `begin` and `end`; needs the extra [spice].
        spacecraft: NAIF's number in the kernels, as --spacecraft=-64.
        from_oem: a CCSDS OEM: boundary states and start from it, `begin` and `end` if given.
        from_csv: a table of states as solve --init takes it, its t_s past `epoch`, which it needs; the
            rest as with `from_oem`.
        begin: first burn, with a trajectory only, UTC, e.g. 2020-01-21T20:32:08.
        end: last burn, with a trajectory only, UTC, e.g. 2020-01-21T20:32:08.
    """
    from scp_recon.api import drafts
    from scp_recon.cli import plan_view
    from scp_recon.cli.command import NOT_VERIFIED
    from scp_recon.scp.status import Status

    found = drafts.new(
        name,
        body,
        site,
        epoch,
        gm=gm,
        radius=radius,
        period=period,
        pole=pole,
        orbit=orbit,
        from_spice=from_spice,
        spacecraft=spacecraft,
        from_oem=from_oem,
        from_csv=from_csv,
        begin=begin,
        end=end,
        progress=lambda line: show_line(console, line),
    )
    plan_view.show_mission(console, found.mission)
    plan_view.show_solution(console, found.solution)
    plan_view.show_verification(
        console, found.mission, found.solution, found.verification, found.mission.warnings
    )
    for file in found.files:
        show_written(console, file)
    code = Status.named(found.solution.status).value.exit_code
    status = code or (0 if found.is_verified else NOT_VERIFIED)
    return Answer(status, plan_view.plan_document(found.solution, found.files))


@Command
def campaign(
    console: "Console",
    study: Annotated[Path, Option("STUDY")],
    *,
    out: Folder,
    workers: int | None = None,
    scheduler: Scheduler = None,
    yes: bool = False,
) -> Answer:
    """Run many cases of a study, here or on a cluster.

    A study names a base scenario, axes along which it changes, and what to do with each case. Results
    are one row a case, in DIR/results.parquet. A campaign that was stopped goes on with the same
    command.

    Args:
        study: TOML file; see docs/campaigns.md.
        out: folder for the results.
        workers: processes for the cases; 0 runs them in this one, without limits of time and memory
            (default: 1).
        yes: allow more than 100,000 cases.
    """
    from collections import Counter

    from scp_recon.api.campaigns import run_campaign
    from scp_recon.campaigns.outcome import read_campaign
    from scp_recon.campaigns.page import PAGE, has_extras, write_page
    from scp_recon.campaigns.study import read_study
    from scp_recon.cli import campaign_view as view

    cases = read_study(study, yes=yes)
    with view.continuing(console), view.progress(console) as (observe, say):
        path = run_campaign(
            cases, out, workers=workers, scheduler=scheduler, observe=observe, say=say
        )
    results = read_campaign(out)
    statuses = Counter(results.table["status"]).items()
    counts = dict(sorted(statuses, key=lambda item: (-item[1], item[0])))
    for status, count in counts.items():
        show_line(console, f"{count:10,}  {status}")
    show_written(console, path)
    pages = [write_page(results)] if has_extras() else []
    view.show_campaign(results, pages, console)
    if not pages:
        show_line(console, f"no {PAGE}: pip install 'scp_recon[report]' for the page")
    document = {
        "cases": len(cases.cases),
        "hash": cases.hash,
        "statuses": counts,
        **view.summary_of(results),
        "files": [str(file) for file in (path, *pages)],
    }
    return Answer(0, document)
