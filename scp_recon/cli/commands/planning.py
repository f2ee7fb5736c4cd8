"""The commands that plan and that show scenarios; options and help are of `api.verbs`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from scp_recon.api import verbs
from scp_recon.cli.command import Answer, command, show_line, show_written
from scp_recon.cli.options import Option

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from scp_recon.api.inputs import PlanRequest


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
            assert outcome.kept.path is not None
            write_report_of(outcome.kept.path.parent, console)
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
    from scp_recon.cli import design_view as view
    from scp_recon.cli.plan_run import Shown
    from scp_recon.scenario.load import naming_files, scenario_text
    from scp_recon.scp.status import Status

    scenario = scenario_of(given["scenario"], given["overrides"])
    rounds = given["facet_rounds"]
    how = options_for(scenario, certify=given["certify"], facet_rounds=rounds)
    with Shown(console, out, verbose=verbose) as shown:
        folder = shown.open(scenario.name)
        view.check_files(folder)
        with view.progress(console) as observe, naming_files(given["scenario"], given["overrides"]):
            found = find_pass(scenario, observe, rounds)
        view.keep(folder, view.TABLE, trials_table(found).csv())
        if found.scenario is None:
            view.keep_map(folder, found, console, found.best.dv_m_s)
            show_line(console, found.message)
            show_written(console, folder / view.TABLE)
            files = [str(folder / view.TABLE)]
            return Answer(Status.INFEASIBLE.value.exit_code, {"files": files})
        view.keep(folder, view.SCENARIO, view.HEAD + scenario_text(found.scenario))
        shown.found = folder / view.SCENARIO
        answer = shown.answer(carry_out(request_of(found, how), shown))
        view.keep_map(folder, found, console, answer.document["plan"]["total_dv_m_s"])
        view.keep_primer(folder, console)
        for price in found.prices:
            show_line(console, str(price))
    return answer


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
    from dataclasses import replace

    from scp_recon.api.planning import carry_out, request_of_rest
    from scp_recon.cli.delivery import read_delivery
    from scp_recon.cli.plan_run import Shown
    from scp_recon.errors import InputError, option
    from scp_recon.replanning.flown import FlownPlan
    from scp_recon.replanning.remainder import mission_left, with_goal
    from scp_recon.results.read import read_solution
    from scp_recon.results.runs import folder_of, resolve_run

    home = resolve_run(plan)
    if out is not None and out.resolve() == folder_of(home).resolve():
        named = f"{out}, which holds the plan in flight"
        raise InputError(option("out"), named, "must be a folder of its own")
    solution = read_solution(home)
    overrides, goal, arrive_by = (given.pop(key) for key in ("overrides", "goal", "arrive_by"))
    delivery = read_delivery(solution.scenario.epoch.tdb, **given)
    flown = FlownPlan.of(solution, name=str(home))
    overrides = with_goal(flown, goal, arrive_by, overrides)

    def rest(more: "Sequence[str]" = ()) -> "PlanRequest":
        mission = mission_left(flown, delivery, [*overrides, *more])
        made = request_of_rest(flown, mission, certify=certify, free_times=free_times)
        return replace(made, remade=rest)

    request = rest()
    with Shown(console, out, verbose=verbose) as shown:
        return shown.answer(carry_out(request, shown))


@command(verbs.new)
def new(console: "Console", **given: Any) -> Answer:
    """Draft a scenario for one's own site and body."""
    from scp_recon.cli import plan_view
    from scp_recon.cli.command import NOT_VERIFIED
    from scp_recon.scp.status import Status

    found = verbs.new(**given, progress=lambda line: show_line(console, line))
    plan_view.show_mission(console, found.mission)
    plan_view.show_plan(
        console, found.mission, found.solution, found.verification, found.mission.warnings
    )
    for file in found.files:
        show_written(console, file)
    code = Status.named(found.solution.status).value.exit_code
    status = code or (0 if found.is_verified else NOT_VERIFIED)
    return Answer(status, plan_view.plan_document(found.solution, found.files))


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
    from scp_recon.cli import campaign_view as view

    cases = read_study(study, yes=yes)
    with view.continuing(console), view.progress(console) as (observe, say):
        path = run_campaign(cases, out, observe=observe, say=say, **given)
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


@command(verbs.windows)
def windows(console: "Console", **given: Any) -> Answer:
    """Find lighting windows and legal burn times."""
    from scp_recon.cli.rendering import show_warnings
    from scp_recon.cli.survey_view import show_survey, survey_document
    from scp_recon.mission.checks import check_scene
    from scp_recon.mission.scene import Scene

    found = verbs.windows(**given)
    scenario = found.scenario
    show_survey(console, scenario, found)
    show_warnings(console, check_scene(Scene.of(scenario)))
    written = [path for path in (given["csv"], given["chart"]) if path]
    for path in written:
        show_written(console, path)
    return Answer(0, {**survey_document(scenario, found), "files": [str(p) for p in written]})


@command()
def scenarios(console: "Console") -> Answer:
    """List the packaged scenarios."""
    from scp_recon.cli.rendering import terminal
    from scp_recon.cli.survey_view import HINT, scenarios_table

    found = verbs.scenarios()
    console.print(terminal(scenarios_table(found)))
    console.print(HINT, style="dim")
    return Answer(0, {"scenarios": list(found)})


@command(file=Option("FILE", read=Path))
def schema(console: "Console", file: Path) -> Answer:
    """Write the JSON schema of scenario files.

    Args:
        file: where to write it.
    """
    from scp_recon.errors import option
    from scp_recon.files import check_ending, check_own, check_writable, write_atomically, writing
    from scp_recon.scenario.json_schema import TITLE, schema_text

    entry = option("file")
    check_ending(file, entry, ".json")  # which no scenario has
    check_own(file, entry, TITLE.encode())
    check_writable(file.parent, file.name, entry)
    with writing(file.parent, entry):
        write_atomically(file, schema_text())
    show_written(console, file)
    return Answer(0, {"files": [str(file)]})
