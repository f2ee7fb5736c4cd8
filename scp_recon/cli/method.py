"""What makes the plan that a command's options ask for."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from formulations.problem.flyby import Iterate
from scp_recon.certification.certify import AimedPlanning, certify
from scp_recon.certification.largest import LEAST, Search, largest_promise
from scp_recon.cli.live import Progress
from scp_recon.errors import InputError, one_of
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.certifying import flights_needed
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.method import ALGORITHM, FORMULATION, SOLVER, check_exact, scp_method
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.planning.stages import Observer
from scp_recon.planning.starts import plan_from_several
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status

Planning = Callable[[Mission, Iterate, Progress], Plan]


def planning(options: argparse.Namespace) -> Planning:
    """What makes a plan.

    Raises:
        InputError: if an option is of another method, or names nothing that is known.
    """
    if options.method == "scp":
        _check_starts(options)
        return _by_scp(options)
    for option in ("algorithm", "solver", "facet_rounds", "starts", "seed", "workers"):
        given = getattr(options, option)
        if given is not None and (option, given) != ("facet_rounds", 0):  # which is its default
            raise InputError(
                f"--{option.replace('_', '-')}", str(given), "goes with --method scp only"
            )
    from formulations.nlp.solve import VARIANTS  # by CasADi, which takes a second to import
    from scp_recon.planning import ipopt

    variant = one_of("--formulation", options.formulation or "tuned", VARIANTS)

    def by_ipopt(mission: Mission, start: Iterate, observe: Observer) -> Plan:
        return ipopt.plan(
            mission,
            start,
            problem=options.problem,
            variant=variant,
            init=options.init,
            observe=observe,
        )

    return by_ipopt


def _by_scp(options: argparse.Namespace) -> Planning:
    method = scp_method(
        options.formulation or FORMULATION,
        options.algorithm or ALGORITHM,
        options.solver or SOLVER,
        prefix="--",
    )
    make_plan = partial(
        plan,
        problem=options.problem,
        formulation=method.formulation,
        algorithm=method.algorithm,
        solver=method.solver,
        facet_rounds=options.facet_rounds,
    )
    return ByScp(options, make_plan)


@dataclass(frozen=True)
class ByScp:
    """Planning by SCP as options ask for it: once, certified, from several starts, or for the most.

    Attributes:
        options: of the command line.
        make_plan: `planner.plan` with the method that they name.
    """

    options: argparse.Namespace
    make_plan: Callable[..., Plan]

    def __call__(self, mission: Mission, start: Iterate, observe: Progress) -> Plan:
        """The plan of a mission from a start."""
        if self.options.objective == "probability":
            return self._largest(mission, start, observe)
        if (self.options.starts or 1) > 1:
            return self._from_several(mission, start, observe)
        if not is_certified(self.options, mission.scenario):
            return self.make_plan(mission, start, init=self.options.init, observe=observe)
        return certify(mission, start, self._aiming(observe, self.options.init), observe.round)

    def _aiming(self, observe: Progress, init: str) -> AimedPlanning:
        """Plans that aim at a probability, as rounds of flights and searches ask for them."""

        def once(mission: Mission, start: Iterate, aim: float) -> Plan:
            return self.make_plan(mission, start, aim=aim, init=init, observe=observe)

        return once

    def _from_several(self, mission: Mission, start: Iterate, observe: Progress) -> Plan:
        """The best of several starts; where flights have to stand behind it, certified from there."""
        options = self.options
        best = plan_from_several(
            mission,
            start,
            self.make_plan,
            starts=options.starts,
            seed=options.seed or 0,
            workers=options.workers or 1,
            init=options.init,
            seen=lambda number, found: _show_start(observe, number, found),
        )
        if not is_certified(options, mission.scenario) or best.status is not Status.CONVERGED:
            return best
        start = from_burns(mission, best.burns_m_s)
        once = self._aiming(observe, best.provenance.init)
        return replace(certify(mission, start, once, observe.round), starts=best.starts)

    def _largest(self, mission: Mission, start: Iterate, observe: Progress) -> Plan:
        """The largest probability within the budget.

        Raises:
            InputError: if the budget has no plan for the least that is looked for.
        """
        options = self.options
        budget = float("inf") if options.dv_budget is None else options.dv_budget
        best = largest_promise(
            mission,
            start,
            Search(self._aiming(observe, options.init), budget),
            certified=is_certified(options, mission.scenario),
            watch=observe.round,
        )
        if best.status is Status.CONVERGED and best.total_dv_m_s > budget:
            raise InputError(
                "--dv-budget",
                f"{budget:g} m/s",
                f"must be at least {best.total_dv_m_s:.6f} m/s, which {LEAST} costs",
            )
        return best


def _show_start(observe: Observer, number: int, found: Plan) -> None:
    """The last iteration of each stage, as those of one start are shown one by one."""
    for stage in found.stages:
        for record in stage.result.records[-1:]:
            observe(f"{number} {stage.name}", record)


def _check_starts(options: argparse.Namespace) -> None:
    """Refuse what goes with several starts, or not with them.

    Raises:
        InputError: naming the option, what was given and what is allowed.
    """
    if (options.starts or 1) == 1:
        for option in ("seed", "workers"):
            if (given := getattr(options, option)) is not None:
                raise InputError(f"--{option}", str(given), "goes with --starts of 2 or more")
    elif options.objective == "probability":
        raise InputError("--starts", str(options.starts), "goes with --objective delta-v")


def is_certified(options: argparse.Namespace, scenario: Scenario) -> bool:
    """Whether flights have to stand behind the plan."""
    exact = scenario.risk.allocation == "exact" and options.problem == "P2"
    return exact and options.certify != "no"


def check_risk(options: argparse.Namespace, scenario: Scenario) -> None:
    """Refuse what an allocation of risk does not go with.

    Raises:
        InputError: naming the option, what was given and what is allowed.
    """
    if options.dv_budget is not None and options.objective != "probability":
        raise InputError(
            "--dv-budget", f"{options.dv_budget:g}", "goes with --objective probability"
        )
    most = len(scenario.burn_times_s) * scenario.burns.dv_max_m_s
    if options.dv_budget is not None and options.dv_budget > most:
        raise InputError(
            "--dv-budget",
            f"{options.dv_budget:g} m/s",
            f"must be at most {most:g} m/s, all burns at burns.dv_max_m_s, or any",
        )
    if scenario.risk.allocation != "exact":
        for option, given in (("certify", options.certify), ("objective", options.objective)):
            if given not in (None, "delta-v"):
                raise InputError(f"--{option}", given, "goes with risk.allocation = exact only")
        return
    if options.problem != "P2":
        for option, given in (("certify", options.certify), ("objective", options.objective)):
            if given not in (None, "delta-v"):
                raise InputError(f"--{option}", given, "goes with --problem P2")
    check_exact(options.method, options.formulation or FORMULATION, options.facet_rounds, "--")
    if is_certified(options, scenario) and options.objective == "delta-v":
        flights_needed(scenario.risk.p_chance)
