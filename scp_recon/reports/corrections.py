"""Draw the effect of corrections: spread with and without them, knowledge, and delta-v."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from formulations.arrays import Array
from formulations.linearisation.linearisation import Linearisation
from scp_recon.planning.initial_guess import nondimensional
from scp_recon.reports.marks import DASHES, LOGARITHMIC, PLANS, Panels, faint, labelled
from scp_recon.reports.shown import SHARE, Shown
from scp_recon.reports.subject import Subject
from scp_recon.results.figures import is_strange
from scp_recon.results.policy import with_policy

ELLIPSE = 2.0
"""Sigmas of the ellipses that are drawn."""
POINTS, BINS = 97, 60
"""Points of an ellipse, and bins of a histogram."""


def covariances_of(subject: Subject) -> list[Array]:
    """Covariances of the deviations at the nodes with the corrections of so many burns, none to all.

    From a plan's file; J2000, m and m/s, shape (n, 6, 6) each.
    """
    mission, solution = subject.mission, subject.solution
    path = nondimensional(mission, solution.burns_m_s, np.array(solution.nodes.state))
    lin = mission.dynamics.linearise(mission.problem, path)
    lin = with_policy(mission, lin, solution.corrections)
    corrected = [one.burn for one in solution.corrections]
    covariances = []
    for count in range(len(corrected) + 1):
        later = np.array(corrected[count:], dtype=np.intp)
        gains = mission.problem.without_corrections(lin.iterate.gains, later)
        some = Linearisation(mission.problem, replace(lin.iterate, gains=gains), lin.arcs)
        factor = some.factor * mission.units.state[:, None]
        covariances.append(factor @ factor.swapaxes(1, 2))
    return covariances


def correction_charts(plans: Sequence[Shown]) -> Iterator[dict[str, Any]]:
    """Charts of the plans with corrections; none if no plan has any."""
    plans = [plan for plan in plans if _is_corrected(plan.subject)]
    if plans:
        spreads = [covariances_of(plan.subject) for plan in plans]
        yield knowledge_chart(plans, spreads)
        yield ellipses_chart(plans, spreads)
        yield commanded_chart(plans)


def _is_corrected(subject: Subject) -> bool:
    """Whether a plan has corrections, and those that its scenario has."""
    policy, known = subject.solution.policy, subject.solution.nodes.knowledge
    return None not in (policy, known) and not is_strange(subject.mission, policy)


def knowledge_chart(plans: Sequence[Shown], spreads: Sequence[list[Array]]) -> dict[str, Any]:
    """Dispersion with and without corrections, and knowledge, over time."""
    panels = Panels(["position, 1 sigma (m)", "velocity, 1 sigma (mm/s)"])
    panels.window(plans[0].subject.mission.schedule.window_s)
    for number, (plan, spread) in enumerate(zip(plans, spreads, strict=True)):
        curves = {
            "dispersion": spread[-1],
            "dispersion without corrections": spread[0],
            "knowledge: error of the estimate": np.array(plan.subject.solution.nodes.knowledge),
        }
        for i, (name, covariance) in enumerate(curves.items()):
            said = labelled(plan.subject.name, name, len(plans) == 1)
            colour = i if len(plans) == 1 else number
            variance = np.diagonal(covariance, axis1=1, axis2=2)
            for panel, (part, scale) in enumerate(((slice(3), 1.0), (slice(3, 6), 1000.0))):
                sigma = scale * np.sqrt(variance[:, part].sum(axis=1))
                style = {"dash": DASHES[i]}
                panels.curve(
                    plan.subject.nodes_s, sigma, said, colour, panel, legend=panel == 0, line=style
                )
    for panel in range(2):
        panels.y_axis(panel, **LOGARITHMIC)
    return panels.chart("knowledge", "Dispersion and knowledge over time")


def ellipses_chart(plans: Sequence[Shown], spreads: Sequence[list[Array]]) -> dict[str, Any]:
    """Ellipses of the position that each correction is for, before it and after it.

    They are at the middle of the rest of the window after the burn, or at its end.
    """
    drawn = []
    for plan, spread in zip(plans, spreads, strict=True):
        name = "" if len(plans) == 1 else f"{plan.subject.name}, "
        for j, one in enumerate(plan.subject.solution.corrections):
            node = _node_served(plan.subject, one.burn)
            pair = [covariance[node, :3, :3] for covariance in spread[j : j + 2]]
            burn = plan.budget.first + one.burn
            title = (
                f"{name}burn {burn}, seen at {plan.subject.nodes_s[node]:.0f} s: second axis (m)"
            )
            drawn.append((title, pair))
    panels = Panels([title for title, _ in drawn], "longest axis before the correction (m)", 240)
    panels.layout["hovermode"] = "closest"
    for panel, (_, pair) in enumerate(drawn):
        axes = np.linalg.eigh(pair[0])[1][:, [2, 1]]
        for number, (name, covariance) in enumerate(zip(("before", "after"), pair, strict=True)):
            values, vectors = np.linalg.eigh(axes.T @ covariance @ axes)
            angle = np.linspace(0.0, 2.0 * np.pi, POINTS)
            circle = np.stack([np.cos(angle), np.sin(angle)])
            x, y = ELLIPSE * vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
            panels.curve(x, y, name, number, panel, legend=panel == 0)
        panels.y_axis(panel, scaleanchor="x", scaleratio=1)
    return panels.chart("ellipses", "Position before and after each correction")


def _node_served(subject: Subject, burn: int) -> int:
    """Node at the middle of the rest of the window after a burn; the last node after the window."""
    first, last = subject.window_s
    time = subject.solution.burns[burn].t_s
    if time >= last:
        return len(subject.nodes_s) - 1
    return int(np.abs(subject.nodes_s - 0.5 * (max(first, time) + last)).argmin())


def commanded_chart(plans: Sequence[Shown]) -> dict[str, Any]:
    """Distribution of the flights' commanded delta-v, with the plan's own, the mean and 99 %."""
    panels = Panels(["share of the flights (%)"], "commanded delta-v of a flight (mm/s)", 240)
    panels.layout["hovermode"] = "closest"
    for number, plan in enumerate(plans):
        totals = 1000.0 * plan.flown.commanded_m_s
        counts, edges = np.histogram(totals, BINS)
        share = 100.0 * counts / len(totals)
        name = "flights" if len(plans) == 1 else plan.subject.name
        steps = np.repeat(edges, 2)[1:-1], np.repeat(share, 2)
        style = {"dash": "solid"}
        panels.curve(*steps, name, number, line=style, fill="tozeroy")
        panels.data[-1]["fillcolor"] = faint(PLANS[number], 0.3)
        figures = {
            "nominal": 1000.0 * plan.subject.solution.total_dv_m_s,
            "mean": float(totals.mean()),
            f"{100.0 * SHARE:g} %": float(np.quantile(totals, SHARE)),
        }
        for i, (what, value) in enumerate(figures.items(), start=1):
            said = labelled(plan.subject.name, f"{what} {value:.2f} mm/s", len(plans) == 1)
            style = {"dash": DASHES[i]}
            panels.curve([value, value], [0.0, float(share.max())], said, number, line=style)
    return panels.chart("commanded", "Delta-v with corrections")
