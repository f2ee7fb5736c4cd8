"""Regions and numbers as users give them: checked, and scaled to the nondimensional problem's units."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Literal

import numpy as np
import numpy.typing as npt

from formulations.arrays import Array
from formulations.linearisation.factor import factor_of
from formulations.problem.regions import Ball, Cone, Ellipsoid, Halfspaces, Polytope, Region
from scp_recon.errors import InputError, one_of, shortened


@dataclass(frozen=True, eq=False)
class Keep:
    """A region in or out of which the position stays at some nodes.

    Centres, apices, axes, normals and offsets are those of all nodes, or one for each.

    Examples:
        >>> import scp_recon as sr
        >>> sr.Keep("out", sr.Ball([0.0, 0.0, 0.0], 100.0), nodes=range(1, 25)).side
        'out'

    Attributes:
        side: "in" or "out".
        region: of positions, in the problem's units.
        nodes: indices, by default all but the first.
        name: by default the kind of region, and its number.

    Raises:
        InputError: if the side is another, or the region is empty or of other shapes.
    """

    side: Literal["in", "out"]
    region: Region
    nodes: npt.ArrayLike | None = None
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse what no problem could use."""
        name = self.name or type(self.region).__name__.lower()
        one_of(f"{name}: side", self.side, ("in", "out"))
        if not isinstance(self.region, Region):
            raise InputError("region", f"{self.region!r}", "must be a Ball, Cone, Halfspaces, ...")
        try:
            nodes = None if self.nodes is None else np.asarray(self.nodes)
        except ValueError:  # rows of several lengths
            nodes = np.zeros((0, 0))
        if nodes is not None and (nodes.ndim != 1 or nodes.dtype.kind != "i" or not len(nodes)):
            raise InputError(f"{name}: nodes", f"{self.nodes}", "must be some indices of nodes")
        if nodes is not None and (nodes[0] < 0 or np.any(np.diff(nodes) <= 0)):
            raise InputError(f"{name}: nodes", f"{self.nodes}", "must ascend from 0")
        scaled(name, self.region, None if nodes is None else len(nodes), 1.0)


def scaled(name: str, region: Region, n: int | None, length: float) -> Region:
    """A user's region as one region for each of n nodes, in units of a length.

    Without n, arrays may be those of any number of nodes.

    Raises:
        InputError: if it is empty, or its arrays have other shapes.
    """

    def each(of: str, value: npt.ArrayLike, width: tuple[int, ...] = (3,)) -> Array:
        array = _numbers(f"{name}: {of}", value)
        count = len(array) if n is None and array.ndim > len(width) else n or 1
        if array.shape not in (width, (count, *width)) or not np.isfinite(array).all():
            found = f"{of} of shape {array.shape}" if np.isfinite(array).all() else f"{of} {array}"
            raise InputError(name, found, f"must be finite, of shape {width} or {(count, *width)}")
        return np.array(np.broadcast_to(array, (count, *width)))

    def empty(found: str, needs: str) -> InputError:
        return InputError(name, found, f"must have points: {needs}")

    match region:
        case Ball(center, radius):
            if not radius > 0.0:
                raise empty(f"radius {radius}", "a positive radius")
            return Ball(each("center", center) / length, radius / length)
        case Cone(apex, axis, half_angle):
            axes = each("axis", axis)
            size = np.linalg.norm(axes, axis=1, keepdims=True)
            if not half_angle > 0.0 or not size.all():
                raise empty(f"half-angle {half_angle}, axis {axis}", "0 to pi/2, about an axis")
            return Cone(each("apex", apex) / length, axes / size, half_angle)
        case Halfspaces(normal, offset):
            normals, offsets = each("normal", normal), each("offset", offset, ())
            size = np.linalg.norm(normals, axis=1)
            if not size.all():
                raise empty(f"normal {normal}", "a normal other than zero")
            return Halfspaces(normals / size[:, None], offsets / size / length)
        case Ellipsoid(center, matrix, radius):
            shape = finite(f"{name}: matrix", matrix, (3, 3))
            sizes = np.linalg.svd(shape, compute_uv=False)
            if not radius > 0.0 or sizes[-1] <= 1e-12 * sizes[0]:
                raise empty(f"radius {radius}, stretches {sizes}", "all positive")
            own = radius / sizes[0] / length
            return Ellipsoid(each("center", center) / length, shape / sizes[0], own)
        case Polytope(normal, offset):
            normals = np.atleast_2d(np.asarray(normal, dtype=float))
            offsets = finite(f"{name}: offset", offset, (len(normals),))
            size = np.linalg.norm(finite(f"{name}: normal", normals, (len(normals), 3)), axis=1)
            if not size.all() or not _has_points(normals / size[:, None], offsets / size):
                raise empty(f"{len(normals)} faces", "half-spaces that meet")
            return Polytope(normals / size[:, None], offsets / size / length)


def _has_points(normal: Array, offset: Array) -> bool:
    """Whether half-spaces have a ball in common, by the largest one (Chebyshev's centre)."""
    from scipy.optimize import linprog

    ones, bounds = np.ones((len(offset), 1)), [(None, None)] * 3 + [(0.0, 1.0)]
    found = linprog([0.0, 0.0, 0.0, -1.0], np.hstack([normal, ones]), offset, bounds=bounds)
    return bool(found.status == 0 and float(found.fun or 0.0) < 0.0)


def positive(name: str, given: object) -> float:
    """A positive, finite number."""
    is_bool = isinstance(given, bool)
    if is_bool or not isinstance(given, Real) or not 0.0 < float(given) < np.inf:
        raise InputError(name, shortened(given), "must be positive and finite")
    return float(given)


def _numbers(name: str, value: npt.ArrayLike) -> Array:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(name, shortened(value), "must be numbers") from None


def finite(name: str, value: npt.ArrayLike, shape: tuple[int, ...]) -> Array:
    """An array of a shape, all numbers finite."""
    array = _numbers(name, value)
    if array.shape != shape or not np.isfinite(array).all():
        found = f"shape {array.shape}" if array.shape != shape else "numbers that are not finite"
        raise InputError(name, found, f"must be finite, of shape {shape}")
    return array


def covariance_factor(name: str, covariance: npt.ArrayLike, size: int) -> Array:
    """Factor S of a covariance S S', refused where it is none."""
    matrix = finite(name, covariance, (size, size))
    scale = np.sqrt(np.abs(np.diag(matrix)))
    scale[scale == 0.0] = 1.0
    values = np.linalg.eigvalsh(matrix / scale / scale[:, None])
    if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max() or values[0] < -1e-9:
        raise InputError(name, "a matrix that is no covariance", "must be symmetric, none negative")
    return factor_of(matrix)
