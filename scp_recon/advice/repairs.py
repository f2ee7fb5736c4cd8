"""Try what may mend a plan without a verdict, or one whose verification fails.

Which trials there are follows from the checks that fail.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from scp_recon.advice.trials import (
    FINAL_SPREAD,
    LARGEST,
    SIZE,
    SPLIT,
    Case,
    Changes,
    Remedy,
    rounded,
)
from scp_recon.api.planning import carry_out
from scp_recon.certification.flights import fly_plan, run_test
from scp_recon.monte_carlo.estimates import flights_of_test
from scp_recon.results.verification import Verification
from scp_recon.scp.status import Status
from scp_recon.verification.causes import (
    BETWEEN,
    BURNS,
    BY_LAW,
    CERTIFICATE,
    COMMANDS,
    CONTRADICTION,
    DRIFT,
    GRID,
    SHORT,
    SPREAD,
    STATUS,
    UNEXECUTED,
    kind_of,
    needed_step_s,
)

STEEPER = (0.9, 0.75, 0.5, 0.25)
"""Factors on a probability's complement, tried one after the other where flights reach too little."""

CONTINUED, CERTIFIED = "continuing from this solution", "certification by flights"
FINER, STRICTER = "a finer grid", "a higher probability"
EXECUTED, UNCORRECTED = "the least burn", "burns without corrections"
TARGET = "the target of the certificate"


def repairs(
    case: Case, verification: Verification | None
) -> Iterator[tuple[str, Callable[[], Remedy | None]]]:
    """Trials of a plan without a verdict, or of one whose verification fails, by its checks."""
    mission, scenario, options = case.failed.mission, case.scenario, case.request.options
    kinds = {STATUS}
    if verification is not None and STATUS not in verification.failed:
        kinds = {kind_of(name, mission, verification) for name in verification.failed}
    risk, burns = scenario.risk, scenario.burns
    if kinds & {STATUS, BURNS, CONTRADICTION} and case.request.remade is None:
        yield CONTINUED, partial(_continued, case)
    if kinds & {STATUS, GRID, BETWEEN}:
        apart = float(np.diff(mission.times_s).max())
        steps = [float(math.floor(apart / n)) for n in (2, 4)]
        if verification is not None and GRID in kinds:
            steps.insert(0, needed_step_s(mission, verification))
        finer: list[Changes] = [{"grid.step_max_s": step} for step in steps if step >= 1.0]
        yield FINER, partial(case.first, FINER, finer)
    uniform = options.problem == "P2" and risk.allocation == "uniform"
    if kinds & {STATUS, SHORT} and uniform:
        yield SPLIT, partial(case.confirmed, SPLIT, {"risk.allocation": "exact"})
    if kinds & {BY_LAW, DRIFT} and risk.allocation == "exact" and options.certify is False:
        yield CERTIFIED, partial(case.confirmed, CERTIFIED, {}, certified=True)
    if kinds & {SHORT, BY_LAW}:
        yield STRICTER, partial(case.first, STRICTER, _steeper("risk.p_chance", risk.p_chance))
    if SPREAD in kinds:
        yield FINAL_SPREAD, case.final_spread
    if COMMANDS in kinds:
        larger = [{LARGEST: rounded(f * burns.dv_max_m_s)} for f in (1.1, 1.25, 1.5, 2.0)]
        yield SIZE, partial(case.first, SIZE, larger)
        yield UNCORRECTED, partial(case.confirmed, UNCORRECTED, {"policy.kind": "open"})
    if UNEXECUTED in kinds:
        sizes = np.linalg.norm(case.failed.burns_m_s, axis=1)
        least = {"burns.dv_min_m_s": rounded(float(sizes[sizes > 0.0].min()), up=False)}
        yield EXECUTED, partial(case.confirmed, EXECUTED, least)
    entry = "safety.drift_probability"
    if DRIFT in kinds and (asked := scenario.safety.drift_probability) is not None:
        yield STRICTER, partial(case.first, STRICTER, _steeper(entry, asked))
    if kinds & {STATUS, CERTIFICATE} and case.failed.target is not None:
        yield TARGET, partial(_lower_promise, case)


def kept(case: Case) -> float | None:
    """Share of flights that keep every limit with a plan that has none certified, or whose test."""
    if case.failed.certificate is not None:
        return case.failed.certificate.reached
    if case.failed.target is None or case.failed.status is Status.CONVERGED:
        return None

    def reached() -> float:
        flights = flights_of_test(case.scenario.risk.p_chance)
        tested, _ = run_test(case.failed, partial(fly_plan, case.clock.flights), flights, 1, 1)
        assert tested.certificate is not None
        return tested.certificate.reached

    return case.clock.attempt("flights of this plan", reached)


def _continued(case: Case) -> Remedy | None:
    """The user's command, started from the plan that failed; a certification goes on by itself."""
    options = case.request.options
    if options.is_certified(case.scenario) and options.objective == "delta-v":
        return None
    outcome = carry_out(replace(case.request, init=case.failed), case.clock)
    ok = outcome.verification is not None and outcome.verification.ok
    return Remedy.of(CONTINUED, {}, outcome.plan) if ok else None


def _lower_promise(case: Case) -> Remedy | None:
    """The largest of some lower probabilities that flights certify."""
    required = case.scenario.risk.p_chance
    below = [1.0 - rounded((1.0 - required) * factor, digits=1) for factor in (1.1, 1.5, 2.0, 4.0)]
    tries = dict.fromkeys(round(p, 9) for p in below if 0.5 < p < required)
    return case.first(TARGET, [{"risk.p_chance": p} for p in tries])


def _steeper(entry: str, asked: float) -> list[Changes]:
    """Higher probabilities than asked, one after the other."""
    return [{entry: round(1.0 - rounded((1.0 - asked) * f), 9)} for f in STEEPER]
