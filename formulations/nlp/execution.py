"""The columns of the burns' errors over CasADi symbols: `problem.execution_errors`, term by term."""

from __future__ import annotations

import casadi as ca
import numpy as np

from formulations.problem.execution_errors import (
    ComponentwiseErrors,
    ExecutionErrors,
    GatesErrors,
)

TINY = 1e-16
"""Added under the root of how far a burn is executed, which has a kink where the burn vanishes."""


def shared_columns(errors: ExecutionErrors, burn: ca.MX) -> ca.MX:
    """Columns that burns share, of a burn (3,), shape (3, shared)."""
    if isinstance(errors, GatesErrors) and errors.shared:
        return errors.magnitude_bias * burn
    return ca.MX(3, 0)


def own_columns(errors: ExecutionErrors, burn: ca.MX) -> ca.MX:
    """Columns of a burn (3,) alone, shape (3, own)."""
    if isinstance(errors, GatesErrors):
        parts = [errors.magnitude_proportional * burn, errors.pointing_proportional * ca.skew(burn)]
        if not errors.affine:
            executed, root = _fixed_part(errors, burn)
            parts += [ca.sqrt(executed + TINY) * root, ca.MX(3, 1)]
        return ca.horzcat(*parts)
    return _componentwise(errors).fraction * ca.diag(burn)


def own_covariance(errors: ExecutionErrors, burn: ca.MX) -> ca.MX:
    """Covariance C C' of a burn's own columns, shape (3, 3), smooth where the burn (3,) vanishes."""
    if isinstance(errors, GatesErrors):
        s, p, outer = errors.magnitude_proportional, errors.pointing_proportional, burn @ burn.T
        found = s**2 * outer + p**2 * (ca.dot(burn, burn) * ca.MX(np.eye(3)) - outer)
        if not errors.affine:
            executed, root = _fixed_part(errors, burn)
            found += executed * root @ root
        return found
    return ca.diag((_componentwise(errors).fraction * burn) ** 2)


def _fixed_part(errors: GatesErrors, burn: ca.MX) -> tuple[ca.MX, ca.MX]:
    """How far a burn is executed, squared, and the symmetric root of its fixed part, (3, 3)."""
    square = ca.dot(burn, burn)
    executed, points = errors.transitions(square)
    m, s, p = errors.fixed_bound, errors.magnitude_fixed, errors.pointing_fixed
    isotropic = m - points * square * (m - p)
    return executed, isotropic * ca.MX(np.eye(3)) + points * (s - p) * (burn @ burn.T)


def _componentwise(errors: ExecutionErrors) -> ComponentwiseErrors:
    """The only other model.

    Raises:
        TypeError: if it is one that no nonlinear program has been written for.
    """
    if not isinstance(errors, ComponentwiseErrors):
        raise TypeError(f"no nonlinear program for {type(errors).__name__}")
    return errors
