"""Solve P3 and P2 as nonlinear programs by IPOPT: the reference for sequential convex programming.

Rows that are evaluated outside CasADi have their derivatives. IPOPT is given exact values and
slopes of such rows at the burns, and no curvature: where they bind, it converges as quasi-Newton
methods do.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import Enum
from time import perf_counter
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from formulations.arrays import Array
from formulations.nlp.program import Arcs, Assembled, NlpRows, Start, Transcription, assemble
from formulations.nlp.shooting import MultipleShooting, SingleShooting
from formulations.problem.facets import Facets
from formulations.problem.flyby import FlybyProblem, Iterate


class Outer(NamedTuple):
    """Names of k rows, and the function from burns (m, 3) to values (k,) and derivatives (k, 3 m)."""

    names: tuple[str, ...]
    rows: Callable[[Array], tuple[Array, Array]]


class OuterRows(ca.Callback):
    """Values (k,) of rows at burns (3, m), as CasADi calls them.

    CasADi holds no reference: whoever builds a solver with these rows keeps them as long as it.
    """

    def __init__(self, outer: Outer, burns: int) -> None:
        ca.Callback.__init__(self)
        self._rows, self._shape, self.count = outer.rows, (3, burns), len(outer.names)
        self._slopes = _Slopes(self, 3 * burns, self.count)
        self._last: tuple[bytes, tuple[Array, Array]] | None = None
        self.construct("outer", {})

    def get_sparsity_in(self, _: int) -> ca.Sparsity:
        """Sparsity of the burns."""
        return ca.Sparsity.dense(*self._shape)

    def get_sparsity_out(self, _: int) -> ca.Sparsity:
        """Sparsity of the values."""
        return ca.Sparsity.dense(self.count, 1)

    def at(self, burns: ca.DM) -> tuple[Array, Array]:
        """Values and derivatives; those of the last burns are kept."""
        given = np.array(burns)
        if self._last is None or self._last[0] != given.tobytes():
            self._last = given.tobytes(), self._rows(given.T)
        return self._last[1]

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        """The values."""
        return [self.at(arguments[0])[0]]

    def has_jacobian(self) -> bool:
        """Yes."""
        return True

    def get_jacobian(self, *_: Any) -> ca.Function:
        """The function that gives the derivatives."""
        return self._slopes


class _Slopes(ca.Callback):
    """Derivatives (k, 3 m) of outer rows, whose own derivatives count as none."""

    def __init__(self, rows: OuterRows, unknowns: int, count: int) -> None:
        ca.Callback.__init__(self)
        self._rows, self._size = rows, (count, unknowns)
        self.construct("slopes", {})

    def get_n_in(self) -> int:
        """Burns and values."""
        return 2

    def get_sparsity_in(self, number: int) -> ca.Sparsity:
        """Sparsity of the burns, and of the values."""
        count, unknowns = self._size
        return ca.Sparsity.dense(count, 1) if number else ca.Sparsity.dense(3, unknowns // 3)

    def get_sparsity_out(self, _: int) -> ca.Sparsity:
        """Sparsity of the derivatives."""
        return ca.Sparsity.dense(*self._size)

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        """The derivatives."""
        return [self._rows.at(arguments[0])[1]]

    def has_jacobian(self) -> bool:
        """Yes: none at all."""
        return True

    def get_jacobian(self, name: str, inames: Any, onames: Any, options: Any) -> ca.Function:
        """Structural zeros."""
        count, unknowns = self._size
        burns, values = ca.MX.sym("b", 3, unknowns // 3), ca.MX.sym("v", count)
        out = ca.MX.sym("o", ca.Sparsity(count, unknowns))
        zeros = [ca.MX(count * unknowns, size) for size in (unknowns, count)]
        return ca.Function(name, [burns, values, out], zeros, inames, onames, options)


@dataclass(frozen=True)
class Settings:
    """IPOPT's options that differ from its defaults.

    An inexact Hessian is a limited-memory BFGS approximation. With `near` the barrier begins at that
    value, and the start is kept as near to the bounds, so that IPOPT does not leave a start that is
    nearly a plan.

    `solver` names CasADi's plugin. Uno, a filter SQP method with dense quadratic programs and
    CasADi's derivatives, serves studies of programs of few unknowns; of these options it takes the
    number of iterations alone.
    """

    solver: Literal["ipopt", "uno"] = "ipopt"
    hessian: Literal["exact", "limited-memory"] = "exact"
    barrier: Literal["monotone", "adaptive"] = "monotone"
    max_iterations: int = 1000
    near: float | None = None

    def options(self) -> dict[str, Any]:
        """The options in CasADi's form; the solver prints nothing."""
        if self.solver == "uno":
            return UNO | {"uno.max_iterations": self.max_iterations}
        close = {f"ipopt.{name}": self.near for name in PUSHES} | {
            "ipopt.bound_mult_init_method": "mu-based"
        }
        return ({} if self.near is None else close) | {
            "ipopt.hessian_approximation": self.hessian,
            "ipopt.linear_solver": "mumps",
            "ipopt.mu_strategy": self.barrier,
            "ipopt.tol": 1e-8,  # of the scaled optimality conditions
            # Of the rows unscaled; by default 1e-4, a decimetre.
            "ipopt.constr_viol_tol": CONSTRAINT_TOLERANCE,
            "ipopt.acceptable_constr_viol_tol": CONSTRAINT_TOLERANCE,
            "ipopt.max_iter": self.max_iterations,
            "ipopt.max_wall_time": 600.0,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            **QUIET,
        }


CONSTRAINT_TOLERANCE = 1e-7
QUIET = {"print_time": False, "show_eval_warnings": False}
UNO = {
    "uno.logger": "SILENT",
    "uno.primal_tolerance": CONSTRAINT_TOLERANCE,
    "uno.time_limit": 600.0,
    **QUIET,
}
PUSHES = ("mu_init", "bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac")

EXACT = Settings(barrier="adaptive")
FROM_NEAR = Settings(near=1e-3, max_iterations=150)
QUASI_NEWTON = Settings(barrier="adaptive", hessian="limited-memory")


@dataclass(frozen=True)
class Variant:
    """A transcription and IPOPT's settings for it.

    P2 with a limited final covariance always uses single shooting and exact Hessians: quasi-Newton
    Hessians had not converged after a thousand iterations. So do firing times that are unknowns.

    Attributes:
        transcription: writes the program.
        p3: settings for P3, and for P2 without a facet. There a burn may vanish, and a quasi-Newton
            Hessian fails at the cost's kink.
        p2: settings for P2.
        screened: whether facets far from binding may be left out, to be checked afterwards.
    """

    transcription: Transcription
    p3: Settings
    p2: Settings
    screened: bool = True

    def of(self, problem: FlybyProblem, facets: Facets | None) -> tuple[Transcription, Settings]:
        """Transcription and settings for P3, which has no facets, or P2.

        Raises:
            ValueError: if burns of P2 are corrected.
        """
        if facets is not None and problem.feedback is not None:
            raise ValueError("IPOPT's programs have no gains")
        if facets is not None and problem.final_spread != (None, None):
            return SingleShooting(), FROM_NEAR
        if problem.firing is not None:
            return SingleShooting(), EXACT
        uncertain = facets is not None and len(facets.node) > 0
        return self.transcription, self.p2 if uncertain else self.p3


VARIANTS: dict[str, Variant] = {
    "printed": Variant(
        MultipleShooting(printed=True),
        p3=Settings(),
        p2=Settings(),
        screened=False,
    ),
    "tuned": Variant(MultipleShooting(printed=False), p3=EXACT, p2=EXACT),
    "shooting": Variant(SingleShooting(), p3=EXACT, p2=QUASI_NEWTON),
}
"""Variants: the problems as the paper prints them, as an expert would pose them, with few unknowns."""


class NlpOutcome(Enum):
    """Outcome of a run of IPOPT."""

    SOLVED = "solved"
    ACCEPTABLE = "solved to the acceptable tolerance"
    INFEASIBLE = "a stationary point of the violation"
    LIMIT = "a limit came first"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


OUTCOMES = {
    "Solve_Succeeded": NlpOutcome.SOLVED,
    "Converged with feasible KKT point": NlpOutcome.SOLVED,  # Uno's words
    "Converged with infeasible stationary point": NlpOutcome.INFEASIBLE,
    "Solved_To_Acceptable_Level": NlpOutcome.ACCEPTABLE,
    "Infeasible_Problem_Detected": NlpOutcome.INFEASIBLE,
    "Maximum_Iterations_Exceeded": NlpOutcome.LIMIT,
    "Maximum_CpuTime_Exceeded": NlpOutcome.LIMIT,
    "Maximum_WallTime_Exceeded": NlpOutcome.LIMIT,
    "User_Requested_Stop": NlpOutcome.INTERRUPTED,
}


@dataclass(frozen=True)
class NlpIteration:
    """One line of IPOPT's log: objective, largest scaled violation, largest step of an unknown."""

    objective: float
    violation: float
    step: float


@dataclass(frozen=True)
class NlpResult:
    """IPOPT's outcome, last iterate, iterations and times.

    Single shooting's iterate has a defect at the end only. The objective is total delta-v, plus the
    penalty if there is one; the iterations begin with the start. `build_s` is the time to write and
    differentiate the program; the evaluations' time, `evaluate_s`, is part of `solve_s`.
    """

    iterate: Iterate
    outcome: NlpOutcome
    status: str
    objective: float
    iterations: tuple[NlpIteration, ...]
    build_s: float
    solve_s: float
    evaluate_s: float


def solve_nlp(
    problem: FlybyProblem,
    arcs: Arcs,
    facets: Facets | None,
    start: Start,
    variant: Variant,
    penalty: float | None = None,
    outer: Outer | None = None,
) -> NlpResult:
    """Solve P2 on fixed facets, or P3 without.

    `penalty` is the weight of an exact L1 penalty on violations, as in `MeritFunction`; only the arcs
    stay hard. Without it all constraints are hard. `outer` are further margins.

    Raises:
        ValueError: if P2 has no factor to start from, or corrected burns.
    """
    begin = perf_counter()
    elastic = penalty is not None
    transcription, settings = variant.of(problem, facets)
    program = transcription(problem, arcs, facets, start, elastic)
    if outer is not None:
        called = OuterRows(outer, problem.n_burns)
        values = ca.vertsplit(called(program.burns))
        added = (NlpRows(name, value) for name, value in zip(outer.names, values, strict=True))
        program = replace(program, blocks=(*program.blocks, *added))
    nlp = assemble(program, penalty)
    solver = ipopt_solver(nlp, settings)
    build_s = perf_counter() - begin
    begin = perf_counter()
    with noticing_interrupts() as interrupted:
        answer = solver(x0=nlp.start, lbx=nlp.lower, lbg=0.0, ubg=nlp.rows_upper)
        seen = interrupted()
    solve_s = perf_counter() - begin
    stats = solver.stats()
    point = np.array(answer["x"]).ravel()[: program.unknowns.numel()]
    log = stats.get("iterations", {})
    lines = [*zip(*(log.get(key, ()) for key in ("obj", "inf_pr", "d_norm")), strict=True)]
    lines = lines or (stats.get("iter_count", 0) + 1) * [3 * (np.nan,)]  # Uno keeps no log
    return NlpResult(
        iterate=program.iterate(point),
        outcome=_outcome(stats["return_status"], interrupted=seen),
        status=stats["return_status"],
        objective=float(answer["f"]),
        iterations=tuple(NlpIteration(*line) for line in lines),
        build_s=build_s,
        solve_s=solve_s,
        evaluate_s=sum(s for name, s in stats.items() if name.startswith("t_wall_nlp_")),
    )


def _outcome(status: str, *, interrupted: bool) -> NlpOutcome:
    """Outcome by IPOPT's status; IPOPT reports Ctrl-C, like any exception, by one status."""
    if status == "NonIpopt_Exception_Thrown" and interrupted:
        return NlpOutcome.INTERRUPTED
    return OUTCOMES.get(status, NlpOutcome.FAILED)


def ipopt_solver(nlp: Assembled, settings: Settings) -> ca.Function:
    """IPOPT with the program's own derivatives where it has them, else CasADi's."""
    options = settings.options()
    x, nothing = nlp.unknowns, ca.MX.sym("parameters", 0, 1)
    program = {"x": x, "p": nothing, "f": nlp.objective, "g": nlp.rows}
    if settings.solver == "uno":
        return ca.nlpsol("nlp", "uno", program, options)
    if np.isfinite(nlp.lower).any():
        # IPOPT relaxes bounds by 1e-8. A slack below zero is paid for, and there are hundreds.
        options["ipopt.bound_relax_factor"] = 0.0
    if nlp.jacobian is not None:
        outputs = [nlp.rows, nlp.jacobian]
        options["jac_g"] = ca.Function("nlp_jac_g", [x, nothing], outputs)
    if nlp.hessian is not None and settings.hessian == "exact":
        factor, factors = ca.MX.sym("factor"), ca.MX.sym("factors", nlp.rows.numel())
        hessian = nlp.hessian(factor, factors)
        options["hess_lag"] = ca.Function("nlp_hess_l", [x, nothing, factor, factors], [hessian])
    return ca.nlpsol("nlp", "ipopt", program, options)


@contextmanager
def noticing_interrupts() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether SIGINT has come since; Python still handles the signal.

    Python passes signals to the main thread: other threads notice none.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    os.set_blocking(writing, False)
    before = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)

    def came() -> bool:
        try:
            return signal.SIGINT in os.read(reading, 4096)
        except BlockingIOError:
            return False

    try:
        yield came
    finally:
        signal.set_wakeup_fd(before)
        os.close(reading)
        os.close(writing)
