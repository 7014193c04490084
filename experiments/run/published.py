"""Published results of kumar2025lpv, in metres and radians."""

COLUMNS = ("max_cte", "mean_cte", "mle", "ale", "moe", "aoe")
LABELS = {
    "max_cte": "Max CTE m",
    "mean_cte": "Mean CTE m",
    "mle": "MLE m",
    "ale": "ALE m",
    "moe": "MOE rad",
    "aoe": "AOE rad",
}

SIMULATION: dict[str, tuple[float, ...]] = {
    "T1": (1.36, 0.25, 1.35, 0.19, 0.45, 0.08),
    "T2": (0.76, 0.17, 0.73, 0.14, 0.63, 0.04),
    "T3": (0.99, 0.19, 0.97, 0.15, 0.57, 0.05),
    "T4": (1.73, 0.30, 1.61, 0.20, 0.54, 0.18),
    "T5": (0.82, 0.19, 0.82, 0.13, 0.37, 0.03),
    "T6": (0.77, 0.16, 0.72, 0.11, 0.29, 0.02),
}
"""Simulation rows by trajectory, in the order of `COLUMNS`."""

REALTIME: dict[str, tuple[float, ...]] = {
    "T1": (2.86, 0.26, 2.71, 0.20, 0.57, 0.08),
    "T2": (1.97, 0.19, 1.67, 0.16, 0.77, 0.03),
    "T3": (2.23, 0.21, 2.13, 0.17, 0.65, 0.05),
    "T4": (2.09, 0.23, 1.92, 0.17, 0.63, 0.13),
    "T5": (2.66, 0.18, 2.58, 0.12, 0.42, 0.03),
    "T6": (0.90, 0.19, 0.79, 0.13, 0.18, 0.01),
}
"""Rows of the runs with the vehicle, in the same order."""


def row(trajectory: str, conditions: object = "simulation") -> dict[str, float] | None:
    """Return the published row of a trajectory or its raw form by column; None for others.

    Conditions "simulation" have the row of the paper's simulation, all others that of its runs with
    the vehicle.
    """
    rows = SIMULATION if conditions == "simulation" else REALTIME
    values = rows.get(trajectory.removesuffix("-raw"))
    return None if values is None else dict(zip(COLUMNS, values, strict=True))
