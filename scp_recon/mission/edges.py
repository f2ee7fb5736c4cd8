"""Move the edges of an observation window with what is not known of the body's spin and the site."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from formulations.arrays import Array
from scp_recon.mission.knowledge import FAR
from scp_recon.mission.windows import OfTime, Window

EDGE_MOVES_S, EDGE_PARTS = 0.1, 25
"""1 sigma up to which an edge of the window stays; and times within 3 sigma of it at which flights are
sampled: a flight's own edge is then missed by an eighth of a sigma at most."""
NEWTON_STEPS = 5
"""To the edge of another flight's window: from 300 s away it is then within 1e-6 s."""


def moved_edges(slack: OfTime, window: Window) -> Array:
    """Edges of a window in flights with a lighting of their own, s, shape (2, flights).

    Newton's steps from the edges of the mean, at most half the window's length away: farther edges are
    no longer its own. Times of `slack` are one a flight.
    """
    half, found = 0.5 * (window[1] - window[0]), []
    for edge in window:
        time = np.full(np.shape(slack(np.array(edge))) or (1,), edge)
        for _ in range(NEWTON_STEPS):
            here = slack(time)
            slope = slack(time + 1.0) - here
            step = np.divide(-here, slope, out=np.zeros_like(here), where=slope != 0.0)
            time = np.clip(time + step, edge - half, edge + half)
        found.append(time)
    return np.array(found)


def edge_sigmas_s(by_parameters: Array) -> Array | None:
    """1 sigma of the edges from their derivatives, shape (2, p), by standard normal parameters, s.

    Shape (2,); None where both stay.
    """
    sigmas = np.linalg.norm(by_parameters, axis=1)
    return np.asarray(sigmas) if sigmas.max() > EDGE_MOVES_S else None


@dataclass(frozen=True, eq=False)
class WindowEdges:
    """Edges of the observation window, and when flights observe.

    Attributes:
        window_s: from the first node on; None if it is over, or observation is not required.
        sigmas_s: 1 sigma of the edges, shape (2,); None where they stay.
        flight_s: first and last node.
    """

    window_s: Window | None
    sigmas_s: Array | None
    flight_s: Window

    @property
    def watched_s(self) -> Window | None:
        """When flights' limits of the observation may count: the window, and 3 sigma of its edges."""
        if self.window_s is None or self.sigmas_s is None:
            return self.window_s
        (first, last), (early, late) = self.window_s, FAR * self.sigmas_s
        return max(first - early, self.flight_s[0]), min(last + late, self.flight_s[1])

    @property
    def samples_s(self) -> Array:
        """Times about the edges where those of flights are mostly, s; none where they stay."""
        if self.window_s is None or self.sigmas_s is None:
            return np.zeros(0)
        pairs = zip(self.window_s, FAR * self.sigmas_s, strict=True)
        times = np.concatenate([np.linspace(at - far, at + far, EDGE_PARTS) for at, far in pairs])
        return times[(times > self.flight_s[0]) & (times < self.flight_s[1])]
