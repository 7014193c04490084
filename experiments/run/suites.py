"""Suites: named lists of cases."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import agents
from experiments.run.training_folders import first_training
from lpv_track_env import plants
from trajectories import PUBLISHED

Spec = dict[str, Any]

SIX = tuple(PUBLISHED)
PAPER_VEHICLES = ("m2-minibus", "course-car")
"""Vehicles of `paper`, and of the random situations of `lpv-track verify` and `speed`.

CommonRoad's cars, whose tyres are four times as stiff for their mass, leave lpv-nmpc without a
solution in some percent of such random situations, though never on the six.
"""
RAW = tuple(f"{name}-raw" for name in SIX)
RAW_PREVIEW = {"preview_steps": 30, "preview_period": 0.1}
LEAST_SEEDS = 10
HELD_OUT = tuple(f"random-{'fast-' * (seed % 2)}{seed}" for seed in range(20))
"""Random paths that `lpv-track train` uses neither for training nor for validation."""
LIMIT_PATHS = tuple(f"random-limit-{seed}" for seed in range(100))
"""Random paths at the limit that `lpv-track train` and `tune` do not take."""
BESIDE = {"initial_error_range": [0.3, 0.1, 0.5]}
"""Start beside the path; in simulation, a seed changes nothing else."""
LEARNED = ("ppo", "sac", "bc")
"""Shipped policies; their preview of 2 s is too short to cut the corners of raw waypoints."""
DEMONSTRATION = "lpv-mpc-frozen"
"""Agent that shows why the frozen form must not be used."""

CIRCUITS = tuple(f"circuit-{seed}" for seed in range(100))
"""Circuits at the limit that `lpv-track train` and `tune` do not take."""

_CAR = {"vehicles": ("bmw-320i",)}
_TRUTH = {"name": "realtime", "estimator": "truth"}
_BY_GRIP = {**_CAR, "trajectories": CIRCUITS[:3], "speed_modes": ("grip",)}
_HALF_G = {**_CAR, "trajectories": LIMIT_PATHS[::10]}
_AT_055_G = {**_CAR, "trajectories": LIMIT_PATHS[1::10]}
_LANE_CHANGE = {
    "speed_modes": ("fixed",),
    "search": {"setting": "fixed_speed", "low": 8.0, "high": 30.0, "resolution": 0.25},
}
_LANE_CHANGES = (
    {**_LANE_CHANGE, **_CAR, "trajectories": ("iso-3888-1-1.61", "iso-3888-2-1.61")},
    {**_LANE_CHANGE, "trajectories": ("iso-3888-1-2.0", "iso-3888-2-2.0")},
)
_LAPS = {
    **_BY_GRIP, "env_settings": {"max_lateral_error": 0.5},
    "search": {"setting": "grip", "low": 0.4, "high": 1.2, "resolution": 0.01},
}  # fmt: skip
DRY = {"name": "ideal", "friction": 0.9}
"""Ideal conditions of the lane changes and laps, whose limits `physical_limits` has."""
_KNOWN = {**_TRUTH, "friction": 0.9}


def _slippery(start: float, end: float, factor: float) -> dict[str, Any]:
    """Return conditions with a stretch of a road of friction 1 that is more slippery."""
    stretch = {"slippery_stretch": [start, end], "slippery_factor": factor}
    return {"name": "ideal", "friction": 1.0, **stretch}


LIMITS: dict[str, list[dict[str, Any]]] = {
    "random paths, 0.50 to 0.95 g, drift": [
        {**_CAR, "trajectories": LIMIT_PATHS[:10], "env_settings": {"plant": "drift"}}
    ],
    "random paths, 0.50 to 0.95 g, multi-body": [
        {**_CAR, "trajectories": LIMIT_PATHS[:10], "env_settings": {"plant": "multi-body"}}
    ],
    "circuits, 0.5 to 0.9 of grip, drift": [
        {**_BY_GRIP, "grip": grip, "env_settings": {"plant": "drift"}} for grip in (0.5, 0.7, 0.9)
    ],
    "95 % of grip, brush tyres": [
        {
            **_CAR, "trajectories": LIMIT_PATHS[5::10],
            "conditions": {"name": "ideal", "friction": 0.79},
        }
    ],
    "0.55 g, friction unknown": [
        {
            **_AT_055_G, "conditions": {"name": "realtime", "friction": [0.5, 1.0]},
            "seeds": range(2),
        }
    ],
    "0.55 g, friction unknown, true state": [
        {**_AT_055_G, "conditions": {**_TRUTH, "friction": [0.5, 1.0]}, "seeds": range(2)}
    ],
    "lane changes of ISO 3888": [{**one, "conditions": DRY} for one in _LANE_CHANGES],
    "lane changes of ISO 3888, true state": [
        {**one, "conditions": _KNOWN, "seeds": range(2)} for one in _LANE_CHANGES
    ],
    "fastest laps": [{**_LAPS, "conditions": DRY}],
    "fastest laps, true state": [{**_LAPS, "conditions": _KNOWN, "seeds": range(2)}],
    "9 m/s round corners, friction 0.8": [
        {
            "trajectories": SIX[:4], "speed_modes": ("fixed",), "fixed_speed": 9.0,
            "conditions": {"name": "ideal", "friction": 0.8},
        }
    ],
    "28 m/s into hairpins": [
        {"trajectories": ("hairpins",), "conditions": "realtime", "seeds": range(10)}
    ],
    "friction falls by 45 % for 150 m": [{**_HALF_G, "conditions": _slippery(150.0, 300.0, 0.55)}],
    "15 m of ice": [{**_HALF_G, "conditions": _slippery(150.0, 165.0, 0.2)}],
    "slow actuators": [
        {
            "trajectories": HELD_OUT[:10], "conditions": "realtime",
            "vehicle_changes": {"max_steering_rate": 0.15, "max_jerk": 1.5},
        }
    ],
    "another mass and tyres": [
        {
            "trajectories": HELD_OUT[:10],
            "conditions": {
                **_TRUTH, "mass_factor": [0.7, 1.5], "inertia_factor": [0.7, 1.5],
                "front_stiffness_factor": [0.7, 1.3], "rear_stiffness_factor": [0.7, 1.3],
            },
        }
    ],
}  # fmt: skip
"""Regimes of the suite `limits`: arguments of `grid`, whose seeds are the fewest that are driven.

Friction 0.79 at 0.75 g of lateral acceleration is 95 % of the grip. At 0.55 g, a path cannot be
held at its planned speed where the friction drawn is below 0.55.
"""
STANDING = tuple(
    (name, arc_length)
    for name, last in (
        ("T1", 729), ("T2", 463), ("T3", 995), ("T4", 463), ("T5", 2097), ("T6", 1907),
        ("u-turn", 83),
    )
    for arc_length in range(7, last + 1, 38)
)  # fmt: skip
"""The 183 standing starts of `RECOVERY`, m: every 38 m, and 18 m or more before the end."""
BESIDE_PATHS = {"straight": 0, "circle": 0, "T3": 740}
"""Paths of the starts of `RECOVERY` beside the path, and where; 30 m before a bend on T3."""
OFFSETS = (-4.5, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.5)
"""m."""
DEGREES = (-80, -60, -40, -20, 0, 20, 40, 60, 80)
RECOVERY: dict[str, list[tuple[str, dict[str, float]]]] = {
    "standing starts": [(name, {"arc_length": s, "speed": 0.0}) for name, s in STANDING],
    **{
        f"beside {name}, {s} m": [
            (
                name,
                {
                    "arc_length": s, "lateral_error": offset,
                    "heading_error": round(math.radians(angle), 6),
                },
            )
            for offset in OFFSETS
            for angle in DEGREES
        ]
        for name, s in BESIDE_PATHS.items()
    },
}  # fmt: skip
"""Further regimes of the suite `limits`: paths and starts."""
REGIMES = (*LIMITS, *RECOVERY)
"""Names of all regimes, in the order of tables."""


def grid(
    agent_names: Iterable[str],
    trajectories: Iterable[str],
    *,
    vehicles: Iterable[str] = ("m2-minibus",),
    speed_modes: Iterable[str] = ("variable",),
    grips: Iterable[float] = (),
    seeds: Iterable[int] = (0,),
    **common: Any,
) -> list[Spec]:
    """Return every combination, the slowest agents first so that a pool ends evenly.

    In the speed mode "grip" each of `grips` is driven.
    """
    shares = [{"grip": grip} for grip in grips] or [{}]
    named = sorted(agent_names, key=lambda name: not _is_nmpc(name))
    return [
        {
            "agent": agent,
            "trajectory": trajectory,
            "vehicle": vehicle,
            "speed_mode": mode,
            "seed": seed,
            **(share if mode == "grip" else {}),
            **common,
        }
        for agent in named
        for vehicle in vehicles
        for mode in speed_modes
        for share in (shares if mode == "grip" else shares[:1])
        for trajectory in trajectories
        for seed in seeds
    ]


def quick(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:
    """Every agent on T2 and a U-turn: a minute."""
    return grid(agent_names, ("T2", "u-turn"), seeds=seeds)


def paper(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:
    """The paper's six in both speed modes, as raw waypoints, with another vehicle, in real time.

    To cut a corner of raw waypoints an agent must see it 3 s ahead, so agents get 30 preview steps
    of 0.1 s there, and learned policies, trained for 2 s, are left out. IPOPT's NMPC takes a
    hundred times as long as all others together and drives the six at variable speed alone;
    `converged` has the rest.
    """
    solved, fast = _by_speed(agent_names)
    specs = [
        *grid(agent_names, SIX, seeds=seeds),
        *grid(_far_seeing(fast), RAW, seeds=seeds, env_settings=RAW_PREVIEW),
        *grid(fast, SIX, speed_modes=("fixed",), seeds=seeds),
        *grid(fast, SIX, vehicles=PAPER_VEHICLES[1:], seeds=seeds),
        *realtime(fast, seeds),
    ]
    # The slow ones first, over all settings, so that no worker ends alone with one of them.
    return sorted(specs, key=lambda spec: spec["agent"] not in solved)


def realtime(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:
    """The six under the conditions of a real vehicle, with at least ten seeds for intervals."""
    return grid(agent_names, SIX, seeds=_several(seeds), conditions="realtime")


def learned(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:
    """Learned policies beside all others that do not solve to convergence.

    The six and unseen random paths, in simulation and under the conditions of a real vehicle, and
    the six in simulation from beside the path.
    """
    _, fast = _by_speed(agent_names)
    several = _several(seeds)
    return [
        *grid(fast, SIX, seeds=seeds),
        *grid(fast, SIX, seeds=several, env_settings=BESIDE),
        *realtime(fast, seeds),
        *grid(fast, HELD_OUT, seeds=seeds),
        *grid(fast, HELD_OUT, seeds=several, conditions="realtime"),
    ]


def converged(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:
    """IPOPT's NMPC beside the real-time one on the cases that `paper` has only of the latter."""
    solved, _ = _by_speed(agent_names)
    both = [name for name in agent_names if name in {*solved, "lpv-nmpc"}]
    specs = [
        *grid(both, RAW, seeds=seeds, env_settings=RAW_PREVIEW),
        *grid(both, SIX, speed_modes=("fixed",), seeds=seeds),
        *grid(both, SIX, vehicles=("course-car",), seeds=seeds),
    ]
    return sorted(specs, key=lambda spec: spec["agent"] not in solved)


def sideslip(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:
    """`course-car` with the limit |vy| <= 0.17 vx and with a wider one (errata, 5)."""
    solved = [name for name in agent_names if _is_nmpc(name)]
    car, wide = ("course-car",), {"max_lateral_velocity_ratio": 0.5}
    return [
        *grid(solved, SIX, vehicles=car, seeds=seeds),
        *grid(solved, SIX, vehicles=car, seeds=seeds, vehicle_changes=wide),
    ]


def frozen(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:  # noqa: ARG001
    """Both forms of the frozen LPV-MPC beside the NMPC; ignores the agents that are named."""
    return [
        *grid(("lpv-nmpc",), SIX, seeds=seeds),
        *grid((DEMONSTRATION,), SIX, seeds=seeds, agent_settings={"form": "literal"}),
        *grid((DEMONSTRATION,), SIX, seeds=seeds, agent_settings={"form": "sinc"}),
    ]


def independent(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:  # noqa: ARG001
    """The NMPC on independent vehicle models instead of its own; needs the extra `plants`."""
    return [
        spec
        for plant in plants.names()
        for spec in grid(
            ("lpv-nmpc",), SIX, vehicles=("bmw-320i",), seeds=seeds, env_settings={"plant": plant}
        )
    ]


def limits(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:
    """The regimes of `LIMITS` and `RECOVERY`, with every agent that does not solve to convergence.

    Paths of one regime have different seeds, so that no two drives share what is drawn; where
    nothing is drawn there is one seed.
    """
    _, fast = _by_speed(agent_names)
    specs = []
    for regime, grids in LIMITS.items():
        for one in grids:
            given = one.get("conditions", "simulation")
            drawn = (given if isinstance(given, str) else given["name"]) == "realtime"
            count = max(len(seeds), len(one.get("seeds", ()))) if drawn else 1
            for place, name in enumerate(one["trajectories"]):
                own = range(place * count, (place + 1) * count)
                specs += grid(fast, **{**one, "trajectories": (name,), "seeds": own}, regime=regime)
    specs += recovery(fast, (0,))
    return specs


def recovery(agent_names: Sequence[str], seeds: Sequence[int]) -> list[Spec]:
    """The regimes of `RECOVERY` alone."""
    _, fast = _by_speed(agent_names)
    return [
        spec
        for regime, starts in RECOVERY.items()
        for name, start in starts
        for spec in grid(fast, (name,), seeds=seeds, regime=regime, start=start)
    ]


def _several(seeds: Sequence[int]) -> Sequence[int]:
    return seeds if len(seeds) >= LEAST_SEEDS else range(LEAST_SEEDS)


def _far_seeing(agent_names: Iterable[str]) -> list[str]:
    return [name for name in agent_names if name not in LEARNED and not _near_sighted(name)]


def _near_sighted(name: str) -> bool:
    """Return whether an agent is a policy trained for another preview than `RAW_PREVIEW`.

    A policy is a file, or those of a folder of trainings.
    """
    one = first_training(name)
    if weights := one.get("agent_settings", {}).get("weights"):
        from agents.weight_tuning.policy import load

        policy: Any = load(Path(weights))
    elif one["agent"].endswith(".json"):
        from agents.learned.policy import read

        policy = read(one["agent"])
    else:
        return False
    # A schedule of weights has no preview.
    layout = getattr(policy, "layout", None)
    return layout is not None and {key: getattr(layout, key) for key in RAW_PREVIEW} != RAW_PREVIEW


def _is_nmpc(name: str) -> bool:
    """Return whether an agent is an NMPC of the family `lpv-nmpc`, or a folder of its tunings."""
    return str(first_training(name)["agent"]).startswith("lpv-nmpc")


def _by_speed(agent_names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the agents that solve to convergence at every step, and all others."""
    solved = [name for name in agent_names if name == "lpv-nmpc-ipopt"]
    return solved, [name for name in agent_names if name not in solved]


SUITES = {
    "paper": paper,
    "quick": quick,
    "sideslip": sideslip,
    "realtime": realtime,
    "learned": learned,
    "converged": converged,
    "frozen": frozen,
    "plants": independent,
    "limits": limits,
    "recovery": recovery,
}


def default_agents() -> list[str]:
    """Return the registered agents, without the demonstration."""
    return [name for name in agents.names() if name != DEMONSTRATION]
