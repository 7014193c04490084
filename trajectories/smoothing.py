"""Penalised smoothing splines through measured points.

Splines with few knots (`scipy.interpolate.make_splprep`) meet a deviation with as few knots as
they can, and wiggle: a sine with peaks of 0.049 1/m comes back with 0.15 1/m at 0.1 m rms. Here
knots are as dense as the points and roughness has a price instead (P-splines: Eilers and Marx,
1996), so more smoothing never sharpens a bend much; closed curves are periodic exactly.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse.linalg import splu

from trajectories import shapes

Array = NDArray[np.float64]

DEGREE = 5
LEAST_KNOT_SPACING = 0.5
"""m: denser points do not need denser knots."""
PENALTY_EXPONENTS = (-8.0, 6.0)
PENALTY_RESOLUTION = 0.05
"""Powers of ten between which the penalty is bisected, and to what resolution."""


class Smoothed(NamedTuple):
    """A curve's geometry and how far it passes the points it was fitted to, m."""

    geometry: shapes.Geometry
    max_deviation: float
    rms_deviation: float


def smooth(points: Array, tolerance: float, *, closed: bool = False) -> Smoothed:
    """Fit the smoothest quintic spline whose rms deviation from points is at most `tolerance`.

    Parameters
    ----------
    points
        (n, 2), m; a closed curve's first point is not repeated at the end.
    tolerance
        m; 0 interpolates with a cubic spline.
    closed
        Whether the curve goes on from the last point to the first.
    """
    chain = np.vstack([points, points[:1]]) if closed else points
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(chain, axis=0).T))])
    if tolerance > 0.0:
        spline = _penalised(points, at, tolerance, closed)
    else:
        spline = make_interp_spline(at, chain, k=3, bc_type="periodic" if closed else None)
    deviation = np.hypot(*(spline(at) - chain).T)
    geometry = shapes.parametric(_curve(spline), float(at[-1]))
    return Smoothed(geometry, float(deviation.max()), float(np.sqrt(np.mean(deviation**2))))


def _curve(spline: BSpline) -> Callable[[Array], shapes.Derivatives]:
    """Coordinates and their derivatives as `shapes.parametric` takes them."""
    first, second = spline.derivative(), spline.derivative(2)

    def curve(t: Array) -> shapes.Derivatives:
        r, dr, ddr = spline(t).T, first(t).T, second(t).T
        return r[0], r[1], dr[0], dr[1], ddr[0], ddr[1]

    return curve


def _penalised(points: Array, at: Array, tolerance: float, closed: bool) -> BSpline:
    """Minimise |B c - points|^2 + penalty |D c|^2, D third differences, c control points.

    The rms deviation grows with the penalty: the largest penalty is taken that keeps `tolerance`.
    """
    length = float(at[-1])
    cells = int(np.ceil(length / max(float(np.median(np.diff(at))), LEAST_KNOT_SPACING)))
    cells = max(cells, DEGREE + 3)
    knots = length / cells * np.arange(-DEGREE, cells + DEGREE + 1)
    within = np.minimum(at[: len(points)], length * (1.0 - 1e-15))
    basis = BSpline.design_matrix(within, knots, DEGREE)
    unknowns = cells if closed else cells + DEGREE
    difference = sparse.identity(unknowns, format="csr")
    if closed:  # control points repeat after `cells`
        whole = sparse.identity(cells, format="csr")
        basis = basis @ sparse.vstack([whole, whole[:DEGREE]])
        shift = whole[np.r_[1:cells, 0]] - whole
        difference = shift @ shift @ shift
    else:
        for _ in range(3):
            difference = difference[1:] - difference[:-1]
    normal, roughness = (basis.T @ basis).tocsc(), (difference.T @ difference).tocsc()
    centre = points.mean(axis=0)
    right = basis.T @ (points - centre)

    def solve(exponent: float) -> tuple[Array, float]:
        control = splu((normal + 10.0**exponent * roughness).tocsc()).solve(right)
        residual = basis @ control - (points - centre)
        return control, float(np.sqrt(np.mean((residual**2).sum(axis=1))))

    low, high = PENALTY_EXPONENTS
    if solve(high)[1] <= tolerance:
        low = high
    while high - low > PENALTY_RESOLUTION:
        middle = 0.5 * (low + high)
        if solve(middle)[1] <= tolerance:
            low = middle
        else:
            high = middle
    control = solve(low)[0] + centre
    if closed:
        control = np.vstack([control, control[:DEGREE]])
    return BSpline(knots, control, DEGREE)
