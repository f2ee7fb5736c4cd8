"""Choose the burns that feedback corrects, and the cut-offs at which states are measured.

With pictures of landmarks, state, uncertain parameters and errors of the map are estimated together
along a path, from all pictures so far, with what was known before the flight and the execution errors
of the planned burns. Errors of the map, which all pictures share, thus never average out. A plan's
filter has one measurement of the state at each cut-off instead. Its errors are independent of all
others, and such that the error of the estimated state has the covariance of that estimation.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, solve_triangular

from formulations.arrays import Array
from scp_recon.display import exact
from scp_recon.errors import InputError
from scp_recon.mission.knowledge import Uncertain
from scp_recon.mission.scene import Scene, execution_errors
from scp_recon.mission.schedule import SAME_S
from scp_recon.physics.frames import unit
from scp_recon.scenario.body import Body
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.schema import Scenario
from scp_recon.scenario.uncertainty import Contacts

USELESS = 1e3
"""Errors of a measurement over what a flight strays at most, from which on nothing is corrected: a
measurement takes a millionth off a variance, and what that saves is less than plans are accurate to."""


def felt_cut_offs_s(scene: Scene, window_s: tuple[float, float]) -> dict[int, float]:
    """`cut_offs_s` of the burns that affect the window, or limits at the end.

    There are none if the measurements are `in_vain`.

    A correction after the window could only compensate for earlier corrections in the 99 % quantile
    of the sum. That saves one to four per cent of the cost and takes three times as long, so it is
    done only with a limit at the end, however loose. If no cut-off is before the window's end, all
    cut-offs of a whole flight count; in flight none.

    Raises:
        InputError: if several burns are corrected and all burns share an error.
    """
    scenario = scene.scenario
    found, boundary = cut_offs_s(scenario), scenario.boundary
    if found and in_vain(scene) >= USELESS:
        return {}
    limits = boundary.final_sigma_position_m, boundary.final_sigma_velocity_m_s
    if limits == (None, None):
        times = scenario.burn_times_s
        felt = {burn: at for burn, at in found.items() if times[burn] < window_s[1]}
        found = felt if felt or scenario.in_flight is not None else found
    gates = scenario.uncertainty.gates
    if gates is not None and gates.magnitude_bias > 0.0 and len(found) > 1:
        burns = ", ".join(str(burn + 1) for burn in found)
        raise InputError(
            "uncertainty.gates.magnitude_bias",
            f"{gates.magnitude_bias:g} with corrected burns {burns}",
            "must be 0 where several burns are corrected, whose filter does not estimate it: add it to "
            "magnitude_proportional",
        )
    return found


def cut_offs_s(scenario: Scenario) -> dict[int, float]:
    """Cut-off of each corrected burn, s, by its number from 0 among the burns to be planned.

    A burn is corrected if its cut-off is at the epoch or later, or in flight later than the
    delivered state, which contains all earlier knowledge. The first burn of the whole flight is
    never corrected. The last one is corrected only if `boundary.final_sigma_velocity_m_s` limits
    its result: its correction affects nothing else. There are no cut-offs with the policy "open".
    With contacts or pictures, a burn without data that are newer than those of a corrected burn before
    is not corrected.
    """
    navigation = scenario.navigation
    seldom = navigation.contacts is not None or navigation.landmarks is not None
    start, found = scenario.start_s, dict[int, float]()
    earliest = start + (-SAME_S if scenario.in_flight is None else SAME_S)
    for burn, time in _correctable(scenario).items():
        until = data_until_s(scenario, burn, time)
        if until >= earliest:
            found[burn] = max(until, start)
            earliest = until + SAME_S if seldom else earliest
    return found


def data_until_s(scenario: Scenario, burn: int, time_s: float) -> float:
    """Time of the last data that a burn at a time can use, s."""
    contact, landmarks = contact_of(scenario, burn), scenario.navigation.landmarks
    until = time_s - scenario.navigation.lead_s if contact is None else contact[0]
    return until if landmarks is None else landmarks.last_by(until)


def contact_of(scenario: Scenario, burn: int) -> tuple[float, float] | None:
    """The contact whose data a burn uses, by its number from 0, s; None if it uses data on board.

    Infinitely early if there is none in time.
    """
    contacts = scenario.navigation.contacts
    if contacts is None or 1 + burn + scenario.burns_flown in (contacts.onboard or ()):
        return None
    return contacts.last_before(scenario.burn_times_s[burn]) or (-np.inf, -np.inf)


def moves_along(scenario: Scenario, burn: int) -> bool:
    """Whether a burn's cut-off moves with the burn: data of contacts and pictures have their times."""
    return contact_of(scenario, burn) is None and scenario.navigation.landmarks is None


def known_from_s(scenario: Scenario, burn: int, cut_off_s: float) -> float:
    """Time from which on a burn can use the data of its contact or pictures, s."""
    contact, navigation = contact_of(scenario, burn), scenario.navigation
    if contact is None or navigation.contacts is None:
        return cut_off_s + navigation.lead_s
    return contact[1] + navigation.contacts.turnaround_s


def in_vain(scene: Scene) -> float:
    """Least ratio of the measurements' errors to the largest deviation until the last cut-off.

    The ratio is infinite for a flight without deviations, else 0 for pictures, which tell more or less
    along different paths.
    """
    if scene.scenario.navigation.landmarks is not None:
        return 0.0 if _strays(scene).any() else np.inf
    by_measurement = np.linalg.solve(scene.measurement_factor, np.diag(_strays(scene)))
    known = float(np.linalg.norm(by_measurement, 2))
    return 1.0 / known if known > 0.0 else np.inf


def _strays(scene: Scene) -> Array:
    """Largest deviation of a flight until the last cut-off, m and m/s, shape (6,).

    On straight lines, from the initial errors and those of the largest burns before.
    """
    scenario = scene.scenario
    first, last = scenario.start_s, max(cut_offs_s(scenario).values())
    largest = np.array([[scenario.burns.dv_max_m_s, 0.0, 0.0]])
    of_burn = float(np.linalg.norm(execution_errors(scenario).columns(largest)))
    burns = sum(time < last for time in scenario.burn_times_s)
    sigma = np.linalg.norm(scene.initial_factor(scene.initial_state), axis=1)
    speed = np.hypot(np.linalg.norm(sigma[3:]), np.sqrt(burns) * of_burn)
    position = np.hypot(np.linalg.norm(sigma[:3]), speed * (last - first))
    return np.repeat([position, speed], 3)


def _correctable(scenario: Scenario) -> dict[int, float]:
    """Times of the burns that could be corrected with any lead, s, by number."""
    if scenario.policy.kind == "open":
        return {}
    times = dict(enumerate(scenario.burn_times_s))
    if scenario.in_flight is None:
        times.pop(0)
    if scenario.boundary.final_sigma_velocity_m_s is None:
        times.pop(len(scenario.burn_times_s) - 1, None)
    return times


def check_feedback(scenario: Scenario) -> None:
    """Refuse feedback without measurements, or without a burn to correct in a whole flight.

    In flight there may be no burn left to correct.

    Raises:
        InputError: naming the entry, what was given and what is allowed.
    """
    if scenario.policy.kind == "open":
        return
    require_measurement(scenario, "policy.kind", "'feedback'")
    if scenario.in_flight is not None:
        return
    correctable = _correctable(scenario)
    if not correctable:
        raise InputError(
            "policy.kind",
            "'feedback' with no burn between the first and the last",
            "must be 'open', or boundary.final_sigma_velocity_m_s must limit what the last burn leaves",
        )
    contacts, latest = scenario.navigation.contacts, max(correctable.values())
    last = scenario.burns.times_s.index(latest) + 1
    if contacts is None and not cut_offs_s(scenario):
        raise InputError(
            "navigation.lead_s",
            f"{exact(scenario.navigation.lead_s)} s, with which every cut-off precedes departure",
            f"must be at most {latest:g} s, for burn {last} to be corrected",
        )
    if contacts is not None:
        _check_contacts(scenario, contacts, latest)


def _check_contacts(scenario: Scenario, contacts: Contacts, latest_s: float) -> None:
    """Refuse contacts that serve no burn until the latest, and burns on board that there are not."""
    burns, table = len(scenario.burns.times_s), "navigation.contacts"
    if strange := [number for number in contacts.onboard or () if number > burns]:
        raise InputError(f"{table}.onboard", f"{strange[0]}", f"must be among 1 to {burns}")
    if cut_offs_s(scenario):
        return
    wait, most = exact(contacts.turnaround_s), latest_s - scenario.start_s
    if contacts.turnaround_s > most:
        needs = f"must be at most {most:g} s, for a burn to use a contact"
        raise InputError(f"{table}.turnaround_s", f"{wait} s", needs)
    raise InputError(
        f"{table}.{'every_s' if contacts.windows_s is None else 'windows_s'}",
        f"no contact that a burn can use, {wait} s after its end",
        f"must have one that begins at {scenario.start_s:g} s or later and ends by "
        f"{latest_s - contacts.turnaround_s:g} s",
    )


def require_measurement(scenario: Scenario, entry: str, policy: str) -> None:
    """Refuse a policy that needs measurements if the scenario has none.

    Raises:
        InputError: naming the entry, or option, that chose the policy.
    """
    if not scenario.navigation.measures:
        raise InputError(
            entry,
            f"{policy} without a measurement",
            "must be 'open', or [navigation] must have sigma_position_m with sigma_velocity_m_s, "
            "covariance, or landmarks",
        )


def uncorrected_burns(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of burns that feedback would correct if their cut-off did not precede departure.

    In flight there are none: the delivered state contains all earlier knowledge.
    """
    scenario = scene.scenario
    if scenario.in_flight is not None:
        return
    corrected, navigation = cut_offs_s(scenario), scenario.navigation
    for burn, time in _correctable(scenario).items():
        if burn in corrected:
            continue
        entry, given = "navigation.lead_s", f"{exact(navigation.lead_s)} s, so that"
        why, expected = ": its cut-off precedes departure", f"at most {time - scenario.start_s:g} s"
        if contact_of(scenario, burn) is not None:
            entry, given, why = "navigation.contacts", "no contact with new data:", ""
            expected = "one after that of the burn before, a turnaround before the burn"
        elif (landmarks := navigation.landmarks) is not None:
            entry, given, why = "navigation.landmarks", "no new picture:", ""
            expected = f"every_s of less than {landmarks.every_s:g} s, or less navigation.lead_s"
        given = f"{given} burn {burn + 1} at {time:g} s is not corrected{why}"
        yield ScenarioWarning.of(entry, given, f"expected {expected}")


def useless_measurement(scene: Scene) -> Iterator[ScenarioWarning]:
    """Warn of measurements so inaccurate that no burn is corrected."""
    if not cut_offs_s(scene.scenario):
        return
    errors = in_vain(scene)
    if errors >= USELESS:
        named = scene.scenario.navigation.covariance is None
        compared = f"whose errors are {float(f'{errors:.1g}'):,.0f} times what a flight may stray"
        if np.isinf(errors):
            compared = "of flights that stray by nothing"
        yield ScenarioWarning.of(
            "navigation.sigma_position_m" if named else "navigation.covariance",
            f"measurements {compared}, so that they are useless and no burn is corrected",
            f"expected errors of less than {USELESS:,.0f} times that",
        )


# --- pictures of landmarks --------------------------------------------------------------------------

LEAST = 1e-6
"""Error below which nothing is learnt, over the root mean square of those of position, or velocity."""

GOLDEN_RAD = np.pi * (3.0 - np.sqrt(5.0))


def picture_times_s(scenario: Scenario, until_s: float) -> Array:
    """Times of the pictures up to a time, s; in flight of those after the delivered state."""
    given = scenario.navigation.landmarks
    assert given is not None
    times = given.every_s * np.arange(round(given.last_by(until_s) / given.every_s) + 1)
    after = -np.inf if scenario.in_flight is None else scenario.start_s
    return np.asarray(times[times > after])


def landmarks_m(scenario: Scenario) -> Array:
    """Landmarks, body-fixed, m: directions of a Fibonacci lattice on the ellipsoid, shape (l, 3)."""
    given, body = scenario.navigation.landmarks, scenario.body
    assert given is not None
    count = 2 * given.number
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    across, turn = np.sqrt(1.0 - z * z), GOLDEN_RAD * np.arange(count)
    spread = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    return np.asarray(_radii_m(body) * spread)


def _radii_m(body: Body) -> Array:
    return np.array(body.radii_m or (body.reference_radius_m,) * 3)


def _picture(scene: Scene, uncertain: Uncertain, time_s: float, position_m: Array) -> Array:
    """Derivatives of a picture's pixels by state, parameters and map, shape (2 v, 6 + p + 3 l).

    They are of the v landmarks that are lit, visible and in the field, seen from a position (3,).
    """
    given, rotation, fixed = (
        scene.scenario.navigation.landmarks,
        scene.rotation,
        landmarks_m(scene.scenario),
    )
    assert given is not None
    turn, p = rotation.body_to_j2000(time_s), uncertain.count
    places, up = fixed @ turn.T, unit(fixed / _radii_m(scene.scenario.body) ** 2) @ turn.T
    axis, half = -unit(position_m), np.deg2rad(0.5 * given.field_of_view_deg)
    line = places - position_m
    depth, focal = line @ axis, 0.5 * given.pixels / np.tan(half)
    seen = np.einsum("li,li->l", up, line) < 0.0
    seen &= (up @ scene.sun_direction(time_s) > 0.0) & (
        depth > np.cos(half) * np.linalg.norm(line, axis=1)
    )
    who, line, depth = np.flatnonzero(seen), line[seen], depth[seen, None, None]
    across = np.linalg.svd(axis[None])[2][1:]
    by_line = focal * (across - (line @ across.T)[:, :, None] * axis / depth) / depth
    found = np.zeros((len(who), 2, 6 + p + 3 * len(places)))
    found[:, :, :3] = -by_line
    if p:
        own = fixed[who]
        moved = uncertain.slopes(lambda one: own @ one.rotation(rotation).body_to_j2000(time_s).T)
        found[:, :, 6 : 6 + p] = np.einsum("vij,vjk->vik", by_line, moved)
    for i, landmark in enumerate(who.tolist()):
        first = 6 + p + 3 * landmark
        found[i, :, first : first + 3] = by_line[i] @ turn
    return found.reshape(-1, found.shape[2])


def measurement_factors(
    scene: Scene,
    uncertain: Uncertain,
    path: tuple[Array, Array, Array],
    executed: Array | None,
    prior: Array,
    cut_offs_s: Iterable[float],
) -> Array:
    """Factors N of the covariances N N' of states measured at cut-offs, m and m/s, shape (k, 6, 6).

    With P of the estimation and P- of the filter that has the measurements before,
    (N N')^-1 = P^-1 - (P-)^-1; an error is at most `USELESS` times what is known without it. Parameters
    are learnt by the state alone.

    Args:
        scene: with the body, its rotation, the Sun and the camera.
        uncertain: its p parameters, some of which turn the body.
        path: J2000, m and m/s: times of the nodes (n,), with all pictures and cut-offs among them;
            positions there (n, 3); STMs of state and parameters to each from the one before
            (n, 6 + p, 6 + p).
        executed: covariance of the velocity that a burn adds at each node, shape (n, 3, 3); None for a
            coast, which is no plan.
        prior: covariance of state and parameters at the first node, shape (6 + p, 6 + p).
        cut_offs_s: in order.

    Raises:
        InputError: if no picture before a cut-off shows a landmark, along planned burns.
    """
    given, size, own = scene.scenario.navigation.landmarks, len(prior), prior.copy()
    assert given is not None
    landmarks = 2 * given.number
    whole = block_diag(prior, given.map_error_m**2 * np.eye(3 * landmarks))
    times, cut_offs, found, shown = path[0], list(cut_offs_s), list[Array](), 0
    pictures = picture_times_s(scene.scenario, times[-1])
    for k, (time, position, stm) in enumerate(zip(*path, strict=True)):
        own = stm @ own @ stm.T
        whole[:size] = stm @ whole[:size]
        whole[:, :size] = whole[:, :size] @ stm.T
        if time in pictures:
            seen = _picture(scene, uncertain, time, position)
            whole = _updated(whole, seen, given.pixel_error**2 * np.eye(len(seen)))
            shown += len(seen)
        if time in cut_offs:
            if not shown and executed is not None:
                raise InputError(
                    "navigation.landmarks",
                    f"no landmark that is lit, visible and in the field until {time:g} s",
                    "must have one before each cut-off: mind field_of_view_deg, number and every_s",
                )
            found.append(_factor(own[:6, :6], whole[:6, :6]))
            own = _updated(own, np.eye(6, size), found[-1] @ found[-1].T)
        if executed is not None:
            own[3:6, 3:6] += executed[k]
            whole[3:6, 3:6] += executed[k]
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
