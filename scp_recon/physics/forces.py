"""Forces on the spacecraft: point mass, J2, harmonics, a companion, and cannonball radiation pressure.

The acceleration is written once, over plain arithmetic, so that NumPy arrays (real or complex) and
CasADi symbols pass through it alike. Its first and second derivatives are in closed form. With
harmonics or a companion, functions also take their orientation and position, from
`ForceModel.moment`.

Derivatives by the strengths of forces, where these are uncertain, are central differences between
force models. Where the body turns by a small angle t, its gravity turns with it: with acceleration
a, gradient G and curvature H at x,

    da = t x a - G (t x x),        dG = [t] G - G [t] - H (t x x),

so that one evaluation of gravity serves all parameters of pole and spin.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from formulations.arrays import Array, Indices
from scp_recon.physics.frames import Rotation
from scp_recon.physics.harmonics import TurningField
from scp_recon.physics.two_body import Companion

SPEED_OF_LIGHT_M_S = 299_792_458.0
"""Exact by the definition of the metre."""


Moment = Any
"""Surroundings at a time, by rows of components in the inertial frame, shape (4, 3, ...).

The body's three axes, then the position of its companion; zero of what there is not.
"""


@dataclass(frozen=True)
class ForceModel:
    """Constants of the translational dynamics in one consistent set of units.

    For `accelerations` they may be those of as many flights as there are positions: arrays (n,) of
    numbers, and (3, n) of vectors.

    Attributes:
        gm: gravitational parameter, length^3 / time^2.
        j2_strength: 3/2 gm J2 R^2, length^5 / time^2.
        pole: unit vector of the spin axis in the inertial frame, shape (3,).
        srp: constant acceleration by solar radiation pressure, shape (3,), length / time^2.
        field: harmonics beside the point mass and that J2.
        companion: a second body in orbit about the first.
    """

    gm: float
    j2_strength: float
    pole: Array
    srp: Array
    field: TurningField | None = None
    companion: Companion | None = None

    def moment(self, time: Array | float) -> Moment | None:
        """Surroundings at times; None where forces do not depend on them."""
        if not self.timed:
            return None
        rows = np.zeros((4, 3, *np.shape(time)))
        if self.field is not None:
            axes = self.field.rotation.body_to_j2000(time)
            rows[:3] = np.moveaxis(axes, (-1, -2), (0, 1))
        if self.companion is not None:
            rows[3] = np.moveaxis(self.companion.position(time), -1, 0)
        return rows

    def in_units(self, length: float, time: float) -> ForceModel:
        """The same forces measured in units of `length` and `time`."""
        return ForceModel(
            gm=self.gm * time**2 / length**3,
            j2_strength=self.j2_strength * time**2 / length**5,
            pole=self.pole,
            srp=self.srp * time**2 / length,
            field=self.field and self.field.in_units(length, time),
            companion=self.companion and self.companion.in_units(length, time),
        )

    @property
    def timed(self) -> bool:
        """Whether they depend on time."""
        return self.field is not None or self.companion is not None

    @property
    def autonomous(self) -> ForceModel:
        """The forces without those that depend on time."""
        return replace(self, field=None, companion=None)

    @cached_property
    def of_companion(self) -> ForceModel:
        """The companion's acceleration at a position relative to its centre."""
        assert self.companion is not None
        return ForceModel(self.companion.gm, 0.0, self.pole, np.zeros(3))


def cannonball_srp(
    sun_direction: Array,
    area_m2: float,
    reflectivity: float,
    mass_kg: float,
    sun_distance_au: float,
    solar_constant_w_m2: float,
) -> Array:
    """Cannonball acceleration away from the Sun, shape (3,), m/s^2, frame of `sun_direction`.

    a = -(S / c) d^-2 C_R (A / m) s, with s the unit vector to the Sun and d its distance in au.
    """
    pressure = solar_constant_w_m2 / SPEED_OF_LIGHT_M_S / sun_distance_au**2
    return -pressure * reflectivity * area_m2 / mass_kg * sun_direction


def acceleration(
    x: Any, y: Any, z: Any, forces: ForceModel, moment: Moment | None = None
) -> tuple[Any, Any, Any]:
    """Acceleration at a position given by components (scalars, arrays or symbols alike)."""
    px, py, pz = forces.pole
    radial, polar = _pulls(x * x + y * y + z * z, px * x + py * y + pz * z, forces)
    sx, sy, sz = forces.srp
    ax, ay, az = radial * x + polar * px, radial * y + polar * py, radial * z + polar * pz
    if forces.field is not None:
        more = forces.field.acceleration(x, y, z, _given(moment)[:3])
        ax, ay, az = ax + more[0], ay + more[1], az + more[2]
    if forces.companion is not None:
        cx, cy, cz = _given(moment)[3]
        dx, dy, dz = x - cx, y - cy, z - cz
        near, far = (
            -forces.companion.gm / (r2 * r2**0.5)
            for r2 in (dx * dx + dy * dy + dz * dz, cx * cx + cy * cy + cz * cz)
        )
        # The frame falls towards the companion with the body.
        ax, ay, az = ax + near * dx + far * cx, ay + near * dy + far * cy, az + near * dz + far * cz
    return ax + sx, ay + sy, az + sz


def _given(moment: Moment | None) -> Moment:
    if moment is None:
        raise ValueError("forces that depend on time: expected the surroundings of `moment`")
    return moment


def _apart(position: Array, moment: Moment | None) -> tuple[Array, Array]:
    """Positions (3, n) from the companion's centre, and that centre, shape (3, n) or (3, 1)."""
    centre = np.asarray(_given(moment)[3]).reshape(3, -1)
    return position - centre, centre


def accelerations(position: Array, forces: ForceModel, moment: Moment | None = None) -> Array:
    """Accelerations at positions (3, n), shape (3, n), in a third of `acceleration`'s operations."""
    r2 = np.einsum("in,in->n", position, position)
    pole, srp = (a if a.ndim == 2 else a[:, None] for a in (forces.pole, forces.srp))
    own = forces.pole @ position if forces.pole.ndim == 1 else (pole * position).sum(axis=0)
    radial, polar = _pulls(r2, own, forces)
    value = radial * position
    value += pole * polar
    value += srp
    if forces.field is not None:
        value += forces.field.derivatives(position, _given(moment)[:3], 0)
    if forces.companion is not None:
        apart, centre = _apart(position, moment)
        value += accelerations(apart, forces.of_companion)
        value += accelerations(centre, forces.of_companion)
    return value


def _pulls(r2: Any, u: Any, forces: ForceModel) -> tuple[Any, Any]:
    """Factors of position and pole in the acceleration, from r . r and u = p . r.

    With k = 3/2 gm J2 R^2 the oblateness part is the gradient of -k/3 (3 u^2 / r^5 - 1 / r^3),
    Montenbruck & Gill, Satellite Orbits, eq. 3.32 for n = 2, m = 0.
    """
    inverse = 1.0 / r2
    inverse3 = inverse * inverse**0.5
    inverse5 = forces.j2_strength * inverse3 * inverse
    radial = inverse5 * (5.0 * u * u * inverse - 1.0) - forces.gm * inverse3
    return radial, -2.0 * inverse5 * u


def gravity_gradient(position: Array, forces: ForceModel, moment: Moment | None = None) -> Array:
    """Gravity gradient da_i/dx_j at positions (n, 3), shape (n, 3, 3), symmetric.

    The acceleration is f(x) x + g(x) p + const. With f_j = e1 x_j + e2 p_j and
    g_j = e3 p_j + e2 x_j the gradient is f I + e1 x x' + e2 (x p' + p x') + e3 p p'.
    """
    k, p = forces.j2_strength, forces.pole
    u, i2, i5 = _oblate(position, p)
    i7 = i5 * i2
    u2 = u * u
    f = k * (5.0 * u2 * i7 - i5) - forces.gm * i5 / i2
    e1 = 3.0 * forces.gm * i5 + k * (5.0 - 35.0 * u2 * i2) * i7
    e2, e3 = 10.0 * k * u * i7, -2.0 * k * i5
    # x (e1 x + e2 p)' + p (e2 x + e3 p)' + f I
    gradient = position[:, :, None] * (e1[:, None] * position + e2[:, None] * p)[:, None, :]
    gradient += p[:, None] * (e2[:, None] * position + e3[:, None] * p)[:, None, :]
    gradient[:, [0, 1, 2], [0, 1, 2]] += f[:, None]
    if forces.field is not None:
        gradient += forces.field.derivatives(position.T, _given(moment)[:3], 1).transpose(2, 0, 1)
    if forces.companion is not None:
        apart, _ = _apart(position.T, moment)
        gradient += gravity_gradient(apart.T, forces.of_companion)
    return gradient


def gravity_curvature(position: Array, forces: ForceModel, moment: Moment | None = None) -> Array:
    """Gravity's second derivative d2a_i/dx_j dx_k at positions (n, 3), shape (n, 3, 3, 3), symmetric.

    With e1 = .. + c x and so on for the coefficients of the gradient it is
    c x x x + d (x x p + ..) + e (x p p + ..) + e1 (I x + ..) + e2 (I p + ..), where dots stand for
    the other orders of a product; they are what the cyclic sum over (i, j, k) adds.
    """
    k, p, x = forces.j2_strength, forces.pole, position
    u, i2, i5 = _oblate(x, p)
    i7 = i5 * i2
    i9 = i7 * i2
    u2 = u * u
    e1 = 3.0 * forces.gm * i5 + k * (5.0 - 35.0 * u2 * i2) * i7
    e2 = 10.0 * k * u * i7
    c = k * (315.0 * u2 * i2 - 35.0) * i9 - 15.0 * forces.gm * i7
    d, e = -70.0 * k * u * i9, 10.0 * k * i7
    # Beside an x goes c/3 x x + e1 I, and beside a p goes d x x + e/2 (x p + p x) + e2 I.
    xx = x[:, :, None] * x[:, None, :]
    beside_x = (c / 3.0)[:, None, None] * xx
    beside_p = (d[:, None] * x + (0.5 * e)[:, None] * p)[:, :, None] * x[:, None, :]
    beside_p += (0.5 * e)[:, None, None] * (x[:, :, None] * p)
    beside_x[:, [0, 1, 2], [0, 1, 2]] += e1[:, None]
    beside_p[:, [0, 1, 2], [0, 1, 2]] += e2[:, None]
    part = beside_x[:, :, :, None] * x[:, None, None, :] + beside_p[:, :, :, None] * p
    part = part + part.transpose(0, 3, 1, 2) + part.transpose(0, 2, 3, 1)
    if forces.field is not None:
        part += forces.field.derivatives(position.T, _given(moment)[:3], 2).transpose(3, 0, 1, 2)
    if forces.companion is not None:
        apart, _ = _apart(position.T, moment)
        part += gravity_curvature(apart.T, forces.of_companion)
    return part


def _oblate(position: Array, pole: Array) -> tuple[Array, Array, Array]:
    """For positions r and the pole p: p . r, 1 / r^2 and 1 / r^5, shape (n,) each."""
    i2 = 1.0 / np.einsum("ni,ni->n", position, position)
    return position @ pole, i2, i2 * i2 * np.sqrt(i2)


STEP = 1e-3
"""Half the distance of two models, in standard deviations: gravity is linear in most parameters, and
cubic terms of angles of degrees are below 1e-9."""


@dataclass(frozen=True, eq=False)
class Partials:
    """Force models and rotations ahead and behind along p parameters, by `STEP` sigma each.

    Attributes:
        ahead, behind: models of the parameters that act on strengths of forces.
        columns: numbers of these among all parameters.
        turns: rotations of the body ahead and behind, of the parameters that turn it.
        turning: numbers of these.
        gravity: the mean gravity that turns with the body.
        count: number p of all parameters.
    """

    ahead: tuple[ForceModel, ...]
    behind: tuple[ForceModel, ...]
    columns: Indices
    turns: tuple[tuple[Rotation, Rotation], ...]
    turning: Indices
    gravity: ForceModel
    count: int

    def in_units(self, length: float, time: float) -> Partials:
        """The same measured in units of `length` and `time`."""
        ahead, behind = (
            tuple(one.in_units(length, time) for one in side) for side in (self.ahead, self.behind)
        )
        turns = tuple((one.in_units(time), other.in_units(time)) for one, other in self.turns)
        gravity = self.gravity.in_units(length, time)
        return replace(self, ahead=ahead, behind=behind, turns=turns, gravity=gravity)

    def accelerations(self, position: Array, time: Array) -> Array:
        """Derivatives of the accelerations at positions (n, 3) and times (n,), shape (n, 3, p)."""
        found = np.zeros((*position.shape, self.count))
        for column, ahead, behind in zip(self.columns, self.ahead, self.behind, strict=True):
            a, b = (accelerations(position.T, one, one.moment(time)) for one in (ahead, behind))
            found[:, :, column] = (a - b).T / (2.0 * STEP)
        if self.turns:
            moment = self.gravity.moment(time)
            pull = accelerations(position.T, self.gravity, moment).T
            gradient = gravity_gradient(position, self.gravity, moment)
            for column, turn in zip(self.turning, self._small_turns(time), strict=True):
                moved = turn @ position[:, :, None]
                found[:, :, column] += (turn @ pull[:, :, None] - gradient @ moved)[:, :, 0]
        return found

    def gradients(self, position: Array, time: Array) -> Array:
        """Derivatives of the gravity gradients at positions (n, 3), times (n,), shape (n, p, 3, 3)."""
        found = np.zeros((len(position), self.count, 3, 3))
        for column, ahead, behind in zip(self.columns, self.ahead, self.behind, strict=True):
            a, b = (gravity_gradient(position, one, one.moment(time)) for one in (ahead, behind))
            found[:, column] = (a - b) / (2.0 * STEP)
        if self.turns:
            moment = self.gravity.moment(time)
            gradient = gravity_gradient(position, self.gravity, moment)
            curvature = gravity_curvature(position, self.gravity, moment)
            for column, turn in zip(self.turning, self._small_turns(time), strict=True):
                moved, turned = turn @ position[:, :, None], turn @ gradient
                found[:, column] += turned + turned.transpose(0, 2, 1)
                found[:, column] -= (curvature @ moved[:, None])[:, :, :, 0]
        return found

    def _small_turns(self, time: Array) -> Iterator[Array]:
        """Matrices [t] of the body's turn along each parameter, shape (n, 3, 3), or (1, 3, 3)."""
        for sides in self.turns:
            if self.gravity.field is None:  # J2 turns with the pole alone
                one, other = (side.pole for side in sides)
                across = np.outer(one - other, 0.5 * (one + other))
                yield (across - across.T)[None] / (2.0 * STEP)
            else:
                one, other = (side.body_to_j2000(time) for side in sides)
                yield (one - other) @ (one + other).transpose(0, 2, 1) / (4.0 * STEP)
