"""Summarise many flights, and compare them with the plan that was flown, in SI."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.special import chdtri

from formulations.arrays import Array
from scp_recon.monte_carlo.estimates import CONFIDENCE, Tally, proportion
from scp_recon.monte_carlo.flights import FlightTally
from scp_recon.monte_carlo.sampling import policy_kind
from scp_recon.monte_carlo.summary import (
    CLOSEST,
    COMPONENTS,
    MOST,
    ONE_SIGMA,
    TWO_SIGMA,
    ClosestApproach,
    Commanded,
    CorrectedBurn,
    Histogram,
    HoldingTime,
    Interval,
    LowestProbability,
    Normality,
    Statistics,
    Strata,
    Summary,
    Terminal,
)
from scp_recon.results.policy import Correction
from scp_recon.results.solution import Solution


def summarise(flown: FlightTally, solution: Solution) -> Summary:
    """Summarise the flights of a solution's plan.

    Raises:
        ValueError: if another plan was flown.
    """
    config = flown.config
    same_burns = np.array_equal(config.burns_m_s, solution.burns_m_s)
    gains = [one.gains for one in config.policy if isinstance(one, Correction)]
    own = [one.gains for one in solution.corrections]
    same_gains = len(gains) == len(own) and all(map(np.array_equal, gains, own))
    if not same_burns or (gains and not same_gains) or config.mission.scenario != solution.scenario:
        raise ValueError("the flights are of another plan than the solution's")
    further: dict[str, Any] = {"commanded": _commanded(flown)} if config.policy else {}
    if flown.narrowed:
        names = [name for name in flown.node_counts if flown.is_narrowed(name)]
        _, counted = next(iter(flown.narrowed.values()))
        draws, flights = sum(counted.drawn), sum(counted.flown)
        further["strata"] = Strata(draws=draws, flights=flights, names=names)
    closest, executed = (flown.tallies[name] for name in ("closest_m", "executed_dv_m_s"))
    return Summary(
        plan_hash=solution.plan_hash,
        samples=flown.samples,
        seed=config.seed,
        truth=config.truth,
        planned_gravity=config.mission.scene.gravity_in_words(),
        flown_gravity=config.mission.scene.gravity_in_words(config.truth),
        errors=config.errors or config.mission.scenario.uncertainty.errors,
        policy=policy_kind(config.policy),
        confidence=CONFIDENCE,
        planned_dv_m_s=solution.total_dv_m_s,
        window_s=config.mission.observed_s,
        held_s={name: _held(flown, name) for name in flown.full},
        entry_s=_statistics(flown.tallies["entry_s"]),
        exit_s=_statistics(flown.tallies["exit_s"]),
        probability={name: _lowest(flown, name) for name in flown.node_counts},
        whole_flight=Interval.of(proportion(flown.whole, flown.samples)),
        closest_m=ClosestApproach(
            **dict(_statistics(closest)), worst=Interval.of(closest.quantile(CLOSEST))
        ),
        executed_dv_m_s=_statistics(executed),
        terminal=_terminal(flown, solution),
        **further,
    )


def _lowest(flown: FlightTally, name: str) -> LowestProbability:
    at, estimate = flown.worst_probability(name)
    return LowestProbability.of(estimate, worst_t_s=at)


def _statistics(tally: Tally) -> Statistics:
    if not tally.samples:
        return Statistics(samples=0)
    found = {"mean": tally.mean(), "q05": tally.quantile(0.05), "q95": tally.quantile(0.95)}
    intervals = {name: Interval.of(one) for name, one in found.items()}
    return Statistics(samples=tally.samples, **intervals)


def _held(flown: FlightTally, name: str) -> HoldingTime:
    tally = flown.tallies[name]
    used = np.flatnonzero(tally.counts)
    return HoldingTime(
        mean=Interval.of(tally.mean()),
        worst_1_sigma=Interval.of(tally.quantile(ONE_SIGMA)),
        worst_2_sigma=Interval.of(tally.quantile(TWO_SIGMA)),
        throughout=Interval.of(proportion(flown.full[name], flown.samples)),
        histogram=Histogram(
            bin=float(tally.edges[1] - tally.edges[0]),
            start=tally.edges[used].tolist(),
            count=tally.counts[used].tolist(),
        ),
    )


def _commanded(flown: FlightTally) -> Commanded:
    first, total = 1 + flown.config.mission.scenario.burns_flown, flown.tallies["commanded_dv_m_s"]
    return Commanded(
        mean_dv_m_s=Interval.of(total.mean()),
        dv99_m_s=Interval.of(total.quantile(MOST)),
        burns=[
            CorrectedBurn(
                burn=first + one.burn,
                cut_off_s=one.cut_off_s,
                limits={
                    name: Interval.of(proportion(int(counts[j]), flown.samples))
                    for name, counts in flown.limits.items()
                },
                **({"failed": int(flown.failed[j])} if len(flown.failed) else {}),
            )
            for j, one in enumerate(flown.config.policy)
        ],
    )


def _terminal(flown: FlightTally, solution: Solution) -> Terminal:
    """Final state against the planner's prediction, and how normal it is.

    The ratio of a sampled to the true variance is chi-squared over its degrees of freedom if the
    state is normal, which gives the interval of the ratio of the sigmas. A component without spread
    is left out.
    """
    from scipy.stats import normaltest  # half a second to import, for reports only

    n, kept, covariance = flown.samples, flown.terminal, flown.terminal_covariance()
    predicted = np.diag(np.array(solution.nodes.covariance[-1]))
    spread = np.flatnonzero((predicted > 0.0) & (kept.std(axis=0) > 0.0))
    ratios = np.sqrt(np.diag(covariance)[spread] / predicted[spread])
    levels = (np.arange(1, 100) / 100.0).tolist()
    kept = kept[:, spread]
    standard = (kept - kept.mean(axis=0)) / kept.std(axis=0, ddof=1)
    names = [COMPONENTS[i] for i in spread]
    return Terminal(
        sigma_ratio={
            name: _sigma(ratio, n - 1) for name, ratio in zip(names, ratios.tolist(), strict=True)
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
        sigma_position_m=_size(covariance[:3, :3], n),
        sigma_velocity_m_s=_size(covariance[3:, 3:], n),
    )


def _size(covariance: Array, samples: int) -> Interval:
    """Root of a sampled covariance's trace, with its interval.

    The trace is approximately chi-squared over its degrees of freedom, whose number is that of
    Welch and Satterthwaite.
    """
    trace = float(np.trace(covariance))
    if trace <= 0.0:
        return Interval(value=0.0, low=0.0, high=0.0)
    rank = max(1.0, trace**2 / float(np.sum(covariance**2)))  # less only by rounding
    return _sigma(float(np.sqrt(trace)), (samples - 1) * rank)


def _sigma(value: float, freedom: float) -> Interval:
    """A sampled sigma, or its ratio, with the interval of so many degrees of freedom."""
    tails = (0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE)
    low, high = (value / float(np.sqrt(chdtri(freedom, p) / freedom)) for p in tails)
    return Interval(value=value, low=low, high=high)
