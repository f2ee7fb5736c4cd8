"""Uncertain parameters of body, site and spacecraft: their law, and what a deviation of them changes.

A deviation acts on the forces, on the site as it turns with the body, and on the companion's place.
Derivatives by the parameters are central differences over the forces, rotations and regions of two
deviations, so that each parameter acts on plans exactly where it acts on flights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from formulations.arrays import Array, Indices
from formulations.linearisation.factor import factor_of
from formulations.problem.motion import Motion
from scp_recon.bodies.catalogue import DAY_S
from scp_recon.display import exact
from scp_recon.errors import InputError
from scp_recon.physics.forces import STEP, ForceModel, Partials
from scp_recon.physics.frames import Rotation, unit
from scp_recon.physics.geometry import Site, track
from scp_recon.physics.two_body import Companion
from scp_recon.scenario.knowledge import SIZES
from scp_recon.scenario.schema import Scenario

GM, J2 = "body.gm_m3_s2", "body.j2"
POLE = "body.pole_ra_deg", "body.pole_dec_deg"
PHASE, RATE = "body.prime_meridian_deg", "body.prime_meridian_rate_deg_day"
SPIN = *POLE, PHASE, RATE
COMPANION_GM, COMPANION_PHASE = "body.companion.gm_m3_s2", "body.companion.mean_anomaly_deg"
AREA, REFLECTIVITY = "spacecraft.srp_area_m2", "spacecraft.reflectivity_coefficient"
POSITION, NORMAL = "site.position_body_m", "site.normal_body"

FAR = 3.0
"""Sigmas within which values have to be physical."""
TILT_MAX, TURN_MAX_DEG = 0.1, 10.0
"""Largest sigma of a normal's component and of an angle: beyond them the law is not normal."""


@dataclass(frozen=True)
class Deviation:
    """Parameters of flights less the scenario's, by entry: numbers, or one a flight.

    Attributes:
        values: arrays (...) of numbers, (..., 3) of vectors, in the entries' units.
    """

    values: Mapping[str, Array]

    def of(self, entry: str) -> Any:
        """The deviation of an entry; zero of one that is known."""
        return self.values.get(entry, 0.0)

    def at(self, flights: Indices | int) -> Deviation:
        """The deviations of some flights."""
        return Deviation({entry: value[flights] for entry, value in self.values.items()})

    @property
    def without_spin(self) -> Deviation:
        """The deviations of all else."""
        return Deviation(
            {entry: value for entry, value in self.values.items() if entry not in SPIN}
        )

    def rotation(self, rotation: Rotation) -> Rotation:
        """The body's rotation."""
        if not self.values.keys() & {*SPIN}:
            return rotation
        ra, dec = (np.deg2rad(self.of(entry)) for entry in POLE)
        return replace(
            rotation,
            pole_ra=rotation.pole_ra + ra,
            pole_dec=rotation.pole_dec + dec,
            meridian=rotation.meridian + np.deg2rad(self.of(PHASE)),
            rate=rotation.rate + np.deg2rad(self.of(RATE)) / DAY_S,
        )

    def site(self, site: Site) -> Site:
        """The site, body-fixed."""
        position, normal = self.of(POSITION), self.of(NORMAL)
        return Site(site.position_body + position, unit(site.normal_body + normal))

    def companion(self, companion: Companion) -> Companion:
        """The companion."""
        anomaly = companion.mean_anomaly + np.deg2rad(self.of(COMPANION_PHASE))
        return replace(companion, gm=companion.gm + self.of(COMPANION_GM), mean_anomaly=anomaly)

    def forces(self, forces: ForceModel, scenario: Scenario) -> ForceModel:
        """Forces whose rotation and companion deviate already, with what else deviates; SI."""
        body, craft = scenario.body, scenario.spacecraft
        ratio = 1.0 + self.of(GM) / body.gm_m3_s2
        more = 1.5 * body.gm_m3_s2 * self.of(J2) * body.reference_radius_m**2
        light = np.ones(1)
        if self.values.keys() & {AREA, REFLECTIVITY}:
            light = light + self.of(AREA) / craft.srp_area_m2
            light = light * (1.0 + self.of(REFLECTIVITY) / craft.reflectivity_coefficient)
        srp = forces.srp[:, None] * light
        return replace(
            forces,
            gm=forces.gm * ratio,
            j2_strength=(forces.j2_strength + more) * ratio,
            srp=srp[:, 0] if srp.shape[1] == 1 else srp,
            field=forces.field and replace(forces.field, strength=ratio),
        )


@dataclass(frozen=True, eq=False)
class Uncertain:
    """The normal law of q uncertain parameters, by p independent standard normal numbers.

    Attributes:
        entries: of the scenario, in order; one with three components counts three of q.
        factor: F with F F' their covariance, in the entries' units, shape (q, p).
    """

    entries: tuple[str, ...]
    factor: Array

    @classmethod
    def of(cls, scenario: Scenario) -> Uncertain:
        """The law of a scenario's `[knowledge]`; sigmas of zero are left out."""
        given = scenario.knowledge
        blocks = [] if given is None else [(e, np.diag(s)) for e, s in given.sigmas()]
        entries, roots = [e for e, _ in blocks], [root for _, root in blocks]
        if given is not None and given.names is not None:
            entries += given.names
            roots.append(factor_of(np.array(given.covariance)))
        factor = block_diag(*roots) if roots else np.zeros((0, 0))
        return cls(tuple(entries), factor[:, np.any(factor != 0.0, axis=0)])

    @property
    def count(self) -> int:
        """Number p of standard normal numbers."""
        return self.factor.shape[1]

    @property
    def sigmas(self) -> dict[str, Array]:
        """1 sigma of each entry, shape (1,) or (3,)."""
        return {entry: np.linalg.norm(rows, axis=1) for entry, rows in self._rows()}

    def deviation(self, draws: Array) -> Deviation:
        """The deviation of draws (p,), or of flights (flights, p)."""
        found = {}
        for entry, rows in self._rows():
            value = draws @ rows.T
            found[entry] = value if entry in SIZES else value[..., 0]
        return Deviation(found)

    def steps(self) -> list[tuple[Deviation, Deviation]]:
        """Deviations ahead and behind along each of the p numbers."""
        moves = STEP * np.eye(self.count)
        return [(self.deviation(move), self.deviation(-move)) for move in moves]

    def _rows(self) -> list[tuple[str, Array]]:
        first, found = 0, []
        for entry in self.entries:
            rows = self.factor[first : (first := first + SIZES.get(entry, 1))]
            if rows.any():
                found.append((entry, rows))
        return found

    def partials(
        self, forces: Callable[[Deviation], ForceModel], rotation: Rotation, *, turning: bool
    ) -> Partials:
        """Derivatives of the forces of deviations; `turning` says whether these depend on the spin."""
        still, spin = {POSITION, NORMAL, *SPIN}, {*POLE, *((PHASE, RATE) if turning else ())}
        columns = self._columns(lambda entry: entry not in still)
        turned = self._columns(lambda entry: entry in spin)
        steps = self.steps()
        pairs = [
            _without_shared_field(*(forces(one.without_spin) for one in steps[k])) for k in columns
        ]
        ahead, behind = (tuple(pair[side] for pair in pairs) for side in (0, 1))
        turns = [(one.rotation(rotation), other.rotation(rotation)) for one, other in steps]
        gravity = replace(forces(Deviation({})), srp=np.zeros(3), companion=None)
        own = tuple(turns[k] for k in turned)
        return Partials(ahead, behind, columns, own, turned, gravity, self.count)

    def _columns(self, acts: Callable[[str], bool]) -> Indices:
        """Numbers along which an entry deviates that acts."""
        found = np.zeros(self.count, dtype=bool)
        for entry, rows in self._rows():
            if acts(entry):
                found |= rows.any(axis=0)
        return np.flatnonzero(found)


def _without_shared_field(ahead: ForceModel, behind: ForceModel) -> tuple[ForceModel, ForceModel]:
    """Forces of the same difference, the first with the difference of a field that turns alike.

    Fields are linear in their strength, so that one evaluation, or none, serves for two.
    """
    one, other = ahead.field, behind.field
    if one is None or other is None or one.rotation is not other.rotation:
        return ahead, behind
    apart = one.strength - other.strength
    field = replace(one, strength=apart) if apart else None
    return replace(ahead, field=field), replace(behind, field=None)


def region_motions(
    uncertain: Uncertain, site: Site, rotation: Rotation, times_s: Array, length_m: float
) -> dict[str, Motion]:
    """Motion of the observation's limits, by what they measure, at times (n,); nondimensional.

    Distances move with the site alone. The axis of emission turns with its normal, and that of phase,
    which points to the Sun, does not.
    """
    at = track(site, rotation, times_s)
    shift, turn = np.zeros((2, len(times_s), 3, uncertain.count))
    for k, sides in enumerate(uncertain.steps()):
        ahead, behind = (track(one.site(site), one.rotation(rotation), times_s) for one in sides)
        shift[:, :, k] = (ahead.position - behind.position) / (2.0 * STEP * length_m)
        turn[:, :, k] = np.cross(at.normal, ahead.normal - behind.normal) / (2.0 * STEP)
    if not (shift.any() or turn.any()):
        return {}
    apex, still = at.position / length_m, np.zeros_like(turn)
    plain = Motion(apex, shift, still)
    return {"distance": plain, "phase": plain, "emission": Motion(apex, shift, turn)}


def companion_motion(
    uncertain: Uncertain, companion: Companion, times_s: Array, length_m: float
) -> Motion | None:
    """Motion of the ball about the companion with its phase, at times (n,); nondimensional."""
    if COMPANION_PHASE not in uncertain.sigmas:
        return None
    shift = np.zeros((len(times_s), 3, uncertain.count))
    for k, sides in enumerate(uncertain.steps()):
        ahead, behind = (one.companion(companion).position(times_s) for one in sides)
        shift[:, :, k] = (ahead - behind) / (2.0 * STEP * length_m)
    return Motion(companion.position(times_s) / length_m, shift, np.zeros_like(shift))


def check_knowledge(scenario: Scenario) -> None:
    """Refuse sigmas of what the scenario does not have, or that reach values that are not physical.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    body, craft = scenario.body, scenario.spacecraft
    sigmas = Uncertain.of(scenario).sigmas
    if body.companion is None and (own := [e for e in sigmas if ".companion." in e]):
        _refuse(own[0], sigmas, "needs body.companion, which the scenario does not have")
    if body.attitude is not None and (own := [e for e in (J2, *SPIN) if e in sigmas]):
        _refuse(own[0], sigmas, "goes with a body that turns evenly, not with body.attitude")
    positive = {
        GM: body.gm_m3_s2,
        COMPANION_GM: body.companion.gm_m3_s2 if body.companion else 0.0,
        AREA: craft.srp_area_m2,
        REFLECTIVITY: craft.reflectivity_coefficient,
        POSITION: float(np.linalg.norm(scenario.site.position_body_m)),
    }
    for entry, sigma in sigmas.items():
        most = float(np.max(sigma))
        if entry in positive and FAR * most >= positive[entry]:
            least = f"must be below {positive[entry] / FAR:g}: {FAR:g} sigma reach zero"
            _refuse(entry, sigmas, least)
        if entry == J2 and abs(body.j2) + FAR * most > 1.0:
            _refuse(entry, sigmas, f"must be at most {(1.0 - abs(body.j2)) / FAR:g}: |J2| <= 1")
        if entry == NORMAL and most > TILT_MAX:
            _refuse(entry, sigmas, f"must be at most {TILT_MAX:g}, about 6 deg")
        if entry in (*POLE, PHASE, COMPANION_PHASE) and most > TURN_MAX_DEG:
            _refuse(entry, sigmas, f"must be at most {TURN_MAX_DEG:g} deg")
    if POLE[1] in sigmas and abs(body.pole_dec_deg) + FAR * sigmas[POLE[1]][0] > 90.0:
        room = (90.0 - abs(body.pole_dec_deg)) / FAR
        _refuse(POLE[1], sigmas, f"must be at most {room:g} deg: {FAR:g} sigma pass J2000's pole")
    turned = float(sigmas[RATE][0]) * scenario.duration_s / DAY_S if RATE in sigmas else 0.0
    if turned > TURN_MAX_DEG:
        most = TURN_MAX_DEG * DAY_S / scenario.duration_s
        _refuse(RATE, sigmas, f"must be at most {most:.3g}: {TURN_MAX_DEG:g} deg in the flight")


def _refuse(entry: str, sigmas: Mapping[str, Array], needs: str) -> None:
    given = ", ".join(exact(one) for one in sigmas[entry])
    raise InputError(f"knowledge.{entry}", given, needs)


def in_words(scenario: Scenario) -> str:
    """1 sigma of each uncertain entry, with its share of the entry where that says something."""
    body, craft = scenario.body, scenario.spacecraft
    values = {GM: body.gm_m3_s2, J2: body.j2, RATE: body.prime_meridian_rate_deg_day}
    values |= {AREA: craft.srp_area_m2, REFLECTIVITY: craft.reflectivity_coefficient}
    if body.companion is not None:
        values[COMPANION_GM] = body.companion.gm_m3_s2
    parts = []
    for entry, sigma in Uncertain.of(scenario).sigmas.items():
        words = f"{entry} {', '.join(f'{exact(one)}' for one in sigma)}"
        if value := values.get(entry):
            words += f" ({100.0 * float(sigma[0]) / abs(value):.3g} %)"
        parts.append(words)
    return "; ".join(parts)
