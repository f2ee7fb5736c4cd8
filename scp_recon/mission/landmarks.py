"""Determine states from pictures of landmarks: what each cut-off knows, by linear estimation.

State, uncertain parameters and errors of the map are estimated together along a path, from all pictures
so far, with what was known before the flight and the execution errors of the planned burns. Errors of
the map, which all pictures share, thus never average out. A plan's filter has one measurement of the
state at each cut-off instead. Its errors are independent of all others, and such that the error of the
estimated state has the covariance of that estimation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, solve_triangular

from formulations.arrays import Array
from scp_recon.errors import InputError
from scp_recon.mission.feedback import USELESS
from scp_recon.mission.knowledge import Uncertain
from scp_recon.mission.scene import Scene
from scp_recon.physics.frames import unit
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.uncertainty import Landmarks

LEAST = 1e-6
"""Error below which nothing is learnt, over the root mean square of those of position, or velocity."""

GOLDEN_RAD = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True, eq=False)
class Path:
    """A path along which pictures are taken, and how errors grow there; J2000, m and m/s.

    Attributes:
        times_s: nodes, with all pictures and cut-offs among them, shape (n,).
        position_m: at the nodes, shape (n, 3).
        stm: of the state and p parameters along each arc, shape (n - 1, 6 + p, 6 + p).
        executed: covariances of the velocity that burns add, by their nodes, shape (3, 3) each; none
            on a coast, which is no plan.
        prior: covariance of state and parameters at the first node, shape (6 + p, 6 + p).
    """

    times_s: Array
    position_m: Array
    stm: Array
    executed: Mapping[int, Array]
    prior: Array


def picture_times_s(scenario: Scenario, until_s: float) -> Array:
    """Times of the pictures up to a time, s; in flight of those after the delivered state."""
    given = scenario.navigation.landmarks
    assert given is not None
    times = given.every_s * np.arange(round(given.last_by(until_s) / given.every_s) + 1)
    after = -np.inf if scenario.in_flight is None else scenario.start_s
    return np.asarray(times[times > after])


@dataclass(frozen=True, eq=False)
class Camera:
    """Lines of sight to the landmarks of a scene's body.

    Attributes:
        scene: with the body, its rotation and the Sun.
        uncertain: parameters, some of which turn the body.
    """

    scene: Scene
    uncertain: Uncertain

    @property
    def given(self) -> Landmarks:
        """What the scenario says of camera and map."""
        given = self.scene.scenario.navigation.landmarks
        assert given is not None
        return given

    @cached_property
    def _radii(self) -> Array:
        body = self.scene.scenario.body
        return np.array(body.radii_m or (body.reference_radius_m,) * 3)

    @cached_property
    def _spread(self) -> Array:
        """Unit vectors that are spread evenly, a Fibonacci lattice, shape (l, 3)."""
        count = 2 * self.given.number
        z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
        across, turn = np.sqrt(1.0 - z * z), GOLDEN_RAD * np.arange(count)
        return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)

    @property
    def landmarks_m(self) -> Array:
        """Landmarks, body-fixed, m, shape (l, 3)."""
        return self._radii * self._spread

    def partials(self, time_s: float, position_m: Array) -> Array:
        """Derivatives of a picture's pixels by state, parameters and map, shape (2 v, 6 + p + 3 l).

        They are of the v landmarks that are lit, visible and in the field, seen from a position (3,).
        """
        turn, normals = self.scene.rotation.body_to_j2000(time_s), unit(self._spread / self._radii)
        places, up = self.landmarks_m @ turn.T, normals @ turn.T
        axis, half = -unit(position_m), np.deg2rad(0.5 * self.given.field_of_view_deg)
        line = places - position_m
        depth, focal = line @ axis, 0.5 * self.given.pixels / np.tan(half)
        seen = np.einsum("li,li->l", up, line) < 0.0
        seen &= (up @ self.scene.sun_direction(time_s) > 0.0) & (
            depth > np.cos(half) * np.linalg.norm(line, axis=1)
        )
        who, line, depth = np.flatnonzero(seen), line[seen], depth[seen, None, None]
        across = np.linalg.svd(axis[None])[2][1:]
        by_line = focal * (across - (line @ across.T)[:, :, None] * axis / depth) / depth
        p = self.uncertain.count
        found = np.zeros((len(who), 2, 6 + p + 3 * len(places)))
        found[:, :, :3] = -by_line
        if p:
            own, rotation = self.landmarks_m[who], self.scene.rotation
            moved = self.uncertain.slopes(
                lambda one: own @ one.rotation(rotation).body_to_j2000(time_s).T
            )
            found[:, :, 6 : 6 + p] = np.einsum("vij,vjk->vik", by_line, moved)
        for i, landmark in enumerate(who.tolist()):
            first = 6 + p + 3 * landmark
            found[i, :, first : first + 3] = by_line[i] @ turn
        return found.reshape(-1, found.shape[2])


def measurement_factors(camera: Camera, path: Path, cut_offs_s: Iterable[float]) -> Array:
    """Factors N of the covariances N N' of states measured at cut-offs, m and m/s, shape (k, 6, 6).

    With P of the estimation and P- of the filter that has the measurements before,
    (N N')^-1 = P^-1 - (P-)^-1; an error is at most `USELESS` times what is known without it. Parameters
    are learnt by the state alone.

    Raises:
        InputError: if no picture before a cut-off shows a landmark, along planned burns.
    """
    given, size = camera.given, len(path.prior)
    errors = given.map_error_m**2 * np.eye(3 * len(camera.landmarks_m))
    whole, own = block_diag(path.prior, errors), path.prior.copy()
    pictures = picture_times_s(camera.scene.scenario, path.times_s[-1])
    found, cut_offs, shown = list[Array](), list(cut_offs_s), 0
    for k, (time, position) in enumerate(zip(path.times_s, path.position_m, strict=True)):
        if k > 0:
            stm = path.stm[k - 1]
            own = stm @ own @ stm.T
            whole[:size] = stm @ whole[:size]
            whole[:, :size] = whole[:, :size] @ stm.T
        if time in pictures:
            seen = camera.partials(time, position)
            whole = _updated(whole, seen, given.pixel_error**2 * np.eye(len(seen)))
            shown += len(seen)
        if time in cut_offs:
            if not shown and path.executed:
                raise InputError(
                    "navigation.landmarks",
                    f"no landmark that is lit, visible and in the field until {time:g} s",
                    "must have one before each cut-off: mind field_of_view_deg, number and every_s",
                )
            found.append(_factor(own[:6, :6], whole[:6, :6]))
            own = _updated(own, np.eye(6, size), found[-1] @ found[-1].T)
        if k in path.executed:
            own[3:6, 3:6] += path.executed[k]
            whole[3:6, 3:6] += path.executed[k]
        if len(found) == len(cut_offs):
            break
    return np.array(found)


def _updated(covariance: Array, partials: Array, errors: Array) -> Array:
    """The covariance after measurements with partials (m, n) and errors of covariance (m, m)."""
    known = partials @ covariance
    after = covariance - known.T @ cho_solve(cho_factor(known @ partials.T + errors), known)
    return np.asarray(0.5 * (after + after.T))


def _factor(before: Array, after: Array) -> Array:
    """Factor of a measurement's errors that takes an estimate's covariance from one to another."""
    blocks = np.diag(before).reshape(2, 3).mean(axis=1)
    floor = LEAST**2 * np.diag(np.repeat(blocks, 3))
    root = np.linalg.cholesky(before + floor)
    half = solve_triangular(root, after + floor, lower=True)
    left, axes = np.linalg.eigh(solve_triangular(root, half.T, lower=True))
    learnt = np.maximum(1.0 / left - 1.0, USELESS**-2)
    return np.asarray(root @ axes / np.sqrt(learnt))
