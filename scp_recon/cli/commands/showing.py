"""The commands about scenarios: `explore`, `windows`, `scenarios` and `schema`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from scp_recon.cli.command import Answer, Command, show_line, show_written
from scp_recon.cli.options import Option, Overrides

if TYPE_CHECKING:
    from rich.console import Console


@Command
def explore(
    console: "Console",
    scenario: Annotated[Path, Option("SCENARIO")],
    *,
    port: int = 0,
    no_browser: bool = False,
    overrides: Overrides = [],  # noqa: B006 -- never changed
) -> Answer:
    """Serve a page of sliders, on this machine alone.

    The plan and its 3-D view follow probability, errors, limits, burn times and navigation. Ctrl-C ends
    it.

    Args:
        scenario: a file, complete or with base = another, or a packaged one's name.
        port: of 127.0.0.1, which only this machine reaches; 0 for any free one.
        no_browser: open no browser.
    """
    from scp_recon.api import exploring

    exploring.explore(
        scenario,
        port=port,
        no_browser=no_browser,
        overrides=overrides,
        progress=lambda address: show_line(console, f"{address} (Ctrl-C ends it)"),
    )
    return Answer(0, {})


@Command
def windows(
    console: "Console",
    scenario: Annotated[Path, Option("SCENARIO")],
    *,
    begin: Annotated[str | None, Option("TIME", "--from")] = None,
    span_days: float = 2.0,
    csv: Path | None = None,
    chart: Path | None = None,
) -> Answer:
    """Find lighting windows and legal burn times.

    Args:
        scenario: a file, or a packaged one's name, such as recon_b.
        begin: where the span begins, TDB, e.g. 2020-01-21T20:33:17 (default: the scenario's epoch).
        span_days: how long it is, up to 100 days.
        csv: file to which they are written as a table, .csv.
        chart: file to which they are drawn, .png, .pdf or .svg; needs the extra [report].
    """
    from scp_recon.api import survey
    from scp_recon.api.inputs import scenario_of
    from scp_recon.cli.rendering import show_warnings
    from scp_recon.cli.survey_view import show_survey, survey_document
    from scp_recon.mission.checks import check_scene
    from scp_recon.mission.scene import Scene
    from scp_recon.scenario.load import naming_files

    given = scenario_of(scenario)
    with naming_files(scenario):
        found = survey.windows(given, begin, span_days, csv=csv, chart=chart)
    show_survey(console, given, found)
    show_warnings(console, check_scene(Scene.of(given)))
    written = [path for path in (csv, chart) if path]
    for path in written:
        show_written(console, path)
    return Answer(0, {**survey_document(given, found), "files": [str(p) for p in written]})


@Command
def scenarios(console: "Console") -> Answer:
    """List the packaged scenarios."""
    from scp_recon.api import inputs
    from scp_recon.cli.rendering import terminal
    from scp_recon.cli.survey_view import HINT, scenarios_table

    found = inputs.scenarios()
    console.print(terminal(scenarios_table(found)))
    console.print(HINT, style="dim")
    return Answer(0, {"scenarios": list(found)})


@Command
def schema(console: "Console", file: Path) -> Answer:
    """Write the JSON schema of scenario files.

    Args:
        file: where to write it.
    """
    from scp_recon.errors import option
    from scp_recon.files import check_ending, check_writable, unwritable, write_atomically
    from scp_recon.scenario.json_schema import schema_text

    entry = option("file")
    check_ending(file, entry, ".json")  # which no scenario has
    check_writable(file.parent, file.name, entry)
    try:
        path = write_atomically(file, schema_text())
    except OSError as error:
        raise unwritable(file.parent, entry, error) from None
    show_written(console, path)
    return Answer(0, {"files": [str(path)]})
