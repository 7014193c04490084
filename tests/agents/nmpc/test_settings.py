"""Settings of the NMPC agents: weights given as mappings, signatures, errors in one line."""

import inspect
import math
from typing import Any

import casadi as ca
import numpy as np
import pytest

import agents
from agents.base import DrivingTask
from agents.nmpc import layout
from agents.nmpc.base import GROWTH, NmpcSettings, stages_of
from agents.nmpc.frozen import FrozenLpvMpc
from agents.nmpc.ipopt_agent import IpoptNmpc
from agents.nmpc.problem import NmpcProblem
from agents.nmpc.rti_agent import RtiNmpc
from agents.nmpc.rti_solver import RtiSolver
from agents.registry import agent_class
from agents.weight_tuning.agent import TunedNmpc
from agents.weights import TrackingWeights, WeightSchedule
from experiments.run.rollout import rollout
from lpv_track_env.bicycle import casadi_derivative
from lpv_track_env.conditions import IDEAL
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.observation import ObservationLayout
from lpv_track_env.vehicle import M2_MINIBUS, VEHICLES, VehicleParameters
from trajectories import CurvatureBands, ReferencePath

SET = {"Q": [1, 1, 20, 20], "S": [5, 5, 100, 100], "R": [0.01, 1]}
SCHEDULE = WeightSchedule(
    CurvatureBands((0.02,), ("straight", "sharp")),
    (TrackingWeights(), TrackingWeights(Q=(1, 1, 20, 20))),
    slew=2.0,
)
SHARED = set(inspect.signature(NmpcSettings).parameters)


@pytest.mark.parametrize("kind", [RtiNmpc, IpoptNmpc, FrozenLpvMpc, TunedNmpc])
def test_signatures_list_the_shared_settings(kind: Any) -> None:
    parameters = inspect.signature(kind).parameters
    missing = {"selection"} if kind is TunedNmpc else set()
    assert SHARED - set(parameters) == missing
    assert not any(one.kind is one.VAR_KEYWORD for one in parameters.values())
    assert parameters["max_failures"].default == 10


@pytest.mark.parametrize("name", ["lpv-nmpc", "lpv-nmpc-ipopt", "lpv-mpc-frozen", "lpv-nmpc-tuned"])
def test_misspelt_settings_are_named(name: str) -> None:
    env = PathTrackingEnv("T2")
    with pytest.raises(ValueError, match=r"has no setting 'horizn'; known: .*nearest: horizon"):
        agents.make(name, env, horizn=10)
    kind: Any = agent_class(name)
    with pytest.raises(TypeError, match=r"unknown argument 'horizn'; known: .*nearest: horizon"):
        kind(DrivingTask.of(env), horizn=10)


@pytest.mark.parametrize("name", ["lpv-nmpc", "lpv-nmpc-tuned"])
def test_weights_as_mappings_are_the_weights_themselves(name: str) -> None:
    env = PathTrackingEnv("T2")
    observation, _ = env.reset(seed=0, options={"lateral_error": 0.3})
    for mapping, weights in (
        (SET, TrackingWeights(Q=(1, 1, 20, 20), S=(5, 5, 100, 100), R=(0.01, 1))),
        ({"Q": (2, 2, 2, 2)}, TrackingWeights(Q=(2, 2, 2, 2))),
        (SCHEDULE.as_dict(), SCHEDULE),
    ):
        kept = dict(mapping)
        given, meant = (agents.make(name, env, weights=one) for one in (mapping, weights))
        actions = [agent.predict(observation)[0] for agent in (given, meant)]
        np.testing.assert_array_equal(*actions)
        assert mapping == kept


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"Q": [1, 1, 20]}, "weights: Q must be 4 numbers, each >= 0"),
        ({"S": [1, 1, 20, -1]}, r"weights: S\[3\] must be >= 0 and finite, not -1"),
        ({"R": [0.01, "heavy"]}, r"weights: R\[1\] must be >= 0 and finite, not 'heavy'"),
        ({"P": [1, 1, 1, 1]}, r"unknown matrix of weights 'P'; known: Q, S, R, R_rate \(nearest: "),
        ({**SCHEDULE.as_dict(), "weights": []}, "weights: 2 bands need as many sets, not 0"),
    ],
    ids=str,
)
@pytest.mark.parametrize("name", ["lpv-nmpc", "lpv-nmpc-ipopt", "lpv-nmpc-tuned"])
def test_bad_mappings_are_refused_in_one_line(
    name: str, mapping: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        agents.make(name, PathTrackingEnv("T2"), weights=mapping)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("settings", "stages"),
    [
        ({"stages": 0.1}, [0.1] * 20),
        ({"stages": 0.1, "horizon": 7}, [0.1] * 7),
        ({"horizon": 50}, [0.04] * 50),
        ({"horizon": 1}, [2.0]),
        ({"stages": 0.2}, [0.2] * 10),
        ({"stages": 0.3}, [0.3] * 6),
        ({"stages": 1}, [1.0] * 2),
        ({"stages": 0.05, "horizon": 30}, [0.05] * 30),
        ({"stages": [0.1, 0.4]}, [0.1, 0.4]),
        ({"stages": np.array([0.5, 1.5]), "horizon": 2}, [0.5, 1.5]),
    ],
    ids=str,
)
def test_stages_lie_within_the_preview(settings: dict[str, Any], stages: list[float]) -> None:
    agent: Any = agents.make("lpv-nmpc", PathTrackingEnv("T2"), **settings)
    np.testing.assert_allclose(agent.problem.periods, stages, rtol=1e-12)


@pytest.mark.parametrize("horizon", [None, 8, 15, 30])
@pytest.mark.parametrize(("control", "first"), [(0.01, 0.05), (0.05, 0.05), (0.1, 0.1)])
@pytest.mark.parametrize("preview", [(20, 0.1), (30, 0.2), (3, 0.1)])
def test_stages_grow_by_one_factor_to_the_end_of_the_preview(
    horizon: int | None, control: float, first: float, preview: tuple[int, float]
) -> None:
    seen = preview[0] * preview[1]
    stages = np.array(
        stages_of(NmpcSettings(horizon=horizon), ObservationLayout(*preview), control, M2_MINIBUS)
    )
    assert stages.sum() == pytest.approx(seen, rel=1e-9)
    assert horizon in {None, len(stages)}
    factors = stages[1:] / stages[:-1]
    np.testing.assert_allclose(factors, factors.mean(), rtol=1e-9)
    assert factors.mean() >= 1.0 - 1e-12
    if len(stages) * first < seen:
        assert stages[0] == pytest.approx(first)
    if horizon is None:
        # One stage less would have to grow faster.
        assert factors.mean() <= GROWTH + 1e-9
        less = stages_of(
            NmpcSettings(horizon=len(stages) - 1), ObservationLayout(*preview), control, M2_MINIBUS
        )
        assert less[1] / less[0] > GROWTH


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"stages": 0.1, "horizon": 21},
            r"21 stages, 2\.1 s, is longer .* 20 steps of 0\.1 s: .*preview_steps=21$",
        ),
        ({"stages": 0.11, "horizon": 20}, r"20 stages, 2\.2 s, .*preview_steps=22$"),
        ({"stages": (0.1,) * 19 + (0.11,)}, r"20 stages, 2\.01 s, .*preview_steps=21$"),
        ({"stages": 2.5}, r"1 stages, 2\.5 s, .*preview_steps=25$"),
        ({"stages": 1e-6}, "number of stages must be a whole number from 1 to 1,000, not 2000000"),
        ({"stages": 0.0}, "stages must be positive and at most 10 s, not 0.0"),
        ({"stages": float("nan")}, "stages must be positive and at most 10 s, not nan"),
        ({"stages": "long"}, "stages must be positive and at most 10 s, not 'long'"),
        ({"stages": ()}, "horizon must be a whole number from 1 to 1,000, not 0"),
        ({"stages": (0.1, -0.1)}, r"stages\[1\] must be positive and at most 10 s, not -0.1"),
        ({"stages": (0.1, 0.1), "horizon": 3}, "stages must be 3 numbers, each positive and"),
        ({"stages": np.ones((2, 2))}, r"stages\[0\] must be positive and at most 10 s, not \["),
    ],
    ids=str,
)
@pytest.mark.parametrize("name", ["lpv-nmpc", "lpv-nmpc-ipopt", "lpv-nmpc-tuned"])
def test_bad_stages_are_refused_in_one_line(
    name: str, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        agents.make(name, PathTrackingEnv("T2"), **settings)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) <= 300


def test_other_settings_are_checked() -> None:
    with pytest.raises(ValueError, match=r"selection must be 'band' or 'path', not 'bands'"):
        NmpcSettings(selection="bands")
    with pytest.raises(ValueError, match="weights must be weights, a schedule or its file, not"):
        NmpcSettings(weights=3)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["lpv-nmpc", "lpv-nmpc-ipopt", "lpv-mpc-frozen"])
def test_friction_is_the_environments_a_number_or_none(name: str) -> None:
    slippery = PathTrackingEnv("T2", conditions=IDEAL.replace(friction=0.5))
    between = PathTrackingEnv("T2", conditions=IDEAL.replace(friction=(0.4, 0.8)))
    for env, settings, wanted in (
        (PathTrackingEnv("T2"), {}, math.inf),
        (slippery, {}, 0.5),
        (between, {"friction": "known"}, 0.4),
        (slippery, {"friction": "linear"}, math.inf),
        (slippery, {"friction": 0.9}, 0.9),
    ):
        agent = agents.make(name, env, **settings)
        assert agent.problem.friction == wanted
        assert agent.grip == pytest.approx(0.88 * wanted * 9.81)
    for bad, message in (
        ("dry", r"friction 'dry'.*known, estimated, linear"),
        (0.0, r"friction must be in \[0.001, inf\]"),
        (math.nan, r"friction must be in \[0.001, inf\]"),
    ):
        with pytest.raises(ValueError, match=message):
            agents.make(name, slippery, friction=bad)


def test_inputs_are_bounded_by_what_the_tyres_follow() -> None:
    low, high = NmpcProblem(M2_MINIBUS, friction=0.2).input_bounds
    most = 1.2 * 0.95 * 0.2 * 9.81
    np.testing.assert_allclose([low[0], high[0]], [-most, most])
    dry = NmpcProblem(M2_MINIBUS, friction=1.0).input_bounds
    np.testing.assert_array_equal(dry, NmpcProblem(M2_MINIBUS).input_bounds)
    constants = RtiSolver(NmpcProblem(M2_MINIBUS, friction=0.2)).constants
    np.testing.assert_array_equal(constants[[layout.LOW_A, layout.HIGH_A]], [low[0], high[0]])


@pytest.mark.parametrize("car", VEHICLES.values(), ids=list(VEHICLES))
def test_steering_rate_weighs_lateral_jerk_at_speed(car: VehicleParameters) -> None:
    """The gain is that of a steady turn of the model, solved with CasADi's linearisation."""
    problem, weights = NmpcProblem(car), np.arange(1.0, 13.0)
    state, action = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    field = casadi_derivative(state, action, car)
    slopes = ca.Function(
        "slopes", [state, action], [ca.jacobian(field, state), ca.jacobian(field, action)]
    )
    highest = car.speed_range[1]
    for vx in (0.0, 2.0, 0.5 * highest, highest):
        gain = 0.0
        if vx > 0.0:
            by_state, by_input = slopes([vx, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0])
            lateral = np.array(by_state)[np.ix_([1, 3], [1, 3])]
            gain = -vx * np.linalg.solve(lateral, np.array(by_input)[[1, 3], 1])[1]
        scheduled = problem.weights_at(weights, vx)
        assert scheduled[11] == pytest.approx(12.0 * (1.0 + (gain / 30.0) ** 2), rel=1e-9)
        np.testing.assert_array_equal(scheduled[:11], weights[:11])
    assert weights[11] == 12.0


def test_positions_weigh_by_the_size_of_small_vehicles() -> None:
    full, small = (
        TrackingWeights.of(VEHICLES["m2-minibus"]),
        TrackingWeights.of(VEHICLES["f1tenth"]),
    )
    assert full == TrackingWeights()
    factor = (2.0 / 0.3302) ** 2
    assert np.array(small.Q) / full.Q == pytest.approx([1.0, 1.0, factor, factor])
    assert np.array(small.S) / full.S == pytest.approx([1.0, 1.0, factor, factor])
    assert (small.R, small.R_rate) == (full.R, full.R_rate)


def test_the_horizon_of_small_vehicles_is_shorter() -> None:
    agent: Any = agents.make("lpv-nmpc", PathTrackingEnv("T2", "f1tenth"))
    assert sum(agent.problem.periods) == pytest.approx(2.0 * math.sqrt(0.3302 / 2.0), rel=1e-3)
    assert agent.problem.periods[0] == pytest.approx(0.05)


@pytest.mark.parametrize("size", [3.0, 5.0, 7.0])
def test_a_small_car_does_not_swing_on_small_ovals(size: float) -> None:
    """Ellipses with radii of 1.1 to 2.5 m at 5 m/s^2, where coarse stages made it swing."""
    angle = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
    points = size * np.column_stack([np.cos(angle), 0.6 * np.sin(angle)])
    car = VEHICLES["f1tenth"]
    path = ReferencePath.from_waypoints(points, closed=True, vehicle=car, smoothing=0.0)
    env = PathTrackingEnv(path, car)
    driven = rollout(env, agents.make("lpv-nmpc", env), seed=0)
    assert driven.end == "finished"
    assert np.abs(driven.trace.lateral_error).max() < 0.03
