"""Options of planning, with their ranges and the rules between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from formulations.registry import FULL
from scp_recon.display import digits
from scp_recon.errors import (
    InputError,
    make_whole,
    number_between,
    one_of,
    only_with,
    option,
    shortened,
)
from scp_recon.jobs.cores import WORKERS_MAX
from scp_recon.monte_carlo.estimates import flights_needed
from scp_recon.planning.method import (
    ALGORITHM,
    AUTO,
    FACET_ROUNDS_MAX,
    FORMULATION,
    PROBLEMS,
    SEED_MAX,
    SETTLE,
    SOLVER,
    STARTS_MAX,
    FacetRounds,
    NumberOfStarts,
    ScpMethod,
    scp_method,
)
from scp_recon.scenario.schema import Scenario

METHODS = ("scp", "ipopt")
OBJECTIVES = ("delta-v", "probability")
VARIANT = "tuned"
"""Variant of the nonlinear program, unless another is chosen."""
BUDGET_MIN_M_S, BUDGET_MAX_M_S = 1e-9, 1e6


@dataclass(frozen=True)
class PlanOptions:
    """The checked options of planning; None means the default.

    Attributes: those that `api.verbs.plan` describes.
    """

    problem: Literal["P3", "P2"] = "P2"
    method: Literal["scp", "ipopt"] = "scp"
    formulation: str | None = None
    algorithm: str | None = None
    solver: str | None = None
    facet_rounds: FacetRounds = SETTLE
    certify: bool | None = None
    objective: Literal["delta-v", "probability"] = "delta-v"
    dv_budget_m_s: float | None = None
    starts: NumberOfStarts | None = None
    seed: int | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        for name, known in (("problem", PROBLEMS), ("method", METHODS), ("objective", OBJECTIVES)):
            one_of(option(name), getattr(self, name), known)
        for name, low, high, *words in (
            ("facet_rounds", 0, FACET_ROUNDS_MAX, SETTLE),
            ("starts", 1, STARTS_MAX, AUTO, None),
            ("seed", 0, SEED_MAX, None),
            ("workers", 1, WORKERS_MAX, None),
        ):
            if getattr(self, name) not in words:
                make_whole(self, name, low, high, words[0] or "")
        if self.dv_budget_m_s is not None:
            bounds = BUDGET_MIN_M_S, BUDGET_MAX_M_S
            number_between(option("dv_budget_m_s"), self.dv_budget_m_s, *bounds)
        if self.certify is not None and not isinstance(self.certify, bool):
            allowed = "must be True, False or None"
            raise InputError(option("certify"), shortened(self.certify), allowed)
        several = {"seed": self.seed, "workers": self.workers}
        if self.method == "ipopt":
            others = {"algorithm": self.algorithm, "solver": self.solver, "starts": self.starts}
            only_with(f"{option('method', 'scp')} only", **others, **several)
            if self.formulation is not None:
                from formulations.nlp.solve import VARIANTS  # CasADi takes a second to import

                one_of(option("formulation"), self.formulation, VARIANTS)
            return
        self.scp  # noqa: B018 -- whether its names are known
        if self.starts in (None, 1):
            only_with(f"{option('starts')} of 2 or more", **several)
        elif self.objective == "probability":
            only_with(option("objective", "delta-v"), starts=self.starts)

    @property
    def scp(self) -> ScpMethod:
        """Formulation, algorithm and solver of sequential convex programming."""
        names = (self.formulation, self.algorithm, self.solver)
        usual = (FORMULATION, ALGORITHM, SOLVER)
        return scp_method(*(b if a is None else a for a, b in zip(names, usual, strict=True)))

    def is_certified(self, scenario: Scenario) -> bool:
        """Whether flights must certify the probability of a scenario's plan."""
        exact = scenario.risk.allocation == "exact" and self.problem == "P2"
        return exact and self.certify is not False

    def starts_for(self, scenario: Scenario) -> NumberOfStarts:
        """Number of starts: that of the options, or as many as pay for P2 without feedback.

        With feedback each optimum takes as long as a plan, so several starts are for the user to ask.
        """
        if self.starts is not None:
            return self.starts
        exact = scenario.risk.allocation == "exact"
        best = self.facet_rounds == SETTLE or exact  # what is asked for is the cheapest plan
        plain = self.method == "scp" and self.problem == "P2" and self.objective == "delta-v"
        return AUTO if best and plain and scenario.policy.kind == "open" else 1

    def check(self, scenario: Scenario) -> None:
        """Refuse options that do not suit a scenario's risk and burns."""
        budget, exact = self.dv_budget_m_s, scenario.risk.allocation == "exact"
        if self.objective != "probability":
            only_with(option("objective", "probability"), dv_budget_m_s=budget)
        most = len(scenario.burn_times_s) * scenario.burns.dv_max_m_s
        if budget is not None and budget > most:
            allowed = f"must be at most {most:g} m/s, all burns at burns.dv_max_m_s, or any"
            raise InputError(option("dv_budget_m_s"), f"{digits(budget, 12)} m/s", allowed)
        if not exact or self.problem != "P2":
            others = option("problem", "P2") if exact else "risk.allocation = exact only"
            if exact or self.certify:  # without exact risk "no" is what is done anyway
                only_with(others, certify=self.certify)
            if self.objective == "probability":
                only_with(others, objective=self.objective)
        if not exact:
            return
        for name, given, those in (
            ("method", self.method, ("scp",)),
            ("formulation", self.formulation or FORMULATION, FULL),
            ("facet_rounds", self.facet_rounds, (0, SETTLE)),
        ):
            if given not in those:
                allowed = f"must be {' or '.join(map(str, those))} with risk.allocation = exact"
                raise InputError(option(name), shortened(given), allowed)
        if self.is_certified(scenario) and self.objective == "delta-v":
            flights_needed(scenario.risk.p_chance)
