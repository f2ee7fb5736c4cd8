"""Options of planning, with their ranges and the rules between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from formulations.registry import FULL
from scp_recon.display import digits
from scp_recon.errors import InputError, make_whole, number_between, one_of, option, shortened
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
"""Of the nonlinear program, unless another is chosen."""
BUDGET_MIN_M_S, BUDGET_MAX_M_S = 1e-9, 1e6

_OF_SCP = ("algorithm", "solver", "starts", "seed", "workers")
_OF_STARTS = ("seed", "workers")


@dataclass(frozen=True)
class PlanOptions:
    """The checked options of planning; None means the default.

    Attributes: those that `api.verbs.plan` describes.

    Raises:
        InputError: if an option is out of range, or in conflict with another.
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
        one_of(option("problem"), self.problem, PROBLEMS)
        one_of(option("method"), self.method, METHODS)
        one_of(option("objective"), self.objective, OBJECTIVES)
        if self.facet_rounds != SETTLE:
            make_whole(self, "facet_rounds", 0, FACET_ROUNDS_MAX, SETTLE)
        for name, low, high, word in (
            ("starts", 1, STARTS_MAX, AUTO),
            ("seed", 0, SEED_MAX, ""),
            ("workers", 1, WORKERS_MAX, ""),
        ):
            if (given := getattr(self, name)) is not None and (not word or given != word):
                make_whole(self, name, low, high, word)
        if self.dv_budget_m_s is not None:
            number_between(
                option("dv_budget_m_s"), self.dv_budget_m_s, BUDGET_MIN_M_S, BUDGET_MAX_M_S
            )
        if self.certify is not None and not isinstance(self.certify, bool):
            raise InputError(
                option("certify"), shortened(self.certify), "must be True, False or None"
            )
        if self.method == "ipopt":
            self._check_ipopt()
        else:
            self.scp  # noqa: B018 -- whether its names are known
            self._check_starts()

    @property
    def scp(self) -> ScpMethod:
        """Formulation, algorithm and solver of sequential convex programming.

        Raises:
            InputError: if a name is unknown.
        """
        names = (self.formulation, self.algorithm, self.solver)
        usual = (FORMULATION, ALGORITHM, SOLVER)
        return scp_method(*(b if a is None else a for a, b in zip(names, usual, strict=True)))

    @property
    def variant(self) -> str:
        """Variant of the nonlinear program."""
        return self.formulation or VARIANT

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
        """Refuse options that do not suit a scenario's risk and burns.

        Raises:
            InputError: naming the option, what was given and what is allowed.
        """
        budget = self.dv_budget_m_s
        most = len(scenario.burn_times_s) * scenario.burns.dv_max_m_s
        if budget is not None and self.objective != "probability":
            allowed = f"goes with {option('objective', 'probability')}"
            raise InputError(option("dv_budget_m_s"), digits(budget, 12), allowed)
        if budget is not None and budget > most:
            allowed = f"must be at most {most:g} m/s, all burns at burns.dv_max_m_s, or any"
            raise InputError(option("dv_budget_m_s"), f"{digits(budget, 12)} m/s", allowed)
        exact = scenario.risk.allocation == "exact"
        if not exact or self.problem != "P2":
            others = option("problem", "P2") if exact else "risk.allocation = exact only"
            if self.certify or (exact and self.certify is not None):  # "no" is what is done anyway
                raise InputError(option("certify"), str(self.certify), f"goes with {others}")
            if self.objective == "probability":
                raise InputError(option("objective"), self.objective, f"goes with {others}")
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

    def _check_ipopt(self) -> None:
        """Refuse options of sequential convex programming, and an unknown variant."""
        usual = PlanOptions()
        for name in _OF_SCP:
            if (given := getattr(self, name)) != getattr(usual, name):
                allowed = f"goes with {option('method', 'scp')} only"
                raise InputError(option(name), str(given), allowed)
        if self.formulation is not None:
            from formulations.nlp.solve import VARIANTS  # CasADi takes a second to import

            one_of(option("formulation"), self.formulation, VARIANTS)

    def _check_starts(self) -> None:
        """Refuse options that need several starts, or do not allow them."""
        if self.starts in (None, 1):
            for name in _OF_STARTS:
                if (given := getattr(self, name)) is not None:
                    allowed = f"goes with {option('starts')} of 2 or more"
                    raise InputError(option(name), str(given), allowed)
        elif self.objective == "probability":
            allowed = f"goes with {option('objective', 'delta-v')}"
            raise InputError(option("starts"), str(self.starts), allowed)
