"""Legal burn times: against a linear program, and against what the schedule accepts."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import linprog

from scp_recon.errors import InputError
from scp_recon.mission.legal_burns import legal_additions, legal_burns, legal_shifts, legal_starts
from scp_recon.mission.schedule import make_schedule
from scp_recon.scenario.schema import ScheduleRules
from tests.scp_recon.support import mission_of

durations = st.floats(0.0, 3000.0)
rule_sets = st.builds(
    ScheduleRules, attitude_s=durations, heating_s=durations, recharge_s=durations
)
counts = st.integers(0, 3), st.integers(1, 3)


def by_linear_program(
    window: tuple[float, float], duration: float, before: int, rules: ScheduleRules, count: int
) -> list[tuple[float, float]] | None:
    """Least and largest time of each burn under the rules of section V.A, all burns variables."""
    sun = rules.attitude_s + rules.recharge_s
    cycle = sun + rules.attitude_s + rules.heating_s
    t = np.eye(count)
    rows = [t[i] - t[i + 1] for i in range(count - 1) if i != before]
    rows += [t[before], -t[before + 1]]
    bounds = [-cycle] * (count - 2) + [window[0] - rules.attitude_s - sun, -window[1] - cycle]
    whole = (t[-1] - t[0])[None]
    found = []
    for cost in t:
        ends = [
            linprog(sign * cost, np.array(rows), bounds, whole, [duration], bounds=(None, None))
            for sign in (1.0, -1.0)
        ]
        if any(end.status != 0 for end in ends):
            return None
        found.append((sum(cost * ends[0].x), sum(cost * ends[1].x)))
    return found


@given(
    window=st.tuples(st.floats(0.0, 4e4), st.floats(10.0, 2e4)),
    duration=st.floats(1e3, 1e5),
    before=counts[0],
    after=counts[1],
    rules=rule_sets,
)
def test_intervals_are_those_of_a_linear_program(
    window: tuple[float, float], duration: float, before: int, after: int, rules: ScheduleRules
) -> None:
    edges = window[0], window[0] + window[1]
    early, late = legal_starts(edges, duration, before, after, rules)
    assume(abs(early - late) > 1e-3)
    expected = by_linear_program(edges, duration, before, rules, before + after + 1)
    if early > late:
        assert expected is None
        return
    found = legal_burns(edges, duration, before, after, rules)
    np.testing.assert_allclose(found, expected, atol=1e-4)


RULES = ScheduleRules(attitude_s=1800.0, heating_s=1800.0, recharge_s=1200.0)


@given(
    gaps=st.lists(st.floats(6600.0, 20_000.0), min_size=1, max_size=4),
    window=st.tuples(st.floats(-1e5, 1e5), st.floats(100.0, 8000.0)),
    share=st.floats(0.001, 0.999),
)
def test_a_shift_within_its_interval_is_legal_and_one_beyond_is_not(
    gaps: list[float], window: tuple[float, float], share: float
) -> None:
    times = (0.0, *np.cumsum(gaps).tolist())
    edges = window[0], window[0] + window[1]
    shifts = legal_shifts(edges, times, RULES)
    assert len(shifts) == sum(gap >= window[1] + 11_400.0 for gap in gaps)
    for _, (low, high) in shifts:
        inside = low + share * (high - low)
        make_schedule(times, (edges[0] - inside, edges[1] - inside), RULES)
        for outside in (low - 1.0, high + 1.0):
            with pytest.raises(InputError):
                make_schedule(times, (edges[0] - outside, edges[1] - outside), RULES)


@given(
    gaps=st.lists(st.floats(6600.0, 30_000.0), min_size=1, max_size=4),
    length=st.floats(100.0, 8000.0),
    share=st.floats(0.0, 1.0),
    added=st.floats(0.0, 1.0),
)
def test_another_burn_is_legal_in_its_spans_and_nowhere_else(
    gaps: list[float], length: float, share: float, added: float
) -> None:
    """The oracle is the schedule itself, with the burn in it."""
    gaps[0] += length + 11_400.0 - 6600.0
    times = (0.0, *np.cumsum(gaps).tolist())
    opens = 4800.0 + share * (gaps[0] - length - 11_400.0)
    window = opens, opens + length
    make_schedule(times, window, RULES)
    time = added * times[-1]
    spans = legal_additions(times, window, RULES)
    assume(all(abs(time - edge) > 1.0 for span in spans for edge in span))
    assume(min(abs(time - other) for other in times) > 1.0)
    if any(first < time < last for first, last in spans):
        make_schedule(tuple(sorted((*times, time))), window, RULES)
    else:
        with pytest.raises(InputError):
            make_schedule(tuple(sorted((*times, time))), window, RULES)


# --- in the messages ----------------------------------------------------------------------------


def message(*overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        mission_of(*overrides)
    return str(caught.value)


@pytest.mark.parametrize(
    ("epoch", "fault"),
    [
        ("2020-01-21T20:33:17.184", "must contain a whole window"),
        ("2020-01-21T23:33:17.184", "is broken"),
    ],
)
def test_following_the_message_makes_the_flight_legal(epoch: str, fault: str) -> None:
    """By the shift that is told, where there is no window in the flight or it is too early."""
    burns = "burns.times_s=[0.0, 15500.0]"
    said = message(burns, f"epoch.tdb={epoch}")
    assert fault in said
    shifts = re.findall(r"epoch\.tdb moved by ([+-]\d+) to ([+-]\d+) s", said)
    low, high = min(shifts, key=lambda pair: abs(int(pair[0])))
    moved = np.datetime64(epoch) + np.timedelta64((int(low) + int(high)) // 2, "s")
    mission_of(burns, f"epoch.tdb={moved}")


ALWAYS = (
    "observation.incidence_max_deg=180",
    *("observation.local_solar_time_min_h=0", "observation.local_solar_time_max_h=24"),
)


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        (
            ["burns.times_s=[0.0, 8000.0, 12000.0]"],
            [
                "windows near it, in seconds past epoch.tdb:",
                "13140.2 to 16537.5 s: no gap between burns is long enough",
                "14797 s",
            ],
        ),
        (ALWAYS, ["give observation.window_s"]),
        (["observation.incidence_max_deg=10"], ["10 deg", "34842", "least incidence is 48.9 deg"]),
    ],
)
def test_a_flight_without_a_whole_window_is_told_what_there_is(
    overrides: list[str], told: list[str]
) -> None:
    said = message(*overrides)
    assert said.startswith("observation: got incidence at most")
    assert all(words in said for words in told)
