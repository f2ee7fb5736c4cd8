"""Uncertain parameters of body, site and spacecraft: their law, and what a deviation of them changes.

A deviation acts on the forces, on the site as it turns with the body, and on the companion's place.
Derivatives by the parameters are central differences over the forces, rotations and regions of two
deviations, so that each parameter acts on plans exactly where it acts on flights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from formulations.arrays import Array, Indices
from formulations.linearisation.factor import factor_of
from formulations.problem.regions import Motion
from scp_recon.bodies.catalogue import DAY_S
from scp_recon.display import exact
from scp_recon.errors import InputError
from scp_recon.physics.forces import STEP, ForceModel, Partials
from scp_recon.physics.frames import Rotation, unit
from scp_recon.physics.geometry import Site, SiteTrack, track
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

    def slopes(self, of: Callable[[Deviation], Array], unit: float = 1.0) -> Array:
        """Derivatives of a function of deviations by the p > 0 numbers, in a unit, shape (..., p)."""
        ends = [(of(ahead), of(behind)) for ahead, behind in self.steps()]
        return np.stack([(one - other) / (2.0 * STEP * unit) for one, other in ends], axis=-1)

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
        columns, turned = self._columns({*self.entries} - still), self._columns(spin)
        steps = self.steps()
        pairs = []
        for k in columns:
            held = [{e: v for e, v in one.values.items() if e not in SPIN} for one in steps[k]]
            pairs.append(_without_shared_field(*(forces(Deviation(values)) for values in held)))
        ahead, behind = (tuple(pair[side] for pair in pairs) for side in (0, 1))
        turns = [(one.rotation(rotation), other.rotation(rotation)) for one, other in steps]
        gravity = replace(forces(Deviation({})), srp=np.zeros(3), companion=None)
        own = tuple(turns[k] for k in turned)
        return Partials(ahead, behind, columns, own, turned, gravity, self.count)

    def _columns(self, entries: set[str]) -> Indices:
        """Numbers along which any of some entries deviates."""
        acting = [rows.any(axis=0) for entry, rows in self._rows() if entry in entries]
        return np.flatnonzero(np.any(acting, axis=0))


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
    if not uncertain.count:
        return {}
    at = track(site, rotation, times_s)

    def moved(deviation: Deviation) -> SiteTrack:
        return track(deviation.site(site), deviation.rotation(rotation), times_s)

    shift = uncertain.slopes(lambda deviation: moved(deviation).position, length_m)
    tilt = uncertain.slopes(lambda deviation: moved(deviation).normal)
    if not (shift.any() or tilt.any()):
        return {}
    turn = np.cross(at.normal[..., None], tilt, axis=1)
    apex, still = at.position / length_m, np.zeros_like(turn)
    plain = Motion(apex, shift, still)
    return {"distance": plain, "phase": plain, "emission": Motion(apex, shift, turn)}


def companion_motion(
    uncertain: Uncertain, companion: Companion, times_s: Array, length_m: float
) -> Motion | None:
    """Motion of the ball about the companion with its phase, at times (n,); nondimensional."""
    if COMPANION_PHASE not in uncertain.sigmas:
        return None
    shift = uncertain.slopes(lambda one: one.companion(companion).position(times_s), length_m)
    return Motion(companion.position(times_s) / length_m, shift, np.zeros_like(shift))


def check_knowledge(scenario: Scenario) -> None:
    """Refuse sigmas of what the scenario does not have, or that reach values that are not physical.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    body, sigmas = scenario.body, Uncertain.of(scenario).sigmas
    if body.companion is None and (own := [e for e in sigmas if ".companion." in e]):
        _refuse(own[0], sigmas, "needs body.companion, which the scenario does not have")
    if body.attitude is not None and (own := [e for e in (J2, *SPIN) if e in sigmas]):
        _refuse(own[0], sigmas, "goes with a body that turns evenly, not with body.attitude")
    above_zero = {GM, COMPANION_GM, AREA, REFLECTIVITY, POSITION} & sigmas.keys()
    values = {entry: np.linalg.norm(attrgetter(entry)(scenario)) for entry in above_zero}
    limits = [
        *((entry, value / FAR, f": {FAR:g} sigma reach zero") for entry, value in values.items()),
        (J2, (1.0 - abs(body.j2)) / FAR, ": |J2| <= 1"),
        (NORMAL, TILT_MAX, ", about 6 deg"),
        *((entry, TURN_MAX_DEG, " deg") for entry in (*POLE, PHASE, COMPANION_PHASE)),
        (POLE[1], (90.0 - abs(body.pole_dec_deg)) / FAR, f" deg: {FAR:g} sigma pass J2000's pole"),
        (RATE, TURN_MAX_DEG * DAY_S / scenario.duration_s, f": {TURN_MAX_DEG:g} deg in the flight"),
    ]
    for entry, most, why in limits:
        if entry in sigmas and sigmas[entry].max() > most:
            _refuse(entry, sigmas, f"must be at most {most:.6g}{why}")


def _refuse(entry: str, sigmas: Mapping[str, Array], needs: str) -> None:
    given = ", ".join(exact(one) for one in sigmas[entry])
    raise InputError(f"knowledge.{entry}", given, needs)


SHARED = (GM, J2, RATE, AREA, REFLECTIVITY, COMPANION_GM)
"""Entries of which a share says something."""


def in_words(scenario: Scenario) -> str:
    """1 sigma of each uncertain entry, with its share of the entry where that says something."""
    parts = []
    for entry, sigma in Uncertain.of(scenario).sigmas.items():
        words = f"{entry} {', '.join(map(exact, sigma))}"
        if entry in SHARED and (value := attrgetter(entry)(scenario)):
            words += f" ({100.0 * float(sigma[0]) / abs(value):.3g} %)"
        parts.append(words)
    return "; ".join(parts)
