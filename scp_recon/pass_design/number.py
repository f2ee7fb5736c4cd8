"""How many burns: passes with one more where it promises to help, and with one less.

Where errors shrink with the burns the primer tells where one more helps, and a burn that does not has
vanished. Errors that do not shrink leave no derivative that tells: then one more between any two, and
one less, is tried.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from scp_recon.pass_design.near import Found
from scp_recon.pass_design.rules import nearest_legal
from scp_recon.pass_design.setting import BURNS_MAX
from scp_recon.pass_design.space import Pass, Space
from scp_recon.planning.primer import WORTH, PrimerHistory, primer_history

Array = npt.NDArray[np.float64]

PLACES_MAX = 3
"""Peaks of the primer at which another burn is tried."""
VANISHED_M_S = 1e-6
"""Size of a burn that is none."""


@dataclass(frozen=True, eq=False)
class Other:
    """A pass with another number of burns, to begin with.

    Attributes:
        space: of such passes.
        at: where to begin.
        burns_m_s: at which its first plan begins, J2000, shape (m, 3).
    """

    space: Space
    at: Pass
    burns_m_s: Array


def vanished(space: Space, found: Found) -> Other | None:
    """The pass without inner burns that have vanished and their rules; None if all count."""
    there = np.linalg.norm(found.burns_m_s, axis=1) > VANISHED_M_S
    there[[0, -1]] = True
    return None if there.all() else _chosen(space, found, there)


def others(space: Space, found: Found) -> list[Other]:
    """Passes with one burn more, and where no primer tells also with one less."""
    history = primer_history(found.mission, found.stage)
    times = found.at.times_s
    if history is not None:
        places = peaks(history)
    else:
        places = [0.5 * (first + second) for first, second in itertools.pairwise(times)]
    room = space.n_burns < BURNS_MAX
    more = [_with(space, found, place) for place in places if room]
    fewer = [] if history is not None else list(_each_less(space, found))
    return [one for one in more if one is not None] + fewer


def peaks(history: PrimerHistory) -> list[float]:
    """Times at which the allowed part of the primer exceeds one and is largest near by, s.

    Where the others leave no room for a burn they have to give way.
    """
    size = np.r_[-np.inf, history.allowed, -np.inf]
    peak = (size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:]) & (size[1:-1] > 1.0 + WORTH)
    found = np.flatnonzero(peak)
    best = found[np.argsort(-history.allowed[found], kind="stable")][:PLACES_MAX]
    return [float(time) for time in history.times_s[best]]


def _with(space: Space, found: Found, time_s: float) -> Other | None:
    """The pass with a burn at a time, the others moved by as little as the rules ask."""
    times, spans = found.at.times_s, space.time_spans
    place = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
    inner = spans[1] if len(spans) > 2 else (spans[0][0], spans[-1][1])
    wanted = (*times[:place], time_s, *times[place:])
    wider = replace(space, time_spans=(*spans[:place], inner, *spans[place:]))
    rules = space.mission.scenario.schedule
    before = space.before(wanted)
    legal = nearest_legal(wanted, wider.time_spans, space.window_s, before, rules)
    if legal is None:
        return None
    burns = np.insert(found.burns_m_s, place, 0.0, axis=0)
    return Other(wider, Pass(found.at.phases, legal), burns)


def _each_less(space: Space, found: Found) -> Iterator[Other]:
    for gone in range(1, space.n_burns - 1):
        yield _chosen(space, found, np.arange(space.n_burns) != gone)


def _chosen(space: Space, found: Found, there: npt.NDArray[np.bool_]) -> Other:
    spans = tuple(itertools.compress(space.time_spans, there))
    times = tuple(itertools.compress(found.at.times_s, there))
    return Other(
        replace(space, time_spans=spans), Pass(found.at.phases, times), found.burns_m_s[there]
    )
