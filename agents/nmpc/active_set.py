"""Active-set steps for the NMPC's quadratic program, compiled.

Most programs need no inequality, or the ones that bound the last plan. So a guess is made from the
shifted plan's gaps, the program is solved with these as equations, and the guess is mended: what is
broken binds, what pulls is freed, a soft constraint whose multiplier exceeds its price is broken.
The primal-dual active-set method (Hintermueller, Ito and Kunisch, SIAM J. Optim. 13, 2002) with an
augmented Lagrangian for what binds. It may cycle: `interior_point` then takes over.
"""

import math
from typing import Any

from numpy.typing import NDArray

from agents.nmpc.program import LINEAR, PAIRS, QUADRATIC, RATIO
from trajectories.compilation import compiled

Array = NDArray[Any]
Float = Any

FREE, BINDING, BROKEN_SOFT = 0.0, 1.0, 2.0
"""What a guess makes of a constraint: it is kept by itself, holds as an equation, is broken."""
NEAR = 1e-4
"""Gap below which a constraint of the plan is guessed to bind."""
HELD = 1e-9
"""Largest gap of a constraint that binds."""
SLIGHT = 1e-9
"""Multiplier below which a constraint that binds is freed."""
STIFFNESS = 1e7
"""Penalty of the augmented Lagrangian."""


@compiled
def guess(gaps: Array, mode: Array, lam: Array) -> None:
    """Guess which constraints hold as equations, or are broken, from a plan's gaps."""
    for k in range(PAIRS):
        row, into, multiplier = gaps[k], mode[k], lam[k]
        soft = k >= 8
        for i in range(gaps.shape[1]):
            multiplier[i] = 0.0
            into[i] = FREE
            if row[i] < NEAR:
                into[i] = BROKEN_SOFT if soft and row[i] < -NEAR else BINDING
    for k in (10, 13, 16):
        mode[k] = FREE


@compiled
def hold(
    gaps: Array, mode: Array, lam: Array, limits: Array, weight: Array, base: Array,
    barrier: Array, slope: Array,
) -> None:  # fmt: skip
    """Fill `barrier` and `slope` for an equality-constrained step.

    Binding constraints by an augmented Lagrangian, broken soft ones by their price.
    """
    n = gaps.shape[1]
    for k in range(PAIRS):
        row, into, multiplier, wk, bk = gaps[k], mode[k], lam[k], weight[k], base[k]
        linear = quadratic = 0.0
        if k >= 8:
            linear, quadratic = limits[LINEAR + (k - 8) // 3], limits[QUADRATIC + (k - 8) // 3]
        for i in range(n):
            wk[i] = STIFFNESS if into[i] == BINDING else 0.0
            bk[i] = multiplier[i] - STIFFNESS * row[i] if into[i] == BINDING else 0.0
            wk[i] = quadratic if into[i] == BROKEN_SOFT else wk[i]
            bk[i] = linear - quadratic * row[i] if into[i] == BROKEN_SOFT else bk[i]
    ratio = limits[RATIO]
    for i in range(n):
        for f in range(4):
            slope[f, i] = base[2 * f, i] - base[2 * f + 1, i]
            barrier[f, i] = weight[2 * f, i] + weight[2 * f + 1, i]
        slope[4, i], barrier[4, i] = base[11, i] - base[12, i], weight[11, i] + weight[12, i]
        right, left, both = base[14, i], base[15, i], weight[14, i] + weight[15, i]
        slope[5, i] = base[8, i] - base[9, i] - ratio * (right + left)
        slope[6, i] = right - left
        barrier[5, i] = weight[8, i] + weight[9, i] + ratio * ratio * both
        barrier[6, i] = ratio * (weight[15, i] - weight[14, i])
        barrier[7, i] = both


@compiled
def revise(gaps: Array, mode: Array, lam: Array, limits: Array) -> tuple[bool, Float]:
    """Mend the guess after a step; whether it changed, and by how much what binds is missed."""
    changed, off = False, 0.0
    for k in range(PAIRS):
        row, into, multiplier = gaps[k], mode[k], lam[k]
        linear = limits[LINEAR + (k - 8) // 3] if k >= 8 else math.inf
        if k in {10, 13, 16}:
            continue
        for i in range(gaps.shape[1]):
            gap, was = row[i], into[i]
            if was == FREE:
                if gap < -HELD:
                    into[i], multiplier[i], changed = BINDING, 0.0, True
            elif was == BINDING:
                force = multiplier[i] - STIFFNESS * gap
                if force < -SLIGHT:
                    into[i], multiplier[i], changed = FREE, 0.0, True
                elif force > linear:
                    into[i], changed = BROKEN_SOFT, True
                else:
                    multiplier[i] = force
                    off = max(off, abs(gap))
            elif gap > HELD:
                into[i], multiplier[i], changed = BINDING, linear, True
    return changed, off
