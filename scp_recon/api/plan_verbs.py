"""Functions of `import scp_recon as sr` that take plans: read, verify, fly, compare, show, export.

As those of `api.verbs` they are light at import, and commands take their options and help from them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

    from scp_recon.api.files import AnyPlan, Exported
    from scp_recon.monte_carlo.summary import Summary
    from scp_recon.results.comparison import Comparison
    from scp_recon.results.solution import Solution
    from scp_recon.results.verification import Verification
    from scp_recon.simulation.record import Record

Policy = Literal["open", "replan", "feedback"]


def load(plan: "AnyPlan") -> "Solution":
    """Read the solution in a file or a folder.

    Args:
        plan: the file or folder; a solution is returned as it is, a plan is verified first.

    Returns:
        The solution. The solution of a file has the file's verification.

    Raises:
        InputError: if `plan` is none of these, or cannot be read.

    Examples:
        >>> import scp_recon as sr
        >>> folder = sr.save(sr.plan(problem="P3"), "runs/mine").parent
        >>> sr.load(folder).problem
        'P3'
    """
    from scp_recon.api import files

    return files.stored(plan)


def save(plan: "AnyPlan", folder: str | Path) -> Path:
    """Verify a plan and write its `solution.json` into a folder, whole or not at all.

    A plan that is not verified does not overwrite a verified one: it is written beside it as
    `solution_unverified.json`. Results of another plan are renamed (`old_montecarlo.json`), and
    its exports moved (`old_export`).

    Args:
        plan: to write; a solution, or its file.
        folder: for the file; it is made.

    Returns:
        The file that was written.

    Raises:
        InputError: if it is no plan and no file of one, or the folder cannot be written.

    Examples:
        >>> import scp_recon as sr
        >>> sr.save(sr.plan(), "runs/mine").name
        'solution.json'
    """
    from scp_recon.api import files
    from scp_recon.errors import path_of
    from scp_recon.planning.plan import Plan

    given = plan if isinstance(plan, Plan) else files.stored(plan)
    path = path_of("folder", folder)
    files.check_folder(path, "folder")
    written, _ = files.keep(files.stored(given), path, "folder")
    assert written is not None
    return written


def verify(plan: "AnyPlan") -> "Verification":
    """Verify a plan without the solver: `ok`, and what `failed`.

    Args:
        plan: to verify; a solution, or its file.

    Returns:
        The verification: `ok`, what `failed`, and every figure that was checked, in SI.

    Raises:
        InputError: if it is no plan and no file of one.

    Examples:
        >>> import scp_recon as sr
        >>> sr.verify(sr.plan())
        <Verification: verified>
    """
    from scp_recon.api.files import solution_of, verified

    found = verified(solution_of(plan)).verification
    assert found is not None
    return found


def fly(
    plan: "AnyPlan",
    samples: int = 10_000,
    seed: int = 0,
    *,
    until: float | None = None,
    truth: Literal["planner", "harmonics", "polyhedron"] = "planner",
    errors: Literal["componentwise", "gates"] | None = None,
    policy: Policy | None = None,
    miss: int | None = None,
    then: Literal["return"] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> "Summary":
    """Fly a plan many times with errors.

    Args:
        plan: to fly; a solution, or its file.
        samples: flights, at most with `until`.
        seed: of all draws.
        until: stop when every joint probability's interval is this narrow, e.g. 0.005, or 0.5% on the
            command line; where 10,000 flights leave one wider, stratified flights refine it.
        truth: gravity of the "planner"; or, turning with the body, all "harmonics" of body.gravity_file
            or degree 8 of a packaged field, or a homogeneous "polyhedron", of body.solid_file or the
            ellipsoid body.radii_m.
        errors: of the burns: "componentwise", or "gates", by magnitude and pointing (default: the
            scenario's).
        policy: what burns are commanded: "open", those planned; "replan", planned again before each
            from what is estimated; "feedback", corrected by the plan's gains (default: feedback of a
            plan with gains, else open).
        miss: number of a burn that does not happen, from 1; the free drift of the same flights from it
            on is flown too, for safety.drift_s.
        then: "return": plan home from the mean state at the missed burn, as `replan` does with that
            goal, and fly that plan too.
        workers: processes; the result does not depend on their number (default: 1).
        scheduler: run on the Dask cluster of this scheduler instead, e.g. tcp://127.0.0.1:8786; needs
            the extra [cluster].

    Returns:
        Probabilities with 95 % intervals, times for which limits hold in s, distances in m, delta-v in
        m/s.

    Raises:
        InputError: naming the argument, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> emission = sr.fly(sr.plan(), samples=1000).probability["emission"]
        >>> print(f"{emission.value:.3f}, 95 % interval {emission.low:.3f} to {emission.high:.3f}")
        0.979, 95 % interval 0.968 to 0.987
    """
    from scp_recon.api.files import solution_of
    from scp_recon.api.flying import Flights, FlyOptions

    how = FlyOptions(samples, until, truth, errors, seed, workers, scheduler, policy, miss, then)
    return Flights.of(solution_of(plan), how).summary()


def simulate(
    plan: "AnyPlan",
    *,
    seed: int = 0,
    policy: Policy | None = None,
    miss: int | None = None,
    vehicle: str | Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> "Record":
    """Fly a plan once with the spacecraft in the loop: attitude control, finite burns, power.

    Needs the extra [sim].

    Args:
        plan: to fly; a solution, or its file.
        seed: of all errors.
        policy: what burns are commanded, "open", "replan" or "feedback"; from the simulated state at
            each cut-off, with errors of its measurement.
        miss: number of a burn that does not happen, from 1; no burn follows, and the flight goes on
            for safety.drift_s.
        vehicle: a TOML file (default: the packaged DARE).
        progress: called with the time of the flight, s.

    Returns:
        The record of the flight; its `summary` has the figures.

    Raises:
        InputError: naming the argument, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> flown = sr.simulate(sr.plan(), seed=1).summary
        >>> flown.least_charge > flown.floor_charge
        True
    """
    from scp_recon.api.flying import simulation_of

    return simulation_of(plan, seed, policy, vehicle, miss).fly(progress)


def compare(*plans: "AnyPlan") -> "Comparison":
    """Compare plans side by side; paths are compared with the first one's.

    Args:
        plans: folders with a solution.json, or files. In Python also plans and solutions.

    Returns:
        A table with a row for each figure: its unit and the value of every plan. A figure is found
            by its name in brackets.

    Raises:
        InputError: if there is none, or one is no plan and no file of a solution.

    Examples:
        >>> import scp_recon as sr
        >>> table = sr.compare(sr.plan(), sr.plan(problem="P3"))
        >>> print(*(f"{dv:.3f} m/s" for dv in table["total delta-v"]))
        0.126 m/s 0.108 m/s
    """
    from scp_recon.api import files
    from scp_recon.results import comparison

    files.require_some(plans)
    names = [
        str(given) if isinstance(given, str | Path) else f"plan {number}"
        for number, given in enumerate(plans, start=1)
    ]
    return comparison.compare(names, [load(given) for given in plans])


def report(
    *plans: "AnyPlan",
    out: str | Path = "report.html",
    field_deg: float | None = None,
    pixels: int | None = None,
) -> Path:
    """Show plans, or a campaign, on one page.

    It is an HTML file that works without a network: the verdict, a 3-D view in time, histories with
    their bands, probabilities, ground track, delta-v, margins, convergence. It includes flights and
    simulations beside a plan's file. Needs the extra [report].

    Args:
        plans: one to six, of one body, overlaid: folders with a solution.json, or files; or the folder
            of a campaign, finished or not, which gets its own page, campaign.html. In Python also plans
            and solutions.
        out: the page of plans.
        field_deg: full angle of the camera's field of view (default: DARE's, 21).
        pixels: across the field of view (default: DARE's, 5120).

    Returns:
        The file that was written.

    Raises:
        InputError: if one is no plan and no file of a solution, the extra [report] is missing, or the
            file cannot be written.

    Examples:
        >>> import scp_recon as sr
        >>> sr.report(sr.plan(), out="runs/mine.html").name
        'mine.html'
    """
    from scp_recon.api import files
    from scp_recon.errors import number_between, only_with, option, path_of, whole_number
    from scp_recon.reports import write
    from scp_recon.reports.shown import Camera

    write.check_extra()
    files.require_some(plans)
    if files.is_campaign(plans):
        only_with(files.PLANS_ALONE, field_deg=field_deg, pixels=pixels)
        from scp_recon.campaigns.outcome import read_campaign
        from scp_recon.campaigns.page import write_page

        return write_page(read_campaign(Path(str(plans[0]))))
    field, across = Camera().field_deg, Camera().pixels
    if field_deg is not None:
        field = number_between(option("field_deg"), field_deg, 0.01, files.FIELD_MAX_DEG)
    if pixels is not None:
        across = whole_number(option("pixels"), pixels, 1, files.PIXELS_MAX)
    return write.write_report(
        files.shown_of(plans), path_of(option("out"), out), Camera(field, across)
    )


def charts(*plans: "AnyPlan") -> "dict[str, Figure]":
    """Draw the charts of `report`, for a notebook: Plotly's figures by name.

    "flight" is the 3-D view at the middle of the observation window. With feedback there are also
    "knowledge" and dispersion over time, "ellipses" before and after each correction, and the
    distribution of the "commanded" delta-v.

    Args:
        plans: one to six, of one body; what lies beside a plan's file is shown with it.

    Returns:
        Figures of Plotly by name, with units on their axes.

    Raises:
        InputError: if one is no plan and no file of a solution, or the extra [report] is missing.

    Examples:
        >>> import scp_recon as sr
        >>> sorted(sr.charts(sr.plan()))[:3]
        ['budget', 'convergence', 'flight']
    """
    from scp_recon.api import files
    from scp_recon.reports import write

    files.require_some(plans)
    return write.charts_of(files.shown_of(plans))


def export(
    plan: "AnyPlan",
    format: Literal["oem", "spk", "ck", "csv", "parquet"],  # noqa: A002 -- every other tool has it
    out: str | Path = "export",
    *,
    spacecraft: int = -999,
    vehicle: str | Path | None = None,
    miss: int | None = None,
) -> "Exported":
    """Write a plan for other tools, sampled densely enough for their interpolation.

    Args:
        plan: to write; a solution, or its file.
        format: "oem" (CCSDS, with an OPM of the burns), "spk" or "ck" (SPICE kernels of the path, or of
            the attitude; the extra [spice]), "csv" or "parquet" (a table; the extra [parquet]).
        out: folder for the files.
        spacecraft: NAIF's number of the spacecraft, below zero; on the command line as
            --spacecraft=-64.
        vehicle: a TOML file, for "ck" (default: the packaged DARE).
        miss: number of a burn that does not happen, from 1: the path is the mean free drift from it on,
            for safety.drift_s, in files of their own.

    Returns:
        The files that were written, and the content of their headings.

    Raises:
        InputError: naming the argument, what was given and what is allowed.

    Examples:
        >>> import scp_recon as sr
        >>> files, _ = sr.export(sr.plan(), "csv", "runs/mine/export")
        >>> [file.suffix for file in files]
        ['.csv']
    """
    from scp_recon.api.files import SPACECRAFT_MIN, Exported, solution_of
    from scp_recon.errors import one_of, only_with, option, path_of, whole_number
    from scp_recon.files import check_writable, writing
    from scp_recon.interop.export import Export
    from scp_recon.interop.files import FORMATS, require, stem, write_export
    from scp_recon.simulation.vehicle import load_vehicle

    one_of(option("format"), format, FORMATS)
    spacecraft = whole_number(option("spacecraft"), spacecraft, SPACECRAFT_MIN, -1)
    require(format)
    attitude = f"{option('format')} ck"
    if format == "ck":
        only_with(f"a path, not with {attitude}", miss=miss)
    else:
        only_with(attitude, vehicle=vehicle)
    craft = load_vehicle(None if vehicle is None else path_of(option("vehicle"), vehicle))
    found, place = Export.of(solution_of(plan), spacecraft, miss), path_of(option("out"), out)
    check_writable(place, f"{stem(found)}.{format}", option("out"))
    with writing(place, option("out")):
        return Exported(write_export(found, format, place, craft), found)
