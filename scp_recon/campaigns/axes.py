"""Make the rows of a study's axes, and the cases, which are their product; spread sites evenly.

A row has the entries that change from case to case.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from math import prod
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, NaiveDatetime, model_validator
from scipy.spatial import KDTree

from formulations.arrays import Array
from scp_recon.bodies.catalogue import DAY_S
from scp_recon.bodies.files import read_shape
from scp_recon.bodies.surface import Ellipsoid, Mesh, Surface, coordinates_of, quartered
from scp_recon.errors import InputError
from scp_recon.jobs.job import generator, sequence
from scp_recon.mission.scene import Scene
from scp_recon.mission.schedule import survey
from scp_recon.physics.two_body import two_body
from scp_recon.scenario.fields import Section
from scp_recon.scenario.given import anchored, tables_of
from scp_recon.scenario.schema import Scenario

Changes = dict[str, Any]
"""Values by entry, set together: a row of an axis."""


class Case(NamedTuple):
    """A case of a study: its number from 0, its seed below 2^63, and values by dotted entry.

    Seed and values depend on the study and the number alone.
    """

    number: int
    seed: int
    changes: Mapping[str, Any]


@dataclass(frozen=True)
class Cases(Sequence[Case]):
    """The product of the axes, the last one changing fastest; each case is made on access."""

    axes: tuple[list[Changes], ...]
    seed: int

    def __len__(self) -> int:
        """Number of cases."""
        return prod(len(rows) for rows in self.axes)

    def __getitem__(self, number: Any) -> Any:
        """The case of that number."""
        if not 0 <= number < len(self):
            raise IndexError(number)
        places = np.unravel_index(number, [len(rows) for rows in self.axes])
        chosen = (rows[k] for rows, k in zip(self.axes, places, strict=True))
        changes = {entry: value for row in chosen for entry, value in row.items()}
        (state,) = sequence(self.seed, number).generate_state(1, np.uint64)
        return Case(number, int(state >> 1), changes)


SOLUTIONS = "solutions"
"""Folder of kept solutions in the campaign's."""


def solution_name(number: int) -> str:
    """Path of a case's kept solution, relative to the campaign's folder."""
    return f"{SOLUTIONS}/case-{number:07d}/solution.json"


TABLE = "campaign."
"""How entries of an axis begin that are of the campaign's table, not of the scenario."""


def of_campaign(changes: Mapping[str, Any]) -> Changes:
    """A case's changes to the table `[campaign]`, without its name."""
    return {key.removeprefix(TABLE): one for key, one in changes.items() if key.startswith(TABLE)}


def changed(base: Scenario, changes: Mapping[str, Any], folder: Path) -> Scenario:
    """Apply a case's changes to the base, but those to the campaign's table.

    Raises:
        InputError: if the result is no valid scenario.
    """
    own = {entry: value for entry, value in changes.items() if not entry.startswith(TABLE)}
    return base.replace(layer_of(own, folder)) if own else base


def layer_of(changes: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Nested tables of values by entry, the paths of files among them made absolute."""
    return anchored(tables_of(changes.items()), folder)


Entry = Annotated[str, Field(min_length=1, max_length=200)]
ROWS_MAX = 1_000_000
"""Most rows of one axis."""
Count = Annotated[int, Field(ge=1, le=ROWS_MAX)]
Real = Annotated[float, Field(ge=-1e15, le=1e15)]
LATITUDE, LONGITUDE = "site.latitude_deg", "site.longitude_deg"
NAME, EPOCH = "site.name", "epoch.tdb"
STRIDE = np.sqrt(2.0)
"""Number whose multiples order spread sites; those of the golden ratio are their longitudes."""
DAYS_MAX = 440.0
"""Longest search for windows, and farthest from the epoch: two-body motion is off by 0.02 deg there, at
Bennu."""

PARTS = 50
"""Parts of the surface for each site, over which its area is summed."""
ROUNDS = 40
"""Rounds of Lloyd's algorithm; after 20 the areas of 324 sites on Bennu hardly change."""
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


class Span(Section):
    """Numbers from one to another, both included, at even steps or in equal ratios."""

    start: Annotated[Real, Field(alias="from")]
    to: Real
    count: Count
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _sane(self) -> Self:
        if self.scale == "log" and min(self.start, self.to) <= 0.0:
            raise ValueError("must be positive on a logarithmic scale")
        if self.count > 1 and self.start == self.to:
            raise ValueError("must have different ends, or a count of 1")
        return self

    def numbers(self) -> list[float]:
        """All numbers; the ends exactly as given."""
        make = np.geomspace if self.scale == "log" else np.linspace
        numbers: list[float] = make(self.start, self.to, self.count).tolist()
        return numbers


class Law(Section):
    """The distribution of a random entry.

    normal and lognormal have mean and sigma (lognormal: of the logarithm), uniform and loguniform have
    low and high.
    """

    entry: Entry
    law: Literal["normal", "lognormal", "uniform", "loguniform"]
    mean: Real | None = None
    sigma: Annotated[float, Field(gt=0, le=1e15)] | None = None
    low: Real | None = None
    high: Real | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        needed = ["mean", "sigma"] if self.law.endswith("normal") else ["low", "high"]
        if [name for name, value in self if value is not None] != ["entry", "law", *needed]:
            raise ValueError(f"{self.law} must have {needed[0]} and {needed[1]} alone")
        if self.low is not None and self.high is not None:
            if self.low >= self.high:
                raise ValueError("low must be less than high")
            if self.law == "loguniform" and self.low <= 0.0:
                raise ValueError("low must be positive")
        return self

    def drawn(self, rng: np.random.Generator, count: int) -> Array:
        """Draw `count` values, shape (count,)."""
        log = self.law.startswith("log")
        if self.mean is not None and self.sigma is not None:
            found = rng.normal(self.mean, self.sigma, count)
        else:
            low, high = np.array([self.low, self.high], dtype=float)
            ends = (np.log(low), np.log(high)) if log else (low, high)
            found = rng.uniform(*ends, size=count)
        return np.exp(found) if log else found


class EvenSites(Section):
    """The number of sites, and the time of their local noon."""

    count: Annotated[int, Field(ge=4, le=10_000)]
    """Number of sites; each has nearly the same share of the area."""
    noon_at_s: Annotated[float | None, Field(ge=-1e7, le=1e7)] = None
    """Time of local solar noon at the site, s past the epoch, which moves by less than a rotation: each
    site is then seen at the same time of its flight. Without it the epoch stays."""


class WindowSearch(Section):
    """The span searched for lighting windows, and the windows used."""

    start: Annotated[NaiveDatetime | None, Field(alias="from")] = None
    span_days: Annotated[float, Field(ge=0.01, le=DAYS_MAX)]
    every: Annotated[int, Field(ge=1)] = 1


KINDS: dict[str, tuple[str, ...]] = {
    "values": ("entry", "entries"),
    "grid": ("entry",),
    "draws": ("count",),
    "spread": (),
    "windows": (),
}
"""Kinds of axes by their key, and the keys one of which goes with it."""


class Axis(Section):
    """A table `[[axis]]`: the entries that change together, and their values.

    Attributes:
        entry, entries: that take `values`, each a value or a row of several.
        grid: numbers of an entry.
        draws: independent random entries; a larger count keeps the first rows.
        spread: sites spread evenly over the base's shape file, or its ellipsoid.
        windows: epochs with which the base's burns are legal about the lighting windows of its site.
    """

    entry: Entry | None = None
    entries: Annotated[tuple[Entry, ...], Field(min_length=1)] | None = None
    values: Annotated[tuple[Any, ...], Field(min_length=1)] | None = None
    grid: Span | None = None
    draws: Annotated[tuple[Law, ...], Field(min_length=1)] | None = None
    count: Count | None = None
    spread: EvenSites | None = None
    windows: WindowSearch | None = None

    @model_validator(mode="after")
    def _of_one_kind(self) -> Self:
        given = [name for name, value in self if value is not None]
        kinds = [name for name in given if name in KINDS]
        if len(kinds) != 1:
            raise ValueError(f"must have one of {', '.join(KINDS)}")
        beside, known = [name for name in given if name not in kinds], KINDS[kinds[0]]
        if beside not in ([[name] for name in known] or [[]]):
            expected = " or ".join(known) or "nothing else"
            raise ValueError(
                f"{kinds[0]} must stand with {expected}, not {', '.join(beside) or '-'}"
            )
        names = self.entries or [law.entry for law in self.draws or ()]
        if len(set(names)) < len(names):
            raise ValueError("must have each entry once")
        for row in (self.values or ()) if self.entries else ():
            if not isinstance(row, list | tuple) or len(row) != len(names):
                raise ValueError(f"each row of values must have {len(names)} items")
        return self

    def rows(self, base: Scenario, seed: tuple[int, ...]) -> list[Changes]:
        """Make the rows in order, from the study's scenario and the axis's own seed.

        Raises:
            InputError: if the axis has no rows, or a file or an entry cannot be used.
        """
        if self.spread is not None:
            return spread_sites(base, self.spread)
        if self.windows is not None:
            return window_epochs(base, self.windows)
        names: Sequence[str]
        values: Iterable[Sequence[Any]]
        if self.draws is not None:  # each entry has a stream of its own
            names, count = [law.entry for law in self.draws], self.count or 0
            drawn = (law.drawn(generator(*seed, k), count) for k, law in enumerate(self.draws))
            values = zip(*(column.tolist() for column in drawn), strict=True)
        elif self.entries is not None:
            names, values = self.entries, self.values or ()
        else:
            names = [self.entry or ""]
            values = ([one] for one in (self.grid.numbers() if self.grid else self.values or ()))
        return [dict(zip(names, row, strict=True)) for row in values]


def window_epochs(base: Scenario, search: WindowSearch) -> list[Changes]:
    """Epochs in order of time: for each window the middle of its legal ones, to the second.

    The span must contain the whole window, and the window must fall between the same burns as in the
    base.

    Raises:
        InputError: if there are none.
    """
    epoch = base.epoch.tdb
    first = ((search.start or epoch) - epoch).total_seconds()
    if abs(first) > DAYS_MAX * DAY_S:
        raise InputError(
            "windows.from",
            str(search.start),
            f"must be within {DAYS_MAX:g} days of the base's epoch, {epoch.isoformat()}",
        )
    found = survey(base, (first, first + search.span_days * DAY_S))
    allowed = [dict(window.shifts_s).get(found.before) for window in found.windows]
    middles = [round(0.5 * (low + high)) for low, high in filter(None, allowed)][:: search.every]
    if not middles:
        raise InputError(
            "windows",
            f"{len(found.windows)} lighting windows, none in which the base's burns are legal",
            "must find one: see python -m scp_recon windows",
        )
    return [{EPOCH: (epoch + timedelta(seconds=s)).isoformat()} for s in middles]


def spread_sites(base: Scenario, spread: EvenSites) -> list[Changes]:
    """Latitude, longitude, name and, if it moves, the epoch of each site.

    The first sites are spread evenly too, so a stopped campaign still has a coarser map.

    Raises:
        InputError: if the body has no shape, or no noons that the epochs could follow.
    """
    sites = even_sites(surface_of(base), spread.count)
    order = sorted(range(len(sites)), key=lambda number: number * STRIDE % 1.0)
    rows, noon_s = list[Changes](), noons_of(base) if spread.noon_at_s is not None else None
    for number in order:
        latitude, longitude = (round(angle, 2) for angle in sites[number])
        name = f"{abs(latitude):.1f}{'NS'[latitude < 0]} {longitude % 360:.1f}E"
        rows.append({NAME: name, LATITUDE: latitude, LONGITUDE: longitude})
        if noon_s is not None and spread.noon_at_s is not None:
            shift = timedelta(seconds=round(noon_s(longitude) - spread.noon_at_s))
            rows[-1][EPOCH] = (base.epoch.tdb + shift).isoformat()
    return rows


def surface_of(scenario: Scenario) -> Surface:
    """Surface of a scenario's body: its shape file, else its ellipsoid.

    Raises:
        InputError: if the scenario has neither, or the file cannot be read.
    """
    body = scenario.body
    if body.shape_file is not None:
        radius = scenario.site.normal_radius_m or 0.0
        return read_shape(Path(body.shape_file), body.shape_unit, radius, body.naif_id)
    if body.radii_m is None:
        raise InputError(
            "body.radii_m", "nothing", "must be there, or body.shape_file, to spread sites over"
        )
    return Ellipsoid(np.array(body.radii_m))


def even_sites(surface: Surface, count: int) -> list[tuple[float, float]]:
    """Spread sites over a surface: planetocentric latitude and east longitude (-180 to 180), deg.

    A centroidal Voronoi tessellation: each site is the centroid of the area nearest to it, seen from
    the body's centre. Lloyd 1982, IEEE Transactions on Information Theory 28, 129, from a spherical
    Fibonacci lattice (Gonzalez 2010, Mathematical Geosciences 42, 49), in order from south to north.
    The surface must be visible from the centre (star-shaped).
    """
    middles, areas = parts(surface, PARTS * count)
    lattice = fibonacci(count)
    sites = lattice * np.linalg.norm(middles, axis=1).mean()
    for _ in range(ROUNDS):
        nearest = KDTree(sites).query(middles)[1]
        weights = np.bincount(nearest, areas, count)
        moments = [np.bincount(nearest, areas * middles[:, k], count) for k in range(3)]
        with_parts = weights > 0.0
        sites[with_parts] = (np.array(moments).T[with_parts]) / weights[with_parts, None]
    return [coordinates_of(site) for site in sites]


def fibonacci(count: int) -> Array:
    """Unit vectors spread evenly over a sphere, from south to north, shape (count, 3)."""
    number = np.arange(count)
    height = (2.0 * number + 1.0) / count - 1.0
    across, turn = np.sqrt(1.0 - height**2), 2.0 * np.pi * GOLDEN * number
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def parts(surface: Surface, least: int) -> tuple[Array, Array]:
    """Cut a surface into small parts: their middles, m, shape (n, 3), and areas, m^2, shape (n,).

    Facets of a mesh are cut in four until there are `least`; an ellipsoid is divided by directions.
    """
    if isinstance(surface, Mesh):
        corners = surface.vertices_m[surface.facets]
        while len(corners) < least:
            corners = quartered(corners)
        a, b, c = np.moveaxis(corners, 1, 0)
        return corners.mean(axis=1), np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    directions = fibonacci(least)
    found = [surface.at(direction) for direction in directions]
    middles, normals = (np.array(each) for each in zip(*found, strict=True))
    # An area is r^2 of its solid angle, over the cosine between normal and direction.
    areas = np.sum(middles**2, axis=1) / np.sum(directions * normals, axis=1)
    return middles, 4.0 * np.pi / least * areas


def noons_of(scenario: Scenario) -> Callable[[float], float]:
    """Make a function from east longitude, deg, to the first local noon, s past the epoch.

    Newton's method on the Sun's body-fixed longitude.

    Raises:
        InputError: if the body tumbles: it has no solar days.
    """
    if scenario.body.attitude is not None:
        raise InputError("body.attitude", "a body that tumbles", "has no noons to begin a map at")
    rotation, sun = Scene.of(scenario).rotation, scenario.sun
    day = 2.0 * np.pi / abs(rotation.rate)
    to_body = two_body(sun.body_position_km, sun.body_velocity_km_s, (0.0, 3.0 * day))

    def longitude_at(time_s: float) -> float:
        x, y, _ = rotation.body_to_j2000(time_s).T @ -to_body(time_s)
        return float(np.arctan2(y, x))

    def noon_s(longitude_deg: float) -> float:
        time = 0.0
        for _ in range(3):
            ahead = longitude_at(time) - np.deg2rad(longitude_deg)
            turn = ahead % (2.0 * np.pi) if time == 0.0 else (ahead + np.pi) % (2.0 * np.pi) - np.pi
            time += turn / rotation.rate
        return time

    return noon_s
