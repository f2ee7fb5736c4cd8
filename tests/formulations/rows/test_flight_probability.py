"""Probabilities of whole flights: against nodes, Boole, plain Monte Carlo, and differences."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri

from formulations.arrays import Array
from formulations.problem.regions import Ball, Cone
from formulations.risk.lines import Chords, Segments, kept_segments, sphere_directions
from formulations.rows.flight_probability import PROBABILITY_MAX, FlightProbability, Limits
from formulations.rows.node_probability import Event, node_quantiles
from tests.helpers import random_unit, share_of_examples

LINES = 4096
few = settings(max_examples=share_of_examples(6))
seeds = st.integers(0, 2**32 - 1)


class Flight(NamedTuple):
    """Positions (n, 3) and factors (n, 3, d) of a flight, and what it has to keep."""

    mean: Array
    factor: Array
    events: tuple[Event, ...]


def some_flight(seed: int, outside: float | None = None, dimension: int = 9) -> Flight:
    """Through a shell and past a cone; its errors grow. One node may be so far outside the shell."""
    rng = np.random.default_rng(seed)
    n = 8
    t = np.linspace(-1.0, 1.0, n)[:, None]
    along, up = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    mean = 0.5 * t * along + 1.05 * up
    growth = np.linspace(0.3, 1.0, n)[:, None, None]
    turn = rng.normal(size=(3, dimension)) + 0.5 * t[:, None] * rng.normal(size=(3, dimension))
    factor = 0.05 * growth * turn / np.sqrt(dimension)
    late = np.arange(3, n)
    centre = np.zeros((n, 3))
    if outside is not None:
        mean[4] *= (1.4 + outside) / np.linalg.norm(mean[4])
    shell = Event("shell", np.arange(n), (Ball(centre, 1.4),), (Ball(centre, 0.98),))
    apex = np.zeros((len(late), 3))
    axis = np.broadcast_to(up, (len(late), 3))
    cones = Event("cones", late, (Cone(apex, axis, 0.6),), ())
    return Flight(mean, factor, (shell, cones))


def of_flight(flight: Flight, lines: int = LINES, reach: float = 6.0) -> FlightProbability:
    directions = sphere_directions(lines, flight.factor.shape[2])
    return FlightProbability(flight.events, directions, reach)


def probability(flight: Flight, lines: int = LINES) -> float:
    return float(ndtr(of_flight(flight, lines)(flight.mean, flight.factor).value))


SAMPLES = 40_000


def sampled(flight: Flight, count: int = SAMPLES) -> float:
    """Share of plain random flights of the linear law that keep everything everywhere."""
    w = np.random.default_rng(5).normal(size=(count, flight.factor.shape[2]))
    kept = np.ones(count, dtype=np.bool_)
    for event in flight.events:
        for k, node in enumerate(event.nodes):
            points = flight.mean[node] + w @ flight.factor[node].T
            everyone = np.full(count, k)
            for region in event.keep_in:
                kept &= region.at(everyone).inside(points) > 0.0
            for region in event.keep_out:
                kept &= region.at(everyone).inside(points) < 0.0
    return float(kept.mean())


@given(seeds, st.sampled_from([None, 0.0, 0.01]))
@settings(max_examples=share_of_examples(12))
def test_plain_monte_carlo_agrees(seed, outside):
    """Also where the mean of a node is outside a limit, so that flights come in and leave again."""
    flight = some_flight(seed, outside)
    share, found = sampled(flight), probability(flight)
    deviation = np.sqrt(max(share * (1.0 - share), 1e-4) / SAMPLES)
    assert found == pytest.approx(share, abs=4.0 * deviation + 1e-3)


@given(seeds)
@settings(max_examples=share_of_examples(6))
def test_flights_failing_on_lines_are_all_failures(seed):
    mean, factor, _ = flight = some_flight(seed, 0.0)
    found = of_flight(flight, 512)
    weight = found.directions.weight / 512
    assert weight @ found.failing(mean, factor) == pytest.approx(ndtr(-found(mean, factor).value))


@pytest.mark.parametrize("deviations", [3.1, 3.7, float(ndtri(PROBABILITY_MAX))])
@pytest.mark.parametrize("dimension", [9, 15])
def test_failure_up_to_highest_target_within_half(deviations, dimension):
    """Of one limit at one node, for which the nodes' quadrature is exact."""
    law = sphere_directions(LINES, dimension)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        mean = ((1.0 - deviations * 0.03) * random_unit(rng))[None]
        factor = 0.03 * np.linalg.qr(rng.normal(size=(dimension, 3)))[0].T[None]
        event = Event("ball", np.array([0]), (Ball(np.zeros((1, 3)), 1.0),), ())
        quantile, node = (
            FlightProbability((event,), law)(mean, factor),
            node_quantiles(event, mean, factor),
        )
        assert np.linalg.norm(quantile.by_mean - node.by_mean) < 0.5 * np.linalg.norm(node.by_mean)
        found, (exact,) = quantile.value, node.value
        assert ndtr(-found) == pytest.approx(ndtr(-exact), rel=0.5)
        assert found == pytest.approx(exact, abs=0.15)


@given(seeds, st.floats(0.5, 2.5))
@few
def test_half_spaces_of_one_error_match_closed_form(seed, deviations):
    """Huge balls at several nodes, in whose normals all factors are along one direction of w.

    A flight keeps all of them if it keeps the one nearest in standard deviations.
    """
    rng = np.random.default_rng(seed)
    n, radius, w = 4, 1e6, rng.normal(size=9)
    w /= np.linalg.norm(w)
    normal = random_unit(rng, n)
    away = deviations + rng.uniform(0.0, 2.0, n)
    away[0] = deviations
    across = rng.normal(size=(n, 3, 9))
    across -= normal[:, :, None] * (normal[:, None] @ across)
    factor = normal[:, :, None] * w + across
    event = Event("plane", np.arange(n), (Ball(-radius * normal, radius),), ())
    flight = Flight(-away[:, None] * normal, factor, (event,))
    assert probability(flight) == pytest.approx(float(ndtr(deviations)), abs=8e-3)


@given(seed=seeds, outside=st.sampled_from([None, -0.02, 0.02]))
@few
def test_distant_chords_are_never_missed(seed, outside):
    """Against all chords of all lines, which a plane through each keep-out decides not to compute."""
    flight = some_flight(seed, outside)
    estimate = of_flight(flight, 512)
    found = estimate(flight.mean, flight.factor)

    def every(self: FlightProbability, at: Array, spread: Array, limits: Limits) -> Segments:
        ends: tuple[list[Array], list[Array]] = [], []
        for limit, first in zip((*limits.inner, *limits.outer), limits.first, strict=False):
            rows = slice(first, first + len(limit.nodes))
            along = np.einsum("nid,ld->nli", spread[0, rows], self.directions.unit)
            for end, found in zip(ends, limit.region.chord(at[0, rows, None], along), strict=True):
                end.append(found)
        low, high = (np.vstack(end) for end in ends)
        inner = sum(len(limit.nodes) for limit in limits.inner)
        met = np.nonzero(low[inner:] < np.inf)
        out = Chords(inner + met[0], met[1], *(end[inner:][met] for end in (low, high)))
        return kept_segments((low[:inner], high[:inner]), out)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FlightProbability, "_kept", every)
        dense = estimate(flight.mean, flight.factor)
    for one, other in zip(found, dense, strict=True):
        if not isinstance(one, Limits):
            assert one == pytest.approx(other, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("keep", ["in", "out"])
@pytest.mark.parametrize("side", [-0.1, 0.1])
def test_without_any_spread_the_means_side_tells(keep, side):
    ball = (Ball(np.zeros((1, 3)), 1.0),)
    event = Event("e", np.array([0]), *((ball, ()) if keep == "in" else ((), ball)))
    flight = Flight(np.array([[1.0 + side, 0.0, 0.0]]), np.zeros((1, 3, 6)), (event,))
    holds = (side > 0.0) == (keep == "out")
    found = of_flight(flight, 64)(flight.mean, flight.factor)
    assert found.value == pytest.approx(7.03 if holds else -7.03, abs=0.01)
    assert np.isfinite(found.by_mean).all()


def test_a_flight_that_meets_nothing_is_certain():
    flight = some_flight(0)
    found = of_flight(flight._replace(events=()))(flight.mean, flight.factor)
    assert found.value > 7.0
    assert len(found.nodes) == 0


def along(flight: Flight, rng: np.random.Generator) -> tuple[Array, Array]:
    """A random direction of means and factors."""
    move = rng.normal(size=flight.mean.shape), rng.normal(size=flight.factor.shape)
    size = np.sqrt(sum(float((part**2).sum()) for part in move))
    return move[0] / size, move[1] / size


def slopes(flight: Flight, rng: np.random.Generator, step: float) -> tuple[float, float]:
    """By the gradient, and by a central difference of the same sampled function."""
    g = of_flight(flight, 256, 100.0)
    d_mean, d_factor = along(flight, rng)
    at = g(flight.mean, flight.factor)
    slope = float((at.by_mean * d_mean[at.nodes]).sum())
    slope += float((at.by_factor * d_factor[at.nodes]).sum())
    ahead = g(flight.mean + step * d_mean, flight.factor + step * d_factor).value
    behind = g(flight.mean - step * d_mean, flight.factor - step * d_factor).value
    return slope, (ahead - behind) / (2.0 * step)


@given(seeds, st.sampled_from([None, 0.01]))
@few
def test_the_gradient_is_that_of_the_sampled_function(seed, outside):
    """But for the kinks of lines that pass from one limit to another within the step."""
    flight = some_flight(seed, outside)
    slope, difference = slopes(flight, np.random.default_rng(seed), 1e-6)
    assert slope == pytest.approx(difference, rel=1e-2, abs=1e-2)


def test_shares_of_ended_flights_match_gradient():
    """A limit that ends no flight has no say."""
    flight = some_flight(2)
    found = of_flight(flight, reach=100.0)(flight.mean, flight.factor)
    assert np.all(found.ends >= 0.0)
    silent = found.ends == 0.0
    assert silent.any()
    assert np.all(found.by_mean[silent] == 0.0)
    assert np.all(found.by_factor[silent] == 0.0)


def test_batch_of_flights_equals_single_flights():
    flight, rng = some_flight(1, -0.02), np.random.default_rng(1)
    estimate = of_flight(flight, 512)
    mean = flight.mean + 1e-3 * rng.normal(size=(3, *flight.mean.shape))
    factor = flight.factor * (1.0 + 0.01 * rng.normal(size=(3, *flight.factor.shape)))
    limits = estimate.limits(flight.mean, flight.factor)
    for j, found in enumerate(estimate.of_many(mean, factor, limits)):
        (alone,) = estimate.of_many(mean[j : j + 1], factor[j : j + 1], limits)
        for one, other in zip(found, alone, strict=True):
            if not isinstance(one, Limits):
                np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
