"""From what a scenario says of its uncertainty to a covariance factor and a model of burn errors."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from formulations.problem.execution_errors import (
    ComponentwiseErrors,
    ExecutionErrors,
    GatesErrors,
)
from scp_recon.errors import InputError
from scp_recon.physics.frames import Rotation, sun_north_to_j2000, unit
from scp_recon.scenario.schema import Scenario

Array = npt.NDArray[np.float64]

ALONG = 1e-6
"""Sine of the angle between position and velocity below which they span no plane."""


def factor_in_flight(
    scenario: Scenario, state: Array, rotation: Rotation, sun: Array
) -> Array | None:
    """Factor S of the covariance S S' that a scenario gives in flight; None if it gives none.

    Arguments, and what is raised, are those of `initial_factor`, the state being that in flight.
    """
    flight = scenario.in_flight
    if flight is None or flight.covariance is None:
        return None
    root = _root(np.array(flight.covariance))
    _check_size(root, state, scenario, "in_flight.covariance")
    axes = _axes(flight.covariance_frame, state, rotation, sun, "in_flight.covariance_frame")
    return np.vstack([axes @ root[:3], axes @ root[3:]])


def initial_factor(scenario: Scenario, state: Array, rotation: Rotation, sun: Array) -> Array:
    """Factor S of the covariance S S' of the initial state, J2000, m and m/s, shape (6, 6).

    Args:
        scenario: gives the uncertainty and its frame.
        state: the initial state, J2000, m and m/s, shape (6,); a fraction is of its components, and
            radial, transverse and normal are its own.
        rotation: of the body.
        sun: direction to the Sun at the epoch, J2000.

    Raises:
        InputError: if the state has no plane to be normal to, or its sigma is as large as itself.
    """
    u = scenario.uncertainty
    if u.initial_sigma_fraction is not None:
        return np.diag(u.initial_sigma_fraction * np.abs(state))
    if u.initial_covariance is None:
        assert u.initial_sigma_position_m is not None
        assert u.initial_sigma_velocity_m_s is not None
        root = np.diag([*u.initial_sigma_position_m, *u.initial_sigma_velocity_m_s])
    else:
        root = _root(np.array(u.initial_covariance))
    _check_size(root, state, scenario)
    axes = _axes(str(u.initial_frame), state, rotation, sun)
    return np.vstack([axes @ root[:3], axes @ root[3:]])


def _root(covariance: Array) -> Array:
    """Square root by the eigenvalues of the correlations; what rounding made negative is zero."""
    sigma = np.sqrt(np.diag(covariance))
    known = np.where(sigma > 0.0, sigma, 1.0)
    scaled = covariance / np.outer(known, known)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    return known[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def _check_size(root: Array, state: Array, scenario: Scenario, entry: str | None = None) -> None:
    """Beyond these sigmas the spread is no spread about a flight: a slip of units, most likely."""
    sigma, gm = np.linalg.norm(root, axis=1), scenario.body.gm_m3_s2
    matrix = scenario.uncertainty.initial_covariance is not None
    distance = float(np.linalg.norm(state[:3]))
    speed = max(float(np.linalg.norm(state[3:])), float(np.sqrt(gm / distance)))
    for key, unit_name, given, most, what in (
        ("position_m", "m", sigma[:3], distance, "distance from the centre"),
        ("velocity_m_s", "m/s", sigma[3:], speed, "speed, or that of a circular orbit"),
    ):
        if given.max() >= most:
            raise InputError(
                entry or "uncertainty.initial_" + ("covariance" if matrix else f"sigma_{key}"),
                f"a 1-sigma error of {given.max():g} {unit_name}",
                f"must be below the initial {what}, {most:g} {unit_name}",
            )


def _axes(
    frame: str,
    state: Array,
    rotation: Rotation,
    sun: Array,
    entry: str = "uncertainty.initial_frame",
) -> Array:
    """From the components in a frame to J2000 at the epoch, shape (3, 3)."""
    if frame == "rtn":
        return _rtn_to_j2000(state, entry)
    if frame == "sun_north":
        return sun_north_to_j2000(sun, rotation.pole)
    return rotation.body_to_j2000(0.0) if frame == "body_fixed" else np.eye(3)


def _rtn_to_j2000(state: Array, entry: str) -> Array:
    """Radial, transverse (towards the velocity) and normal axes of a state, as columns, J2000."""
    radial, momentum = unit(state[:3]), np.cross(state[:3], state[3:])
    size = np.linalg.norm(state[:3]) * np.linalg.norm(state[3:])
    if np.linalg.norm(momentum) <= ALONG * size:
        raise InputError(
            entry,
            "rtn",
            "must be another frame: the initial velocity points along the position or is zero",
        )
    normal = unit(momentum)
    return np.stack([radial, np.cross(normal, radial), normal], axis=1)


def execution_errors(scenario: Scenario, speed_m_s: float = 1.0) -> ExecutionErrors:
    """The model of the burns' errors, for burns in units of a speed.

    Raises:
        InputError: if a fixed error is as large as the largest burn.
    """
    u, most = scenario.uncertainty, scenario.burns.dv_max_m_s
    if u.gates is None:
        assert u.execution_error is not None
        return ComponentwiseErrors(u.execution_error)
    gates = u.gates
    for name in ("magnitude_fixed_m_s", "pointing_fixed_m_s"):
        if getattr(gates, name) >= most:
            raise InputError(
                f"uncertainty.gates.{name}",
                f"{getattr(gates, name):g}",
                f"must be below burns.dv_max_m_s, {most:g} m/s",
            )
    return GatesErrors(
        magnitude_fixed=gates.magnitude_fixed_m_s / speed_m_s,
        magnitude_proportional=gates.magnitude_proportional,
        pointing_fixed=gates.pointing_fixed_m_s / speed_m_s,
        pointing_proportional=gates.pointing_proportional_rad,
        magnitude_bias=gates.magnitude_bias,
    )


def errors_of_kind(scenario: Scenario, kind: str | None) -> ExecutionErrors:
    """The scenario's model for burns in m/s, or another kind of the same size.

    Args:
        scenario: gives the errors.
        kind: "componentwise" or "gates"; None for the scenario's own.

    Raises:
        InputError: if the scenario gives Gates' errors, which no componentwise ones stand for.
    """
    own = execution_errors(scenario)
    if kind is None or kind == scenario.uncertainty.errors:
        return own
    if isinstance(own, ComponentwiseErrors):
        # The isotropic counterpart: a magnitude error of beta, and a pointing error of beta rad.
        return GatesErrors(0.0, own.fraction, 0.0, own.fraction)
    raise InputError(
        "errors", repr(kind), "must be 'gates', or not given: the scenario's errors are Gates'"
    )
