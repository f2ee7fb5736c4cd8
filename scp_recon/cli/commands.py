"""The commands, each a typed function; options and help are of `api.verbs` and `api.plan_verbs`.

This module is light at import, for a quick --help: a command imports what it needs when it is called.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scp_recon.api import plan_verbs, verbs
from scp_recon.cli.command import (
    NOT_VERIFIED,
    Answer,
    asked_to_stop,
    command,
    show_line,
    show_written,
)
from scp_recon.cli.options import Option

if TYPE_CHECKING:
    from rich.console import Console


@command(verbs.plan)
def solve(
    console: "Console",
    file: Path | None = None,
    *,
    report: bool = False,
    out: Path | None = None,
    verbose: bool = False,
    **planning: Any,
) -> Answer:
    """Plan a flyby.

    Args:
        file: in place of `scenario`: a file, or a packaged one's name.
        report: write report.html too, a page to look at; the extra [report].
        out: folder for solution.json (default: runs/NAME/UTC with the scenario's name, to which
            runs/latest then points); a verified plan there is overwritten only by a verified one.
        verbose: show boundary states, schedule, grid, each iteration and the re-integration too.
    """
    from scp_recon.api.inputs import PlanRequest
    from scp_recon.api.options import PlanOptions
    from scp_recon.api.planning import carry_out
    from scp_recon.cli.plan_run import Shown, show_largest, undoing, write_report_of
    from scp_recon.errors import InputError, option
    from scp_recon.scp.status import Status

    scenario, init, overrides = map(planning.pop, ("scenario", "init", "overrides"))
    how = PlanOptions(**planning)
    if report:
        from scp_recon.reports.write import check_extra

        check_extra()
    if file is not None and scenario is not None:
        allowed = f"must be given once, with {option('scenario')} or without"
        raise InputError("SCENARIO", f"{file} and {scenario}", allowed)
    request = PlanRequest(scenario if file is None else file, init, how, overrides)
    with Shown(console, out, undoing(how), verbose=verbose) as shown:
        outcome = carry_out(request, shown)
        answer = shown.answer(outcome)
        if how.objective == "probability" and answer.status == 0:
            show_largest(how.dv_budget_m_s, outcome.plan, console)
        if report and answer.status != Status.INTERRUPTED.value.exit_code:
            write_report_of(outcome, console)
    return answer


@command(verbs.design)
def design(
    console: "Console", *, out: Path | None = None, verbose: bool = False, **given: Any
) -> Answer:
    """Choose the burn times of a pass, on a home orbit departure and arrival too, and plan it.

    Args:
        out: folder for solution.json, scenario.toml, design.csv and pictures (default: runs/NAME/UTC
            with the scenario's name, to which runs/latest then points); a verified plan there is
            overwritten only by a verified one.
        verbose: show boundary states, schedule, grid, each iteration and the re-integration too.
    """
    from scp_recon.api.designing import find_pass, options_for, request_of, trials_table
    from scp_recon.api.inputs import scenario_of
    from scp_recon.api.planning import carry_out
    from scp_recon.cli import plan_run as view
    from scp_recon.errors import option
    from scp_recon.files import check_own, write_for
    from scp_recon.scenario.load import naming_files, scenario_text
    from scp_recon.scp.status import Status

    source, entry = (given.pop("scenario"), given.pop("overrides")), option("out")
    scenario = scenario_of(*source)
    how = options_for(scenario, **given)
    with view.Shown(console, out, verbose=verbose) as shown:
        folder = shown.open(scenario.name)
        for name, mark in view.MARKS.items():
            check_own(folder / name, entry, mark)
        with view.design_progress(console) as observe, naming_files(*source):
            found = find_pass(scenario, observe, how.facet_rounds)
        table = write_for(entry, folder / view.TABLE, trials_table(found).csv())
        view.draw_map(found, folder, console)
        if found.scenario is None:
            show_line(console, found.message)
            show_written(console, table)
            return Answer(Status.INFEASIBLE.value.exit_code, {"files": [str(table)]})
        text = view.HEAD + scenario_text(found.scenario)
        shown.found = write_for(entry, folder / view.SCENARIO, text)
        outcome = carry_out(request_of(found, how), shown)
        if outcome.plan.status is Status.CONVERGED:
            show_line(console, view.primer_says(outcome.solution.primer))
            view.draw_primer(outcome.solution, folder)
        for price in found.prices:
            show_line(console, str(price))
        return shown.answer(outcome)


@command(verbs.replan)
def replan(
    console: "Console",
    plan: Path,
    *,
    out: Path | None = None,
    free_times: bool = False,
    certify: bool | None = None,
    verbose: bool = False,
    **given: Any,
) -> Answer:
    """Plan the rest of a flight.

    Args:
        plan: the plan in flight: the folder with its solution.json, or the file.
        measured_burns: a flown burn as telemetry saw it, m/s, by its number in the flight; may be
            repeated.
        out: as of solve, but not the folder of the plan in flight.
        verbose: show boundary states, schedule, grid, each iteration and the re-integration too.
    """
    from scp_recon.api.inputs import PlanRequest, RestOfFlight
    from scp_recon.api.options import PlanOptions
    from scp_recon.api.planning import carry_out
    from scp_recon.cli.options import read_delivery
    from scp_recon.cli.plan_run import Shown
    from scp_recon.errors import InputError, option
    from scp_recon.replanning.flown import FlownPlan
    from scp_recon.replanning.remainder import with_goal
    from scp_recon.results.read import folder_of, read_solution, resolve_run

    home = resolve_run(plan)
    if out is not None and out.resolve() == folder_of(home).resolve():
        named = f"{out}, which holds the plan in flight"
        raise InputError(option("out"), named, "must be a folder of its own")
    solution = read_solution(home)
    overrides, goal, arrive_by = map(given.pop, ("overrides", "goal", "arrive_by"))
    delivery = read_delivery(solution.scenario.epoch.tdb, **given)
    flown = FlownPlan.of(solution, name=str(home))
    overrides = with_goal(flown, goal, arrive_by, overrides)
    rest, options = RestOfFlight(flown, delivery, free_times), PlanOptions(certify=certify)
    request = PlanRequest(rest, options=options, overrides=overrides)
    with Shown(console, out, verbose=verbose) as shown:
        return shown.answer(carry_out(request, shown))


@command(plan_verbs.verify)
def verify(console: "Console", plan: Path, *, verbose: bool = False) -> Answer:
    """Verify a solution again.

    Args:
        verbose: show boundary states, schedule, grid, margins at nodes and the re-integration too.
    """
    from scp_recon.api.files import solution_of, verified
    from scp_recon.cli import plan_view

    solution = solution_of(plan)
    mission = solution.mission
    plan_view.show_mission(console, mission, verbose=verbose)
    checked = verified(solution)
    found = checked.verification
    assert found is not None
    warnings = [*solution.warnings, *mission.warnings]
    plan_view.show_plan(console, mission, checked, warnings, verbose=verbose)
    return Answer(0 if found.ok else NOT_VERIFIED, plan_view.plan_document(checked))


@command(plan_verbs.fly)
def montecarlo(console: "Console", plan: Path, **how: Any) -> Answer:
    """Fly a plan many times with errors."""
    from scp_recon.api.files import solution_of
    from scp_recon.api.flying import Flights, FlyOptions
    from scp_recon.cli.views import flights_bar, show_summary, show_verdict, show_warnings
    from scp_recon.results.read import folder_of, resolve_run
    from scp_recon.scp.status import Status
    from scp_recon.verification.causes import shortfalls
    from scp_recon.verification.probabilities import required_probability

    options = FlyOptions(**how)
    home = resolve_run(plan)
    solution = solution_of(home)
    flights = Flights.of(solution, options)  # before a bar is shown
    with asked_to_stop() as stop, flights_bar(console, options.samples) as progress:
        watch = progress, stop, partial(show_line, console)
        path, summary, widest, interrupted = flights.into(folder_of(home), *watch)
    document = {"files": [str(path)]}
    if interrupted:
        count = summary.samples
        show_line(console, f"interrupted: {count} of {options.samples} flights are summarised")
        show_written(console, path)
        return Answer(Status.INTERRUPTED.value.exit_code, {"samples": count, **document})
    show_summary(console, summary, required_probability(solution))
    show_warnings(console, [*solution.warnings, *solution.mission.warnings])
    failed = shortfalls(summary, solution)
    if options.until is not None and widest > options.until:
        found = f"widest interval {100.0 * widest:.3g} %, required {100.0 * options.until:g} %"
        failed.append(f"{found}: needs more --samples")
    free = summary.drift is not None and summary.drift.required is None
    word = "nothing is required of this drift" if free and not failed else "as required"
    show_verdict(console, word, failed, None if free else summary.terminal.missed)
    show_written(console, path)
    document = {"failed": failed, **document, **summary.model_dump(mode="json")}
    return Answer(NOT_VERIFIED if failed else 0, document)


@command(plan_verbs.simulate)
def simulate(console: "Console", plan: Path, *, out: Path | None = None, **how: Any) -> Answer:
    """Fly a plan once with the spacecraft in the loop.

    Args:
        out: folder for simulation.npz (default: the plan's).
    """
    from scp_recon.api.files import results_beside
    from scp_recon.api.flying import simulation_of
    from scp_recon.cli.views import flights_bar, show_flight, show_verdict, show_warnings
    from scp_recon.errors import option
    from scp_recon.files import writing
    from scp_recon.results.read import folder_of, resolve_run
    from scp_recon.simulation import record as records
    from scp_recon.simulation.vehicle import check_vehicle
    from scp_recon.verification.causes import shortfalls

    home = resolve_run(plan)
    simulation = simulation_of(home, **how)  # before a bar is shown
    solution = simulation.solution
    folder, entry = out or folder_of(home), option("out")
    name = records.file_name(simulation.miss)
    with results_beside(folder, solution, name, entry, records.MARK):
        with flights_bar(console, solution.scenario.duration_s, one=True) as progress:
            record = simulation.fly(progress)
        with writing(folder, entry):
            path = records.write_record(record, folder)
    show_flight(console, record.summary)
    other = check_vehicle(simulation.craft, solution.scenario)
    show_warnings(console, [*solution.warnings, *solution.mission.warnings, *other])
    failed = shortfalls(record.summary, solution)
    show_verdict(console, "as required", failed)
    show_written(console, path)
    document = {"failed": failed, "files": [str(path)], "summary": record.summary.entries()}
    return Answer(NOT_VERIFIED if failed else 0, document)


@command(verbs.campaign)
def campaign(
    console: "Console", study: Path, *, out: Path, yes: bool = False, **given: Any
) -> Answer:
    """Run many cases of a study, here or on a cluster.

    A study names a base scenario, axes along which it changes, and what to do with each case. Results
    are one row a case, in DIR/results.parquet. A campaign that was stopped goes on with the same
    command.

    Args:
        study: TOML file; see docs/campaigns.md.
    """
    from collections import Counter

    from scp_recon.api.campaigns import run_campaign
    from scp_recon.campaigns.outcome import read_campaign
    from scp_recon.campaigns.page import PAGE, has_extras, write_page
    from scp_recon.campaigns.study import read_study
    from scp_recon.cli.views import cases_bar, continuing, show_campaign

    cases = read_study(study, yes=yes)
    with continuing(console), cases_bar(console) as (observe, say):
        path = run_campaign(cases, out, observe=observe, say=say, **given)
    results = read_campaign(out)
    counts = dict(Counter(sorted(results.table["status"])).most_common())
    for status, count in counts.items():
        show_line(console, f"{count:10,}  {status}")
    show_written(console, path)
    pages = [write_page(results)] if has_extras() else []
    said = show_campaign(results, pages, console)
    if not pages:
        show_line(console, f"no {PAGE}: pip install 'scp_recon[report]' for the page")
    document = {"cases": len(cases.cases), "hash": cases.hash, "statuses": counts, **said}
    return Answer(0, {**document, "files": [str(file) for file in (path, *pages)]})


@command(plan_verbs.compare)
def compare(console: "Console", **given: Any) -> Answer:
    """Compare plans side by side; paths are compared with the first one's."""
    from scp_recon.cli.views import show_warnings, terminal
    from scp_recon.errors import printable

    found = plan_verbs.compare(*given["plans"])
    console.print(terminal(found.table))
    for name, solution in zip(found.names, found.plans, strict=True):
        show_warnings(console, solution.warnings, of=printable(name))
    rows = [{"name": name, "unit": unit, "values": row} for name, unit, row in found.rows]
    return Answer(0, {"plans": list(found.names), "rows": rows})


@command(plan_verbs.report, out=Option("FILE", read=Path))
def report(console: "Console", *, out: Path | None = None, **given: Any) -> Answer:
    """Show plans, or a campaign, on one page.

    It is an HTML file that works without a network: the verdict, a 3-D view in time, histories with
    their bands, probabilities, ground track, delta-v, margins, convergence. It includes flights and
    simulations beside a plan.

    Args:
        out: the page of plans (default: report.html in the first plan's folder).
    """
    from scp_recon.api import files
    from scp_recon.results.read import folder_of, resolve_run

    plans = given.pop("plans")
    if files.is_campaign(tuple(plans)):
        from scp_recon.campaigns.outcome import read_campaign
        from scp_recon.campaigns.page import write_page
        from scp_recon.cli.views import show_campaign
        from scp_recon.errors import only_with

        only_with(files.PLANS_ALONE, out=out, **given)
        results = read_campaign(plans[0])
        path = write_page(results)
        said = show_campaign(results, [path], console)
        return Answer(0, {**said, "files": [str(path)]})
    from scp_recon.reports.write import FILE_NAME  # charts and ground tracks, of this command alone

    file = out or folder_of(resolve_run(plans[0])) / FILE_NAME
    path = plan_verbs.report(*plans, out=file, **given)
    show_line(console, f"{path.stat().st_size / 1e6:.1f} MB")
    show_written(console, path)
    return Answer(0, {"files": [str(path)]})


@command(verbs.explore)
def explore(console: "Console", **given: Any) -> Answer:
    """Serve a page of sliders, on this machine alone.

    The plan and its 3-D view follow probability, errors, limits, burn times and navigation. Ctrl-C ends
    it.
    """
    verbs.explore(
        **given, progress=lambda address: show_line(console, f"{address} (Ctrl-C ends it)")
    )
    return Answer(0, {})


@command(plan_verbs.export)
def export(console: "Console", plan: Path, *, out: Path | None = None, **given: Any) -> Answer:
    """Write a plan for other tools.

    Args:
        out: folder for the files (default: export in PLAN's).
    """
    from scp_recon.api.files import EXPORTS
    from scp_recon.cli.plan_view import export_document
    from scp_recon.cli.views import show_verdict
    from scp_recon.interop.export import heading
    from scp_recon.results.read import folder_of, resolve_run

    home = resolve_run(plan)
    written, found = plan_verbs.export(home, out=out or folder_of(home) / EXPORTS, **given)
    for line in heading(found):
        show_line(console, line)
    show_verdict(console, "verified", found.shortfalls)
    for file in written:
        show_written(console, file)
    return Answer(NOT_VERIFIED if found.shortfalls else 0, export_document(found, written))


@command(verbs.new)
def new(console: "Console", **given: Any) -> Answer:
    """Draft a scenario for one's own site and body."""
    from scp_recon.cli.plan_view import exit_code, plan_document, show_mission, show_plan

    found = verbs.new(**given, progress=partial(show_line, console))
    mission, solution = found.mission, found.solution
    show_mission(console, mission)
    show_plan(console, mission, solution, mission.warnings)
    for file in found.files:
        show_written(console, file)
    return Answer(exit_code(solution), plan_document(solution, found.files))


@command(verbs.windows)
def windows(console: "Console", **given: Any) -> Answer:
    """Find lighting windows and legal burn times."""
    from scp_recon.cli.views import show_survey, show_warnings, survey_document
    from scp_recon.mission.checks import check_scene
    from scp_recon.mission.scene import Scene

    found = verbs.windows(**given)
    show_survey(console, found)
    show_warnings(console, check_scene(Scene.of(found.scenario)))
    written = [path for path in (given["csv"], given["chart"]) if path]
    for path in written:
        show_written(console, path)
    return Answer(0, {**survey_document(found), "files": [str(path) for path in written]})


@command()
def scenarios(console: "Console") -> Answer:
    """List the packaged scenarios."""
    from scp_recon.cli.views import scenarios_table, show_table

    found = verbs.scenarios()
    show_table(console, scenarios_table(found))
    return Answer(0, {"scenarios": list(found)})


@command(file=Option("FILE", read=Path))
def schema(console: "Console", file: Path) -> Answer:
    """Write the JSON schema of scenario files.

    Args:
        file: where to write it.
    """
    from scp_recon.errors import option
    from scp_recon.files import check_own, check_writable, write_for
    from scp_recon.scenario.json_schema import TITLE, schema_text

    entry = option("file")
    check_own(file, entry, TITLE.encode(), ".json")  # which no scenario has
    check_writable(file.parent, file.name, entry)
    write_for(entry, file, schema_text())
    show_written(console, file)
    return Answer(0, {"files": [str(file)]})


COMMANDS = {
    one.name: one
    for one in (
        *(solve, design, replan, verify, montecarlo, simulate, campaign, compare),
        *(report, explore, export, new, windows, scenarios, schema),
    )
}
"""Commands by name, in the order of the help."""
