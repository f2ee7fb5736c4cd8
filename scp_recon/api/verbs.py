"""Functions of `import scp_recon as sr` that make plans, scenarios, campaigns and windows.

Commands take their options and help from these functions. The module is therefore light at import, and
each function imports what it needs when it is called.
"""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import numpy.typing as npt
    import pandas

    from formulations.arrays import Array
    from scp_recon.api.campaigns import CampaignOutput
    from scp_recon.api.designing import Design
    from scp_recon.api.drafts import NewScenario
    from scp_recon.mission.schedule import Survey
    from scp_recon.planning.plan import Plan
    from scp_recon.results.solution import Solution
    from scp_recon.scenario.schema import Scenario


def plan(
    scenario: "Scenario | str | Path | None" = None,
    init: "Plan | Solution | str | Path | Array" = "cold",
    *,
    problem: Literal["P3", "P2"] = "P2",
    method: Literal["scp", "ipopt"] = "scp",
    formulation: str | None = None,
    algorithm: str | None = None,
    solver: str | None = None,
    facet_rounds: int | Literal["settle"] = "settle",
    certify: bool | None = None,
    objective: Literal["delta-v", "probability"] = "delta-v",
    dv_budget_m_s: float | None = None,
    starts: int | Literal["auto"] | None = None,
    seed: int | None = None,
    workers: int | None = None,
    overrides: Sequence[str] = (),
) -> "Plan":
    """Plan a flyby.

    Args:
        scenario: a file, complete or with base = another, or the packaged recon_b; other packaged ones
            go with design (default: that of `init`, else recon_b).
        init: "cold", a straight line; "warm", a ballistic arc; the file or folder of a solution; a CSV
            of states t, x, y, z, vx, vy, vz in SI, J2000. In Python also a plan, a solution, or such a
            table as an array (n, 7).
        problem: "P2", with uncertainty, or "P3", without it.
        method: "scp", sequential convex programming, or "ipopt", the nonlinear programs by IPOPT.
        formulation: with scp condensed, lifted, frozen-stm or frozen-covariance (default: condensed);
            with ipopt printed, tuned or shooting (default: tuned).
        algorithm: with scp scvx, ptr or scvx-star (default: scvx).
        solver: with scp a conic solver that CVXPY finds: CLARABEL and SCS; ECOS and QOCO with the extra
            [compare] (default: CLARABEL).
        facet_rounds: of P2 with uniform risk: "settle", choose the facets again along the plan, and
            along one with exact risk, until no choice is cheaper; or choose them again at the solution
            up to this many times, 0 as in the paper; an infeasible case is tried again in any case.
        certify: with risk.allocation = exact, raise the target probability until fresh flights reach
            the required one (default: yes).
        objective: the least "delta-v"; or with risk.allocation = exact the largest "probability",
            whatever risk.p_chance says.
        dv_budget_m_s: with `objective` probability, largest delta-v of the plan, as policy.cost counts
            it, m/s (default: no limit).
        starts: plan from `init`, and from the optima of P3 to which random flights lead, for so many
            starts in all; list the distinct local optima and keep the best. "auto" ends where a further
            start finds a new optimum of P3 with a chance below 5 % (default: "auto" for fixed burns
            from a guess, with risk.allocation = exact, or where P2 has no plan or costs 30 % more than
            P3; else 1).
        seed: of the random flights (default: 0).
        workers: processes for the starts; the plan does not depend on their number (default: 1).
        overrides: `section.entry=value` each, as of `load_scenario`, e.g. risk.p_chance=0.8.

    Returns:
        The plan, not verified yet: `status` says whether it converged, `total_dv_m_s` is its delta-v.
        Burns (m, 3), states (n, 6) and covariances (n, 6, 6) are in J2000, m and m/s.

    Raises:
        InputError: naming the entry, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> found = sr.plan(sr.load_scenario("recon_b").replace({"risk.p_chance": 0.8}))
        >>> print(found.status.value.name, f"{found.total_dv_m_s:.3f} m/s")
        converged 0.129 m/s
    """
    from scp_recon.api.inputs import PlanRequest
    from scp_recon.api.options import PlanOptions
    from scp_recon.api.planning import carry_out

    how = problem, method, formulation, algorithm, solver, facet_rounds, certify
    options = PlanOptions(*how, objective, dv_budget_m_s, starts, seed, workers)
    return carry_out(PlanRequest(scenario, init, options, overrides), verifies=False).plan


def design(
    scenario: "Scenario | str | Path",
    *,
    facet_rounds: int | Literal["settle"] = "settle",
    certify: bool | None = None,
    overrides: Sequence[str] = (),
) -> "Design":
    """Choose the burn times of a pass, on a home orbit departure and arrival too, and plan it.

    Args:
        scenario: a file, or a packaged one's name.
        facet_rounds: as of `plan`; of plans while burns move between given boundary states, and of
            the last plan.
        certify: as of `plan`: with risk.allocation = exact, by fresh flights (default: yes).
        overrides: as of `plan`, e.g. risk.p_chance=0.8.

    Returns:
        The design. If no pass has a plan, its `plan` is None, and its `message` names the limit
            that the best pass violates most.

    Raises:
        InputError: naming the argument, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> found = sr.design("nightingale")
        >>> print(f"{found.plan.total_dv_m_s:.3f} m/s")
        0.018 m/s
    """
    from dataclasses import replace

    from scp_recon.api import designing
    from scp_recon.api.inputs import scenario_of
    from scp_recon.api.planning import carry_out
    from scp_recon.scenario.load import naming_files

    given = scenario_of(scenario, overrides)
    options = designing.options_for(given, certify=certify, facet_rounds=facet_rounds)
    with naming_files(scenario, overrides):
        found = designing.find_pass(given, facet_rounds=facet_rounds)
    if found.scenario is None:
        return found
    return replace(found, plan=carry_out(designing.request_of(found, options), verifies=False).plan)


def replan(
    plan: "Plan | Solution | str | Path",
    at_s: float,
    state: "npt.ArrayLike",
    covariance: "npt.ArrayLike | None" = None,
    *,
    frame: str = "j2000",
    covariance_frame: str | None = None,
    measured_burns: "Mapping[int, npt.ArrayLike] | None" = None,
    overrides: Sequence[str] = (),
    goal: Literal["observe", "return"] = "observe",
    arrive_by: float | None = None,
    free_times: bool = False,
    certify: bool | None = None,
) -> "Plan":
    """Plan the rest of a flight from a state in it.

    Burns at or before that time are flown. The next one keeps the scenario's lead time; the
    rest of the observation window counts. With fewer than two burns left the final state is met as
    nearly as possible: `verify` gives the miss. Beyond three sigma of the final dispersion
    that the flown plan predicts, the status is lost.

    Args:
        plan: the plan in flight; nodes and covariances of a solution are compared with its burns.
        at_s: time of the state, s past the plan's epoch; burns until then are flown. On the command
            line also a date in TDB.
        state: x y z in m and vx vy vz in m/s at that time, after burns flown, body-centred, shape (6,).
            On the command line also a file of these six.
        covariance: of the state, six rows of six numbers, m and m/s, on the command line their file
            (default: the scenario's initial covariance).
        frame: axes of state and measured burns, "j2000" or "sun_north", at the epoch.
        covariance_frame: axes of the covariance, these or "rtn" of the state (default: those of
            `frame`).
        measured_burns: burns flown as telemetry saw them, m/s, by their number in the flight from 1.
        overrides: as of `plan`, for the rest of the flight; burns may be added in `burns.times_s`.
        goal: "observe", or "return" to the final state without the observation (observation.required =
            false), after a missed burn say.
        arrive_by: time of the last burn, s past the epoch, in place of the scenario's: a later one
            leaves more time to return.
        free_times: move burns that are left, but the last, within the schedule's rules.
        certify: as of `plan`: with risk.allocation = exact, by fresh flights (default: yes).

    Returns:
        A plan of the remaining burns, whose `parent` names the plan in flight.

    Raises:
        InputError: naming the argument, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> flown = sr.plan()
        >>> left = sr.replan(flown, flown.times_s[80], flown.states[80])
        >>> print(f"{len(left.burns_m_s)} burns, {left.total_dv_m_s:.3f} m/s")
        2 burns, 0.050 m/s
    """
    from scp_recon.api.inputs import check_overrides
    from scp_recon.api.planning import plan_left
    from scp_recon.replanning.flown import FlownPlan
    from scp_recon.replanning.remainder import Delivery, with_goal

    check_overrides(overrides)
    flown = FlownPlan.of(plan)
    overrides = with_goal(flown, goal, arrive_by, overrides)
    delivery = Delivery.of(
        at_s,
        state,
        frame=frame,
        covariance=covariance,
        covariance_frame=covariance_frame,
        measured=measured_burns,
    )
    return plan_left(flown, delivery, overrides, certify=certify, free_times=free_times)


def campaign(
    study: str | Path | Mapping[str, Any],
    out: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    yes: bool = False,
) -> "CampaignOutput":
    """Run many cases of a study, here or on a cluster.

    A study names a base scenario, axes along which it changes, and what to do with each case; see
    docs/campaigns.md. Results are one row a case, in results.parquet. A campaign that was stopped goes
    on when it is called again. Needs the extras [campaign] and [report], with a scheduler [cluster].

    Args:
        study: a TOML file, or in Python its tables, with files relative to the current folder.
        out: folder for the results.
        workers: processes for the cases; 0 runs them in this one, without limits of time and memory
            (default: 1).
        scheduler: run on the Dask cluster of this scheduler instead, e.g. tcp://127.0.0.1:8786; needs
            the extra [cluster].
        yes: allow more than 100,000 cases.

    Returns:
        The table of all cases, and figures by name.

    Raises:
        InputError: naming the entry, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> axis = {"entry": "risk.p_chance", "values": [0.7, 0.8]}
        >>> table, _ = sr.campaign({"campaign": {}, "axis": [axis]}, "runs/study")
        >>> table["total_dv_m_s"].round(3).tolist()
        [0.14, 0.155]
    """
    from scp_recon.api.campaigns import CampaignOutput, run_campaign
    from scp_recon.campaigns import outcome, page
    from scp_recon.campaigns.study import read_study
    from scp_recon.errors import option, path_of
    from scp_recon.reports.write import check_extra

    check_extra()
    folder = path_of(option("out"), out)
    run_campaign(read_study(study, yes=yes), folder, workers=workers, scheduler=scheduler)
    results = outcome.read_campaign(folder)
    return CampaignOutput(results.table, page.figures(results))


def read_campaign(folder: str | Path) -> "pandas.DataFrame":
    """Read the rows of a campaign, finished or not, by case; unknown values are missing.

    Needs the extra [campaign].

    Args:
        folder: that `campaign` was given as `out`.

    Returns:
        A row a case; units are in the columns' names.

    Raises:
        InputError: if it holds no campaign, or the extra is missing.

    Examples:
        >>> import scp_recon as sr
        >>> axis = {"entry": "risk.p_chance", "values": [0.7, 0.8]}
        >>> _ = sr.campaign({"campaign": {}, "axis": [axis]}, "runs/study")
        >>> sr.read_campaign("runs/study")["status"].tolist()
        ['converged', 'converged']
    """
    from scp_recon.campaigns.run import read_results
    from scp_recon.errors import path_of

    return read_results(path_of("folder", folder))


def new(
    name: str,
    body: str,
    site: tuple[float, float],
    epoch: datetime | str | None = None,
    *,
    gm: float | None = None,
    radius: float | None = None,
    period: float | None = None,
    pole: tuple[float, float] | None = None,
    orbit: Sequence[float] | None = None,
    from_spice: str | Path | None = None,
    spacecraft: int | None = None,
    from_oem: str | Path | None = None,
    from_csv: str | Path | None = None,
    begin: datetime | str | None = None,
    end: datetime | str | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> "NewScenario":
    """Draft a scenario for one's own site and body, plan it, and write it to NAME.toml.

    With a trajectory of another tool, the initial guess from it is written to NAME_start.csv as
    well.

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
        spacecraft: NAIF's number in the kernels, below zero; on the command line as --spacecraft=-64.
        from_oem: a CCSDS OEM: boundary states and start from it, `begin` and `end` if given.
        from_csv: a table of states as solve --init takes it, its t_s past `epoch`, which it needs; the
            rest as with `from_oem`.
        begin: first burn, with a trajectory only, UTC, e.g. 2020-01-21T20:32:08.
        end: last burn, with a trajectory only, UTC, e.g. 2020-01-21T20:32:08.
        progress: called with a line on each planned draft.

    Returns:
        The scenario, its plan with the verification, and the files.

    Raises:
        InputError: naming the argument, what was given and what is allowed; if a file is there already
            or cannot be written, or nothing can be drafted.

    Examples:
        >>> import scp_recon as sr
        >>> drafted = sr.new("mission", "Bennu", (20.0, 150.0), "2020-01-21T20:33:17")
        >>> drafted.is_verified, [file.name for file in drafted.files]
        (True, ['mission.toml'])
    """
    from scp_recon.api.drafts import NewOptions, draft

    of_body = gm, radius, period, pole, orbit
    of_track = from_spice, spacecraft, from_oem, from_csv, begin, end
    options = NewOptions.of(name, body, site, epoch, *of_body, *of_track)
    return draft(options, progress)


def explore(
    scenario: "Scenario | str | Path",
    *,
    port: int = 0,
    no_browser: bool = False,
    overrides: Sequence[str] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> None:
    """Serve a page of sliders, on this machine alone, until Ctrl-C.

    The plan and its 3-D view follow probability, errors, limits, burn times and navigation.

    Args:
        scenario: a file, complete or with base = another, or a packaged one's name.
        port: of 127.0.0.1, which only this machine reaches; 0 for any free one.
        no_browser: open no browser.
        overrides: as of `plan`, e.g. risk.p_chance=0.8.
        progress: called with the address of the page.

    Raises:
        InputError: if the scenario cannot be planned, the extra [report] is missing, or the port is not
            free.

    Examples:
        >>> import scp_recon as sr
        >>> sr.explore("recon_b", port=80_000)
        Traceback (most recent call last):
        scp_recon.errors.InputError: port: got 80000; must be a whole number from 0 to 65535
    """
    from scp_recon.api.exploring import serve

    serve(scenario, port, overrides, progress, browser=not no_browser)


def windows(
    scenario: "Scenario | str | Path",
    begin: datetime | str | None = None,
    span_days: float = 2.0,
    *,
    csv: str | Path | None = None,
    chart: str | Path | None = None,
) -> "Survey":
    """Find the lighting windows of a span, and the legal burn times about each.

    Args:
        scenario: a file, or a packaged one's name, such as recon_b.
        begin: where the span begins, TDB, e.g. 2020-01-21T20:33:17 (default: the scenario's epoch).
        span_days: how long it is, up to 100 days.
        csv: file to which they are written as a table, .csv.
        chart: file to which they are drawn, .png, .pdf or .svg; needs the extra [report].

    Returns:
        The windows, in s past the scenario's epoch, with legal burn times about each.

    Raises:
        InputError: naming the argument, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> len(sr.windows("recon_b", span_days=1.0).windows)
        5
    """
    from scp_recon.api import designing
    from scp_recon.api.inputs import date_in_tdb, scenario_of
    from scp_recon.bodies.catalogue import DAY_S
    from scp_recon.errors import InputError, needing, number_between, option
    from scp_recon.files import PICTURE, check_own, write_for
    from scp_recon.mission.schedule import survey
    from scp_recon.scenario.load import naming_files

    number_between(option("span_days"), span_days, 0.01, designing.DAYS_MAX)
    given = scenario_of(scenario)
    epoch = given.epoch.tdb
    first = ((date_in_tdb(option("begin"), begin) or epoch) - epoch).total_seconds()
    if abs(first) > designing.DAYS_MAX * DAY_S:
        within = f"must be within {designing.DAYS_MAX:g} days of the scenario's epoch"
        allowed = f"{within}, {epoch.isoformat()}: its orbit is two-body motion from there"
        raise InputError(option("begin"), str(begin), allowed)
    if csv is not None:
        check_own(Path(csv), option("csv"), designing.MARK, ".csv")
    if chart is not None:
        with needing(option("chart"), "report"):
            from scp_recon.reports.pictures import draw_windows, endings
        check_own(Path(chart), option("chart"), PICTURE, *endings())
    with naming_files(scenario):
        found = survey(given, (first, first + span_days * DAY_S))
    if csv is not None:
        write_for(option("csv"), Path(csv), designing.windows_table(found).csv())
    if chart is not None:
        write_for(option("chart"), Path(chart), draw_windows(given, found, Path(chart).suffix))
    return found


def scenarios() -> "dict[str, Scenario]":
    """The packaged scenarios by name: `plan` takes recon_b, `design` all.

    Returns:
        The scenarios by name.

    Examples:
        >>> import scp_recon as sr
        >>> sr.scenarios()["recon_b"]
        <Scenario recon_b: Bennu, site Nightingale, 4 burns>
    """
    from scp_recon.errors import Named
    from scp_recon.scenario.load import base_names, packaged_scenario

    return Named({name: packaged_scenario(name) for name in base_names()})
