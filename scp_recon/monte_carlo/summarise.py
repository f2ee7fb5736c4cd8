"""How tallied flights of a solution become their summary."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import chi2, normaltest

from scp_recon.monte_carlo.estimates import CONFIDENCE, Estimate, Tally, proportion
from scp_recon.monte_carlo.flights import FlightTally
from scp_recon.monte_carlo.summary import (
    COMPONENTS,
    ClosestApproach,
    Held,
    Histogram,
    Interval,
    LowestProbability,
    Normality,
    Spread,
    Summary,
    Terminal,
)
from scp_recon.solution.file import Solution

ONE_SIGMA, TWO_SIGMA, CLOSEST = 0.15866, 0.02275, 0.003
"""Lower normal tails at one and two sigma; the paper's quantile of the closest approach."""


def summarise(flown: FlightTally, solution: Solution) -> Summary:
    """Everything the flights of a solution's plan found.

    Raises:
        ValueError: if another plan was flown.
    """
    config = flown.config
    same_burns = np.array_equal(config.burns_m_s, solution.burns_m_s)
    if not same_burns or config.mission.scenario != solution.scenario:
        raise ValueError("the flights are of another plan than the solution's")
    return Summary(
        plan_hash=solution.plan_hash,
        samples=flown.samples,
        seed=config.seed,
        truth=config.truth,
        errors=config.errors or config.mission.scenario.uncertainty.errors,
        confidence=CONFIDENCE,
        planned_dv_m_s=solution.total_dv_m_s,
        window_s=config.mission.observed_s,
        held_s={name: _held(flown, name) for name in flown.held},
        entry_s=Spread(**_spread(flown.entry)),
        exit_s=Spread(**_spread(flown.exit)),
        probability={name: _lowest(flown, name) for name in flown.node_counts},
        whole_flight=_interval(proportion(flown.whole, flown.samples)),
        closest_m=ClosestApproach(
            **_spread(flown.closest), worst=_interval(flown.closest.quantile(CLOSEST))
        ),
        executed_dv_m_s=Spread(**_spread(flown.executed_dv)),
        terminal=_terminal(flown, solution),
    )


def _finite(estimate: Estimate) -> dict[str, float | None]:
    return {k: v if np.isfinite(v) else None for k, v in estimate._asdict().items()}


def _interval(estimate: Estimate) -> Interval:
    return Interval(**_finite(estimate))


def _lowest(flown: FlightTally, name: str) -> LowestProbability:
    at, estimate = flown.worst_probability(name)
    return LowestProbability(**_finite(estimate), worst_t_s=at)


def _held(flown: FlightTally, name: str) -> Held:
    tally = flown.held[name]
    used = np.flatnonzero(tally.counts)
    return Held(
        mean=_interval(tally.mean()),
        worst_1_sigma=_interval(tally.quantile(ONE_SIGMA)),
        worst_2_sigma=_interval(tally.quantile(TWO_SIGMA)),
        throughout=_interval(proportion(flown.full[name], flown.samples)),
        histogram=Histogram(
            bin=float(tally.edges[1] - tally.edges[0]),
            start=tally.edges[used].tolist(),
            count=tally.counts[used].tolist(),
        ),
    )


def _spread(tally: Tally) -> dict[str, Any]:
    if not tally.samples:
        return {"samples": 0}
    return {
        "samples": tally.samples,
        "mean": _interval(tally.mean()),
        "q05": _interval(tally.quantile(0.05)),
        "q95": _interval(tally.quantile(0.95)),
    }


def _terminal(flown: FlightTally, solution: Solution) -> Terminal:
    """Final state against the planner's prediction, and how normal it is.

    The ratio of a sampled to the true variance is chi-squared over its degrees of freedom if the
    state is normal, which gives the interval of the ratio of the sigmas. A component without spread
    is left out.
    """
    n, kept = flown.samples, flown.terminal
    predicted = np.diag(np.array(solution.nodes.covariance[-1]))
    spread = np.flatnonzero((predicted > 0.0) & (kept.std(axis=0) > 0.0))
    ratios = np.sqrt(np.diag(flown.terminal_covariance())[spread] / predicted[spread])
    ends = (0.5 + 0.5 * CONFIDENCE, 0.5 - 0.5 * CONFIDENCE)
    low, high = (float(np.sqrt(chi2.ppf(p, n - 1) / (n - 1))) for p in ends)
    levels = (np.arange(1, 100) / 100.0).tolist()
    kept = kept[:, spread]
    standard = (kept - kept.mean(axis=0)) / kept.std(axis=0, ddof=1)
    names = [COMPONENTS[i] for i in spread]
    return Terminal(
        sigma_ratio={
            name: Interval(value=ratio, low=ratio / low, high=ratio / high)
            for name, ratio in zip(names, ratios.tolist(), strict=True)
        },
        normality={
            name: Normality(
                samples=len(kept),
                p_value=float(normaltest(kept[:, i]).pvalue),
                levels=levels,
                quantiles=np.quantile(standard[:, i], levels).tolist(),
            )
            for i, name in enumerate(names)
        },
    )
