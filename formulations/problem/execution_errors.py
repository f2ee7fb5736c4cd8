"""Execution errors: columns C(v) with C C' the covariance that a burn v adds to the velocity.

A model has `shared` columns for errors that are drawn once for all burns, then `own` columns for
errors that are drawn for each burn. Shared columns fill the same columns of the covariance factor
at every burn.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from formulations.arrays import Array
from formulations.problem.regions import check_size

VANISHED = 1e-3
"""Share of the larger fixed error: a smaller burn counts as not executed."""

TINY = 1e-300
"""Stands for zero in a quotient."""


class ExecutionErrors(ABC):
    """Model of the burns' errors, in the burns' units; its sizes are of one sigma."""

    def __post_init__(self) -> None:
        """Refuse sizes that are negative or not finite."""
        for name, size in vars(self).items():
            if name != "executed":  # numbers of burns
                check_size(name, size)

    @property
    @abstractmethod
    def own(self) -> int:
        """Number of columns of one burn alone."""

    @property
    def shared(self) -> int:
        """Number of columns common to all burns."""
        return 0

    @property
    def affine(self) -> bool:
        """Whether the columns are linear in the burn, so that their linearisation is exact."""
        return True

    def in_units(self, speed: float) -> ExecutionErrors:
        """The model of burns that are measured in units of a speed."""
        del speed
        return self

    @abstractmethod
    def columns(self, burns: Array) -> Array:
        """Columns C of burns (m, 3), the shared columns first, shape (m, 3, shared + own)."""

    @abstractmethod
    def jacobian(self, burns: Array) -> Array:
        """Derivative of `columns` by the burn, shape (m, 3, shared + own, 3)."""

    @abstractmethod
    def of_correction(self, n: int) -> int:
        """Number of columns of a correction by gains on n standard normal numbers."""

    @abstractmethod
    def correction_columns(self, gains: Array) -> tuple[Array, Array]:
        """Columns (3, k) of a correction by gains U (3, n), and their derivatives (3, k, 3, n).

        They match the second moment of the proportional errors of a random velocity U xi. These
        errors are products of normal numbers, hence not normal, and uncorrelated with the errors of
        the planned burn.
        """

    def execute(self, burns: Array, draws: Array) -> Array:
        """Burns as executed, for standard normal draws (n, shared + m own), shape (n, m, 3).

        The burns, shape (m, 3), are those of all draws; or each draw has its own, shape (n, m, 3).
        """
        columns = self.columns(burns.reshape(-1, 3)).reshape(*burns.shape, -1)
        own = draws[:, self.shared :].reshape(len(draws), -1, self.own)
        errors = np.einsum("...ik,...k->...i", columns[..., self.shared :], own)
        errors += np.einsum(
            "...ik,...k->...i", columns[..., : self.shared], draws[:, None, : self.shared]
        )
        return burns + errors

    def draws_of_burn(self, draws: Array, burn: int) -> Array:
        """Draws that act on one burn, shape (n, shared + own), out of all (n, shared + m own)."""
        first = self.shared + burn * self.own
        return np.hstack([draws[:, : self.shared], draws[:, first : first + self.own]])

    def draws(self, burns: int) -> int:
        """Number of standard normal draws for a number of burns."""
        return self.shared + burns * self.own

    def alternatives(self, burns: Array) -> Iterator[ExecutionErrors]:
        """Models to linearise besides this one at these burns; see `GatesErrors`."""
        del burns
        yield from ()


@dataclass(frozen=True)
class ComponentwiseErrors(ExecutionErrors):
    """Every component errs by a fraction beta of itself, 1 sigma: C = beta diag(v).

    Examples:
        >>> ComponentwiseErrors(0.25).columns(np.array([[4.0, 0.0, 0.0]]))[0, 0, 0].item()
        1.0

    Echigo et al., eq. 3.
    """

    fraction: float

    @property
    def own(self) -> int:
        """Three: one of each component."""
        return 3

    def columns(self, burns: Array) -> Array:
        """See `ExecutionErrors.columns`."""
        return self.fraction * burns[:, :, None] * np.eye(3)

    def jacobian(self, burns: Array) -> Array:
        """See `ExecutionErrors.jacobian`."""
        each = np.zeros((3, 3, 3))
        each[range(3), range(3), range(3)] = self.fraction
        return np.broadcast_to(each, (len(burns), 3, 3, 3))

    def of_correction(self, n: int) -> int:
        """Three: one of each component."""
        del n
        return 3

    def correction_columns(self, gains: Array) -> tuple[Array, Array]:
        """See `ExecutionErrors.correction_columns`: beta |row| of each component."""
        sizes = np.linalg.norm(gains, axis=1)
        slopes = gains / np.maximum(sizes, TINY)[:, None]
        jacobian = np.zeros((3, 3, *gains.shape))
        jacobian[range(3), range(3), range(3)] = self.fraction * slopes
        return self.fraction * np.diag(sizes), jacobian

    def execute(self, burns: Array, draws: Array) -> Array:
        """See `ExecutionErrors.execute`."""
        return burns * (1.0 + self.fraction * draws.reshape(-1, *burns.shape[-2:]))


@dataclass(frozen=True)
class GatesErrors(ExecutionErrors):
    """Errors of a burn's magnitude and pointing, each with a fixed and a proportional part; 1 sigma.

    Examples:
        >>> errors = GatesErrors(0.0, 0.5, 0.0, 0.25)
        >>> columns = errors.columns(np.array([[4.0, 0.0, 0.0]]))[0]
        >>> np.diag(columns @ columns.T).tolist()
        [4.0, 1.0, 1.0]

        C C' = (s_f^2 + s_p^2 v^2) u u' + (p_f^2 + p_p^2 v^2) (I - u u'),   u = v / |v|

    C. R. Gates, "A simplified model of midcourse maneuver execution errors", JPL TR 32-504, 1963. The
    proportional parts have columns that are linear in the burn: s_p v, and p_p [v]x, whose product is
    p_p^2 (v^2 I - v v'). A bias of the magnitude that all burns share is one more, b v.

    The fixed part has the symmetric root s_f u u' + p_f (I - u u'). Let m be the larger of s_f and
    p_f. A burn smaller than m has hardly a direction and gets the bound m I: between VANISHED m and m
    the root changes from the bound to its own form. A burn below VANISHED m is not executed, and its
    fixed part goes to zero with it. The covariance of an executed burn is at least Gates', and equals
    it from m on.

    Both transitions have two continuous derivatives, so that the merit is smooth in a burn that does
    not vanish. At a vanished burn the root would have a kink; the columns (m e / |v|) [[v]x, v] have
    the same product and are smooth. Their linearisation is exact as long as the burn stays vanished,
    but keeps it from growing. `alternatives` therefore gives, for each vanished burn, the model in
    which it is executed whatever its size. Both models bound the errors from above; an algorithm
    takes the better answer and judges it by the merit, of the errors themselves, so that a burn may
    come or go but not alternate. An executed burn vanishes only if its size goes to zero: no
    derivative shows that leaving it out might save its fixed error.

    Attributes:
        magnitude_fixed: s_f, in the units of the burns.
        magnitude_proportional: s_p.
        pointing_fixed: p_f per axis across, in the units of the burns.
        pointing_proportional: p_p per axis across, rad.
        magnitude_bias: b, common to all burns.
        executed: burns that count as executed whatever their size.
    """

    magnitude_fixed: float
    magnitude_proportional: float
    pointing_fixed: float
    pointing_proportional: float
    magnitude_bias: float = 0.0
    executed: frozenset[int] = frozenset()

    def in_units(self, speed: float) -> GatesErrors:
        """See `ExecutionErrors.in_units`."""
        fixed = self.magnitude_fixed / speed, self.pointing_fixed / speed
        return replace(self, magnitude_fixed=fixed[0], pointing_fixed=fixed[1])

    @property
    def own(self) -> int:
        """Four: magnitude and pointing; with a fixed part eight."""
        return 4 if self.affine else 8

    @property
    def shared(self) -> int:
        """One, if there is a bias."""
        return int(self.magnitude_bias > 0.0)

    @property
    def affine(self) -> bool:
        """Whether there is no fixed part."""
        return self.fixed_bound == 0.0

    @property
    def fixed_bound(self) -> float:
        """The larger fixed error, m."""
        return max(self.magnitude_fixed, self.pointing_fixed)

    def transitions(self, square: Any) -> tuple[Any, Any]:
        """Transitions at a squared size v^2: e^2, of execution, and t / v^2, of having a direction.

        The fixed part's root is e ((m - t (m - p_f)) I + t (s_f - p_f) u u'). Plain arithmetic, for
        arrays and CasADi's symbols.
        """
        vanished, pointing = (VANISHED * self.fixed_bound) ** 2, self.fixed_bound**2
        left = 1.0 - square / vanished
        left = (left + abs(left)) / 2.0
        share = (square - vanished) / (pointing - vanished)
        share = (abs(share) - abs(share - 1.0) + 1.0) / 2.0
        # Quintic "smootherstep": zero derivatives of first and second order at both ends.
        turned = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        size = (square + vanished + abs(square - vanished)) / 2.0
        return 1.0 - left**3, turned / size

    def columns(self, burns: Array) -> Array:
        """See `ExecutionErrors.columns`."""
        return np.concatenate([self._linear(burns), self._fixed(burns)], axis=2)

    def jacobian(self, burns: Array) -> Array:
        """See `ExecutionErrors.jacobian`."""
        unit = np.moveaxis(self._linear(np.eye(3)), 0, -1)
        linear = np.broadcast_to(unit, (len(burns), *unit.shape))
        return np.concatenate([linear, self._fixed_jacobian(burns)], axis=2)

    def of_correction(self, n: int) -> int:
        """Three across; n more where errors along are the larger ones."""
        return 3 + n * int(self.along_more > 0.0)

    @property
    def along_more(self) -> float:
        """Root of the excess of relative variance along, the bias included, over that across."""
        along = self.magnitude_proportional**2 + self.magnitude_bias**2
        return float(np.sqrt(max(along - self.pointing_proportional**2, 0.0)))

    def correction_columns(self, gains: Array) -> tuple[Array, Array]:
        """See `ExecutionErrors.correction_columns`: p_p |U| I and sqrt(s_p^2 + b^2 - p_p^2) U.

        Where errors across are the larger ones, p_p |U| I alone bounds the second moment from above.
        The fixed parts are the planned burn's: a correction turns and grows it too little to matter.
        """
        size, n = float(np.linalg.norm(gains)), gains.shape[1]
        across, more = self.pointing_proportional, self.along_more
        jacobian = np.zeros((3, self.of_correction(n), 3, n))
        jacobian[range(3), range(3)] = across * gains / max(size, TINY)
        columns = across * size * np.eye(3)
        if not more:
            return columns, jacobian
        for axis in range(3):
            jacobian[axis, 3 + np.arange(n), axis, np.arange(n)] = more
        return np.hstack([columns, more * gains]), jacobian

    def alternatives(self, burns: Array) -> Iterator[ExecutionErrors]:
        """See `ExecutionErrors.alternatives`: each vanished burn executed."""
        for burn in np.flatnonzero(self._vanished(burns)).tolist():
            yield replace(self, executed=frozenset({burn}))

    def _vanished(self, burns: Array) -> Array:
        small = np.linalg.norm(burns, axis=1) < VANISHED * self.fixed_bound
        small[list(self.executed)] = False
        return small

    def _linear(self, burns: Array) -> Array:
        """Bias, proportional magnitude and pointing: b v, s_p v, p_p [v]x."""
        along = burns[:, :, None]
        bias = [self.magnitude_bias * along] * self.shared
        across = self.pointing_proportional * skew(burns)
        return np.concatenate([*bias, self.magnitude_proportional * along, across], axis=2)

    def _fixed(self, burns: Array) -> Array:
        """The root and a column of zeros; of a vanished burn (m e / |v|) [[v]x, v]."""
        columns = np.zeros((len(burns), 3, self.own - 4))
        if self.affine:
            return columns
        m, p, gone = self.fixed_bound, self.pointing_fixed, self._vanished(burns)
        square = np.einsum("mi,mi->m", burns, burns)
        _, points = self.transitions(square)
        outer = np.einsum("mi,mj->mij", burns, burns)
        columns[:, :, :3] = (m - points * square * (m - p))[:, None, None] * np.eye(3)
        columns[:, :, :3] += (points * (self.magnitude_fixed - p))[:, None, None] * outer
        slope, _ = self._slope(square[gone])
        columns[gone] = slope[:, None, None] * _isotropic(burns[gone])
        return columns

    def _fixed_jacobian(self, burns: Array) -> Array:
        jacobian = np.zeros((len(burns), 3, self.own - 4, 3))
        if self.affine:
            return jacobian
        m, p, s = self.fixed_bound, self.pointing_fixed, self.magnitude_fixed
        square, eye = np.einsum("mi,mi->m", burns, burns), np.eye(3)
        vanished = (VANISHED * m) ** 2
        share = np.clip((square - vanished) / (m**2 - vanished), 0.0, 1.0)
        _, points = self.transitions(square)
        # Of t and of t / v^2 by v^2.
        turning = 30.0 * (share * (1.0 - share)) ** 2 / (m**2 - vanished)
        pointing = (turning - points) / np.maximum(square, vanished)
        pointing[square < vanished] = 0.0
        outer = np.einsum("mi,mj->mij", burns, burns)
        along = np.einsum("mi,jl->mijl", burns, eye)
        jacobian[:, :, :3] = (s - p) * (
            2.0 * np.einsum("m,mij,ml->mijl", pointing, outer, burns)
            + points[:, None, None, None] * (along + along.swapaxes(1, 2))
        ) - 2.0 * (m - p) * np.einsum("m,ij,ml->mijl", turning, eye, burns)
        gone = self._vanished(burns)
        slope, change = self._slope(square[gone])
        unit = np.moveaxis(_isotropic(eye), 0, -1)
        jacobian[gone] = slope[:, None, None, None] * unit + 2.0 * np.einsum(
            "m,mik,ml->mikl", change, _isotropic(burns[gone]), burns[gone]
        )
        return jacobian

    def _slope(self, square: Array) -> tuple[Array, Array]:
        """Factor m e / |v| of vanished burns, and its derivative by v^2."""
        vanished = VANISHED * self.fixed_bound
        y = square / vanished**2
        root = np.sqrt(3.0 - 3.0 * y + y**2)
        return (
            self.fixed_bound / vanished * root,
            self.fixed_bound / vanished**3 * (y - 1.5) / root,
        )


def skew(vectors: Array) -> Array:
    """[v]x with [v]x w = v x w, of vectors (m, 3), shape (m, 3, 3)."""
    return np.cross(vectors[:, None, :], np.eye(3)).swapaxes(1, 2)


def _isotropic(burns: Array) -> Array:
    """Columns [[v]x, v], whose product is v^2 I, shape (m, 3, 4)."""
    return np.concatenate([skew(burns), burns[:, :, None]], axis=2)
