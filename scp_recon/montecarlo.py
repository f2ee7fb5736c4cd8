"""Fly a plan many times: `python -m scp_recon.montecarlo DIR --samples 10000`."""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, run_command, show_written

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn
from rich.table import Table
from scipy.stats import chi2, normaltest

from scp_recon.cli.options import SEED, int_between
from scp_recon.files import check_writable, unwritable, write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate, Tally, proportion
from scp_recon.monte_carlo.flights import Campaign, CampaignConfig, fly_campaign
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.solution.file import Solution, read_solution

SCHEMA = "scp_recon.montecarlo/1"
FILE_NAME = "montecarlo.json"
ONE_SIGMA, TWO_SIGMA, CLOSEST = 0.15866, 0.02275, 0.003
"""Lower normal tails at one and two sigma; the paper's quantile of the closest approach."""

COMPONENTS = ("x", "y", "z", "vx", "vy", "vz")


def summarise(campaign: Campaign, solution: Solution) -> dict[str, Any]:
    """Everything a campaign found, as written to `montecarlo.json`; SI."""
    setting = campaign.setting
    probabilities = {}
    for name in campaign.node_counts:
        at, estimate = campaign.worst_probability(name)
        probabilities[name] = _entry(estimate) | {"worst_t_s": at}
    held = {}
    for name, tally in campaign.held.items():
        full = proportion(campaign.full[name], campaign.samples)
        held[name] = {
            "mean": _entry(tally.mean()),
            "worst_1_sigma": _entry(tally.quantile(ONE_SIGMA)),
            "worst_2_sigma": _entry(tally.quantile(TWO_SIGMA)),
            "throughout": _entry(full),
            "histogram": _histogram(tally),
        }
    return {
        "schema": SCHEMA,
        "samples": campaign.samples,
        "seed": setting.seed,
        "truth": setting.truth,
        "errors": setting.errors,
        "confidence": CONFIDENCE,
        "planned_dv_m_s": solution.total_dv_m_s,
        "window_s": list(setting.mission.schedule.window_s),
        "held_s": held,
        "entry_s": _spread(campaign.entry),
        "exit_s": _spread(campaign.exit),
        "probability": probabilities,
        "closest_m": _spread(campaign.closest)
        | {"worst": _entry(campaign.closest.quantile(CLOSEST))},
        "executed_dv_m_s": _spread(campaign.executed_dv),
        "terminal": _terminal(campaign, solution),
    }


def _entry(estimate: Estimate) -> dict[str, float | None]:
    """As JSON, which has no infinity: an open end is null."""
    return {k: v if np.isfinite(v) else None for k, v in estimate._asdict().items()}


def _spread(tally: Tally) -> dict[str, Any]:
    if not tally.samples:
        return {"samples": 0}
    return {
        "samples": tally.samples,
        "mean": _entry(tally.mean()),
        "q05": _entry(tally.quantile(0.05)),
        "q95": _entry(tally.quantile(0.95)),
    }


def _histogram(tally: Tally) -> dict[str, Any]:
    """Bins that hold anything."""
    used = np.flatnonzero(tally.counts)
    return {
        "bin": float(tally.edges[1] - tally.edges[0]),
        "start": tally.edges[used].tolist(),
        "count": tally.counts[used].tolist(),
    }


def _terminal(campaign: Campaign, solution: Solution) -> dict[str, Any]:
    """Final state against the planner's prediction, and how normal it is.

    The ratio of a sampled to the true variance is chi-squared over its degrees of freedom if the
    state is normal, which gives the interval of the ratio of the sigmas. Normality is tested by
    D'Agostino and Pearson's test; the quantiles are those of the standardised components. A
    component without spread is left out.
    """
    n, kept = campaign.samples, campaign.terminal
    predicted = np.diag(np.array(solution.nodes.covariance[-1]))
    spread = np.flatnonzero((predicted > 0.0) & (kept.std(axis=0) > 0.0))
    ratios = np.sqrt(np.diag(campaign.terminal_covariance())[spread] / predicted[spread])
    tails = [
        float(chi2.ppf(p, n - 1)) / (n - 1)
        for p in (0.5 + 0.5 * CONFIDENCE, 0.5 - 0.5 * CONFIDENCE)
    ]
    levels = (np.arange(1, 100) / 100.0).tolist()
    kept = kept[:, spread]
    standard = (kept - kept.mean(axis=0)) / kept.std(axis=0, ddof=1)
    names = [COMPONENTS[i] for i in spread]
    return {
        "sigma_ratio": {
            name: {"value": r, "low": r / np.sqrt(tails[0]), "high": r / np.sqrt(tails[1])}
            for name, r in zip(names, ratios.tolist(), strict=True)
        },
        "normality": {
            name: {
                "samples": len(kept),
                "p_value": float(normaltest(kept[:, i]).pvalue),
                "levels": levels,
                "quantiles": np.quantile(standard[:, i], levels).tolist(),
            }
            for i, name in enumerate(names)
        },
    }


def show(console: Console, report: dict[str, Any]) -> None:
    """The figures that matter, with their intervals."""
    first, last = report["window_s"]
    console.print(
        f"{report['samples']} flights, truth {report['truth']}, errors {report['errors']}, "
        f"{100 * report['confidence']:.0f} % intervals; window {last - first:.1f} s",
        highlight=False,
    )
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in ("time held, s", "mean", "worst 1 sigma", "worst 2 sigma", "throughout"):
        table.add_column(heading, justify="left" if heading == "time held, s" else "right")
    for name, held in report["held_s"].items():
        table.add_row(
            "all at once" if name == ALL else name,
            _shown(held["mean"], 0, "\n"),
            _shown(held["worst_1_sigma"], 0, "\n"),
            _shown(held["worst_2_sigma"], 0, "\n"),
            _shown(held["throughout"], 4, "\n"),
        )
    console.print(table)
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in ("joint constraint", "lowest probability", "at s"):
        table.add_column(heading, justify="left" if heading == "joint constraint" else "right")
    for name, p in report["probability"].items():
        label = "all at once" if name == ALL else name
        table.add_row(label, _shown(p, 4), f"{p['worst_t_s']:.0f}")
    console.print(table)
    for label, key, digits in (
        ("all hold from", "entry_s", 0),
        ("all hold until", "exit_s", 0),
        ("closest approach m", "closest_m", 1),
        ("executed delta-v m/s", "executed_dv_m_s", 5),
    ):
        spread = report[key]
        if spread["samples"]:
            low, high = spread["q05"]["value"], spread["q95"]["value"]
            mean = _shown(spread["mean"], digits)
            console.print(
                f"{label:21} {mean}; 90 % of flights {low:.{digits}f} to {high:.{digits}f}",
                highlight=False,
            )
    worst = _shown(report["closest_m"]["worst"], 1)
    console.print(f"closest approach, 0.3 % quantile: {worst} m", highlight=False)
    if not report["terminal"]["sigma_ratio"]:
        console.print("final state: no component spreads", highlight=False)
        return
    ratios = ", ".join(
        f"{name} {_shown(r, 3)}" for name, r in report["terminal"]["sigma_ratio"].items()
    )
    console.print(f"final state, sampled over predicted sigma: {ratios}", highlight=False)
    normal = ", ".join(
        f"{name} {t['p_value']:.2g}" for name, t in report["terminal"]["normality"].items()
    )
    console.print(f"final state, p-value of normality: {normal}", highlight=False)


def _shown(e: dict[str, float | None], digits: int, gap: str = " ") -> str:
    if e["low"] is None or e["high"] is None:
        return f"{e['value']:.{digits}f}"
    return f"{e['value']:.{digits}f}{gap}({e['low']:.{digits}f} to {e['high']:.{digits}f})"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="python -m scp_recon.montecarlo", description=__doc__)
    p.add_argument("solution", type=Path, metavar="DIR", help="folder with a solution.json")
    p.add_argument(
        "--samples",
        type=int_between(20, 10**9, "20 to 1e9"),
        default=10_000,
        metavar="N",
        help="flights, at most with --until (default: 10000)",
    )
    p.add_argument(
        "--until",
        type=_width,
        metavar="P%",
        help="stop when every joint probability's interval is this narrow, e.g. 0.5%%",
    )
    p.add_argument(
        "--truth",
        choices=("planner", "harmonics"),
        default="planner",
        help="point mass with J2, or the degree-8 field turning with the body (default: planner)",
    )
    p.add_argument(
        "--errors",
        choices=("componentwise", "gates"),
        default="componentwise",
        help="of the burns: the paper's, or magnitude and pointing (default: componentwise)",
    )
    p.add_argument(
        "--seed",
        type=SEED,
        default=0,
        metavar="S",
        help="default: 0",
    )
    p.add_argument(
        "--workers",
        type=int_between(1, 256),
        default=1,
        metavar="N",
        help="processes (default: 1)",
    )
    return p


def _width(text: str) -> float:
    try:
        width = float(text.removesuffix("%")) / 100.0
    except ValueError:
        width = 0.0
    if not text.endswith("%") or not 0.0 < width < 1.0:
        raise argparse.ArgumentTypeError(f"got {text!r}; must be a percentage such as 0.5%")
    return width


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parser().parse_args(arguments)
    return run_command(lambda console: _fly(options, console))


def _fly(options: argparse.Namespace, console: Console) -> int:
    solution = read_solution(options.solution)
    folder = options.solution if options.solution.is_dir() else options.solution.parent
    check_writable(folder, FILE_NAME, "folder")
    mission = Mission.from_scenario(solution.scenario)
    setting = CampaignConfig(
        mission, solution.burns_m_s, options.seed, options.truth, options.errors
    )
    columns = ("flights", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("flights", total=options.samples)
        campaign = fly_campaign(
            setting,
            samples=options.samples,
            until=options.until,
            workers=options.workers,
            progress=lambda done: bar.update(task, completed=done),
        )
    report = summarise(campaign, solution)
    try:
        path = write_atomically(folder / FILE_NAME, json.dumps(report, allow_nan=False) + "\n")
    except OSError as error:
        raise unwritable(folder, "folder", error) from None
    show(console, report)
    show_written(console, path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
