"""Choose the burns that feedback corrects, and the cut-offs at which states are measured."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from formulations.arrays import Array
from scp_recon.display import exact
from scp_recon.errors import InputError
from scp_recon.mission.scene import Scene, execution_errors
from scp_recon.mission.schedule import SAME_S
from scp_recon.scenario.fields import ScenarioWarning
from scp_recon.scenario.schema import Scenario

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
    _check_bias(scenario, list(found))
    return found


def _check_bias(scenario: Scenario, corrected: list[int]) -> None:
    """Refuse an error that all burns share where several are corrected: no filter estimates it."""
    gates = scenario.uncertainty.gates
    if gates is not None and gates.magnitude_bias > 0.0 and len(corrected) > 1:
        burns = ", ".join(str(burn + 1) for burn in corrected)
        raise InputError(
            "uncertainty.gates.magnitude_bias",
            f"{gates.magnitude_bias:g} with corrected burns {burns}",
            "must be 0 where several burns are corrected, whose filter does not estimate it: add it to "
            "magnitude_proportional",
        )


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
    _check_contacts(scenario)
    if not cut_offs_s(scenario):
        latest = max(correctable)
        raise InputError(
            "navigation.lead_s",
            f"{exact(scenario.navigation.lead_s)} s, with which every cut-off precedes departure",
            f"must be at most {correctable[latest]:g} s, for burn {latest + 1} to be corrected",
        )


def _check_contacts(scenario: Scenario) -> None:
    """Refuse contacts that serve no burn, and burns on board that there are not."""
    contacts = scenario.navigation.contacts
    if contacts is None:
        return
    times = scenario.burns.times_s
    if strange := [number for number in contacts.onboard or () if number > len(times)]:
        allowed = f"must be among 1 to {len(times)}"
        raise InputError("navigation.contacts.onboard", f"{strange[0]}", allowed)
    if not cut_offs_s(scenario):
        latest = max(_correctable(scenario).values())
        if contacts.turnaround_s > latest - scenario.start_s:
            needs = f"must be at most {latest - scenario.start_s:g} s, for a burn to use a contact"
            raise InputError(
                "navigation.contacts.turnaround_s", f"{exact(contacts.turnaround_s)} s", needs
            )
        given = "every_s" if contacts.windows_s is None else "windows_s"
        raise InputError(
            f"navigation.contacts.{given}",
            f"no contact that a burn can use, {exact(contacts.turnaround_s)} s after its end",
            f"must have one that begins at {scenario.start_s:g} s or later and ends by "
            f"{latest - contacts.turnaround_s:g} s",
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
    corrected = cut_offs_s(scenario)
    for burn, time in _correctable(scenario).items():
        if burn not in corrected and contact_of(scenario, burn) is not None:
            yield ScenarioWarning.of(
                "navigation.contacts",
                f"no contact with new data for burn {burn + 1} at {time:g} s, which is not corrected",
                "expected one after that of the burn before, a turnaround before the burn",
            )
        elif burn not in corrected and (landmarks := scenario.navigation.landmarks):
            yield ScenarioWarning.of(
                "navigation.landmarks",
                f"no new picture for burn {burn + 1} at {time:g} s, which is not corrected",
                f"expected every_s of less than {landmarks.every_s:g} s, or less navigation.lead_s",
            )
        elif burn not in corrected:
            yield ScenarioWarning.of(
                "navigation.lead_s",
                f"{exact(scenario.navigation.lead_s)} s, so that burn {burn + 1} at {time:g} s is not "
                "corrected: its cut-off precedes departure",
                f"expected at most {time - scenario.start_s:g} s",
            )


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
