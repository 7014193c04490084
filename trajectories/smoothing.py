"""Smoothing splines whose deviation from the points is bounded on the whole and at each point.

Splines with few knots (`scipy.interpolate.make_splprep`) reach a given deviation with as few knots
as they can, and wiggle: a sine with peaks of 0.049 1/m comes back with 0.15 1/m at 0.1 m rms. Here
knots are as dense as the points and roughness has a price instead (P-splines: Eilers and Marx,
1996). Three things keep the shape of bends:

* Points that are left by more than `REACH` times the tolerance get larger weights until none is
  (Lawson's iteration for the Chebyshev norm), so deviation cannot pile up in the only bend of a
  long path.
* The parameter is the arc length of the curve itself, found in `PASSES` rounds. With the length of
  the chords between the points, a curve that cuts a bend runs slower there, and its curvature, over
  the square of that speed, rises: a hairpin of 0.125 1/m came back with 0.15 1/m.
* If knots as dense as the median of the points cannot come as near to them as they must, where
  points are unevenly spaced, their number is doubled.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

Array = NDArray[np.float64]
Fit = TypeVar("Fit")

DEGREE = 5
"""Degree of the splines."""
REACH = 3.0
"""Multiple of the rms tolerance by which a point may be left. Normal noise of that rms goes beyond
it once in 8000 points."""
LEAST_KNOT_SPACING, MANY_KNOTS = 0.5, 4000
"""m: denser points do not need denser knots, if there are more than these."""
PENALTY_EXPONENTS = (-8.0, 8.0)
"""Powers of ten between which the penalty on roughness is bisected."""
PENALTY_RESOLUTION = 0.05
"""Width of the bracket, in powers of ten, at which the bisection ends."""
PASSES = 4
"""Number of fits, each over the arc length of the one before."""
GAP, FAINT = 10.0, 1e-5
"""A gap is longer than this multiple of the median distance. Points on its chord, one for each
knot, are fitted with this faint weight (times the penalty): without them a bend that ends at a gap
would go on into the gap."""
HEAVIEST = 1e8
"""Largest weight of a point."""
ROUNDS = 60
"""Largest number of solutions with other weights in a pass."""
POWER = 1.5
"""Power of a deviation with which its weight grows: 1 converges slower, 2 may oscillate."""
GOAL, ARRIVED = 0.99, 1.01
"""Share of the bound that the weights aim at, and the one at which they have arrived."""
ABSCISSAE, WEIGHTS = np.polynomial.legendre.leggauss(5)
ABSCISSAE, WEIGHTS = 0.5 * (ABSCISSAE + 1.0), 0.5 * WEIGHTS
"""Those of 5-point Gauss-Legendre quadrature on [0, 1]."""


def chord_lengths(points: Array) -> Array:
    """Return the lengths (n,) of the polygon through (n, 2) points, from the first to each, m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])


def smoothing_spline(points: Array, tolerance: float, *, closed: bool) -> tuple["BSpline", Array]:
    """Return the smoothest spline through (n, 2) points up to deviations, and their parameters.

    The rms deviation is at most `tolerance`, the largest one about `REACH` times that, m; where
    outliers must be followed so far, the rms of all may exceed it by a fifth. The parameter is arc
    length to about a thousandth. A closed curve has one more parameter, that of its end.
    """
    chain = np.vstack([points, points[:1]]) if closed else points
    at = chord_lengths(chain)
    spacing, length = float(np.median(np.diff(at))), float(at[-1])
    cells = int(np.ceil(length / spacing))
    if cells > MANY_KNOTS:
        cells = max(int(np.ceil(length / max(spacing, LEAST_KNOT_SPACING))), MANY_KNOTS)
    cells = max(cells, DEGREE + 3)
    centre = points.mean(axis=0)
    while True:
        spline, along, largest = _fitted(points - centre, at, tolerance, cells, closed=closed)
        if largest <= ARRIVED * REACH * tolerance or 2 * cells > 3 * MANY_KNOTS:
            break
        cells *= 2
    spline.c += centre
    return spline, along


def _fitted(
    points: Array, at: Array, tolerance: float, cells: int, *, closed: bool
) -> tuple["BSpline", Array, float]:
    """Fit a spline of `cells` cells; return it, the points' parameters, the largest deviation."""
    for left in reversed(range(PASSES)):
        spline, largest = _penalised(points, at, tolerance, cells, closed=closed)
        if left == 0:
            break
        steps = np.diff(at)
        inner = spline.derivative()((at[:-1, None] + steps[:, None] * ABSCISSAE).ravel())
        speeds = np.hypot(*inner.T).reshape(-1, len(ABSCISSAE))
        at = np.concatenate([[0.0], np.cumsum((speeds @ WEIGHTS) * steps)])
    return spline, at, largest


def _penalised(
    points: Array, at: Array, tolerance: float, cells: int, *, closed: bool
) -> tuple["BSpline", float]:
    """Minimise sum w |B c - points|^2 + penalty |D c|^2 over control points c, D third differences.

    The rms deviation at equal weights w grows with the penalty; take the largest penalty that keeps
    `tolerance`, then raise the weights of points that are left by too much. Return the largest
    deviation with the spline.
    """
    from scipy.interpolate import BSpline

    length, count = float(at[-1]), len(points)
    knots = length / cells * np.arange(-DEGREE, cells + DEGREE + 1)
    bridges, between = _bridges(at, np.vstack([points, points[:1]]), length / cells)
    points = np.vstack([points, bridges])
    within = np.minimum(np.append(at[:count], between), length * (1.0 - 1e-15))
    basis = BSpline.design_matrix(within, knots, DEGREE)
    unknowns = cells if closed else cells + DEGREE
    columns = basis.indices.reshape(-1, DEGREE + 1) % unknowns
    values = basis.data.reshape(columns.shape)
    third = np.arange(unknowns if closed else unknowns - 3)[:, None] + np.arange(4)
    # Columns that are neighbours over the seam are near each other in the matrix, too.
    place = np.arange(unknowns)
    if closed:
        place = np.minimum(2 * place, 2 * (unknowns - 1 - place) + 1)
    shape = (2 * DEGREE + 2 if closed else DEGREE + 1), unknowns
    normal = _Gram(place[columns], values, shape)
    third, differences = third % unknowns, np.tile([-1.0, 3.0, -3.0, 1.0], (len(third), 1))
    roughness = _Gram(place[third], differences, shape)(np.ones(len(third)))
    rows = (place[columns], values), (place[third], differences)
    weights = np.ones(len(points))

    def solve(exponent: float, control: Array) -> tuple[Array, Array]:
        """Return control points (m, 2), as corrections of others, and deviations (count,)."""
        penalty = 10.0**exponent
        weights[count:] = FAINT * max(1.0, penalty)
        left = weights[:, None] * (points - np.einsum("nk,nkd->nd", values, control[columns]))
        rough = -penalty * np.einsum("nk,nkd->nd", differences, control[third])
        right = np.column_stack(
            [
                sum(
                    np.bincount(at.ravel(), (row * side[:, None]).ravel(), minlength=unknowns)
                    for (at, row), side in zip(rows, sides, strict=True)
                )
                for sides in zip(left.T, rough.T, strict=True)
            ]
        )
        bands = normal(weights) + penalty * roughness
        control = control + solveh_banded(bands, right, lower=True, check_finite=False)[place]
        reached = np.einsum("nk,nkd->nd", values[:count], control[columns[:count]])
        return control, np.hypot(*(reached - points[:count]).T)

    nothing = np.zeros((unknowns, 2))

    def fit(exponent: float) -> tuple[tuple[float, Array, Array], float]:
        control, deviation = solve(exponent, nothing)
        return (exponent, control, deviation), float(np.sqrt(np.mean(deviation**2)))

    exponent, control, deviation = largest_penalty(fit, tolerance, PENALTY_EXPONENTS)
    bound, rounds = REACH * tolerance, 0
    while deviation.max() > bound and rounds < ROUNDS:
        growth = (deviation / (GOAL * bound)) ** POWER
        weights[:count] = np.clip(weights[:count] * growth, 1.0, HEAVIEST)
        control, deviation = solve(exponent, nothing)
        rounds += 1
    # Large penalties cost digits, which one step of refinement brings back.
    control, deviation = solve(exponent, control)
    if closed:
        control = np.vstack([control, control[:DEGREE]])
    return BSpline(knots, control, DEGREE), float(deviation.max())


def _bridges(at: Array, chain: Array, spacing: float) -> tuple[Array, Array]:
    """Return points (k, 2) on the chords over gaps of more than `GAP` knots, and parameters."""
    steps = np.diff(at)
    counts = np.where(
        steps > GAP * max(spacing, float(np.median(steps))), steps / spacing, 0.0
    ).astype(int)
    gap = np.repeat(np.arange(len(steps)), counts)
    number = np.arange(len(gap)) - np.repeat(np.cumsum(counts) - counts, counts)
    part = (number + 1.0) / (counts[gap] + 1.0)
    points = chain[gap] + part[:, None] * (chain[gap + 1] - chain[gap])
    return points, at[gap] + part * steps[gap]


class _Gram:
    """Sums of w_k r_k r_k^T over sparse rows r_k, as the lower bands of a symmetric matrix.

    Parameters
    ----------
    columns, values
        Places in the matrix and values of the rows' entries, each (n, k).
    shape
        Number of bands and size of the matrix.
    """

    def __init__(self, columns: NDArray[np.intp], values: Array, shape: tuple[int, int]) -> None:
        first, second = np.tril_indices(columns.shape[1])
        pairs = columns[:, first], columns[:, second]
        self._shape = shape
        self._flat = (np.abs(pairs[0] - pairs[1]) * shape[1] + np.minimum(*pairs)).ravel()
        self._products = values[:, first] * values[:, second]

    def __call__(self, weights: Array) -> Array:
        """Return the sum as bands for `scipy.linalg.solveh_banded`."""
        products = (weights[:, None] * self._products).ravel()
        bands = np.bincount(self._flat, products, minlength=self._shape[0] * self._shape[1])
        return bands.astype(np.float64).reshape(self._shape)


def largest_penalty(
    fit: Callable[[float], tuple[Fit, float]], tolerance: float, exponents: tuple[float, float]
) -> Fit:
    """Return the fit with the largest penalty on roughness that keeps a tolerance, by bisection.

    `fit` returns a fit and its rms deviation, which grows with the penalty, from the penalty's
    power of ten. The smallest penalty is taken if none keeps the tolerance.
    """
    low, high = exponents
    if fit(high)[1] <= tolerance:
        low = high
    while high - low > PENALTY_RESOLUTION:
        middle = 0.5 * (low + high)
        if fit(middle)[1] <= tolerance:
            low = middle
        else:
            high = middle
    return fit(low)[0]
