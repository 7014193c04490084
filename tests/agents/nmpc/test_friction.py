"""Friction estimated while driving, against the bicycle on tyres of a known one."""

import copy
import math
import pickle
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import agents
from agents.nmpc import friction, layout
from lpv_track_env import tyres, vehicle
from lpv_track_env.bicycle import derivative
from lpv_track_env.conditions import IDEAL
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.observation import (
    ACCELERATION,
    LATERAL_SPEED,
    LONGITUDINAL_SPEED,
    STEERING_ANGLE,
    YAW_RATE,
)
from lpv_track_env.vehicle import VehicleParameters

PERIOD = 0.05
CARS = ("m2-minibus", "bmw-320i")


def made(car: str, known: Any = (0.3, 1.2)) -> Any:
    env = PathTrackingEnv("T2", vehicle=car, conditions=IDEAL.replace(friction=known))
    return agents.make("lpv-nmpc", env, friction="estimated")


def seen(state: NDArray[np.float64], a: float, delta: float) -> NDArray[np.float64]:
    """Return what the estimator reads of an observation, previews left out."""
    row = np.zeros(9)
    row[LONGITUDINAL_SPEED], row[LATERAL_SPEED], row[YAW_RATE] = state[0], state[1], state[3]
    row[ACCELERATION], row[STEERING_ANGLE] = a, delta
    return row


def slalom(
    car: VehicleParameters, grip: float, amplitude: float, seconds: float = 6.0
) -> list[NDArray[np.float64]]:
    """Drive the bicycle through a slalom that asks for `amplitude` of its grip; fine Euler steps.

    The plant is integrated on its own, without any code of the controller.
    """
    state, rows = np.array([15.0, 0.0, 0.0, 0.0, 0.0, 0.0]), []
    gain = amplitude * grip * 9.81 / state[0] ** 2
    held = 9.81 * car.rolling_resistance
    a = delta = 0.0
    for k in range(round(seconds / PERIOD)):
        rows.append(seen(state, a, delta))
        turn = gain * math.sin(2.0 * math.pi * k * PERIOD / 3.0)
        # Steering of a steady turn of that curvature: geometry and slip of linear tyres.
        share = car.mass * state[0] ** 2 / car.wheelbase
        slip = car.rear_axle_distance / car.front_cornering_stiffness
        slip -= car.front_axle_distance / car.rear_cornering_stiffness
        a, delta = held, turn * (car.wheelbase + share * slip)
        for _ in range(200):
            state = state + PERIOD / 200 * derivative(state, np.array([a, delta]), car, grip)
    return rows


def estimates(agent: Any, rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the records after each observation."""
    record, constants = np.zeros(friction.RECORD), agent.solver.constants.copy()
    found = []
    for row in rows:
        friction.estimate_friction(record, row, constants)
        assert constants[layout.TYRE : layout.TYRE + 6] == pytest.approx(
            tyres.of(agent.problem.vehicle, record[friction.MEAN]), rel=1e-12
        )
        assert constants[layout.GRIP] == pytest.approx(0.88 * 9.81 * record[friction.CAUTIOUS])
        found.append(record.copy())
    return np.array(found)


@pytest.mark.parametrize("car", CARS)
@pytest.mark.parametrize("grip", [0.4, 0.55, 0.8, 1.05])
def test_it_finds_the_friction_of_the_plant(car: str, grip: float) -> None:
    """The candidate nearest to the truth is the likeliest, and misses least of all."""
    found = estimates(made(car), slalom(vehicle.load(car), grip, 1.1))
    candidates = 0.3 * 4.0 ** (np.arange(friction.CANDIDATES) / (friction.CANDIDATES - 1))
    nearest = np.argmin(np.abs(np.log(candidates / grip)))
    logarithms = found[-1, friction.LOGARITHM : friction.MISS]
    assert np.argmax(logarithms) == nearest
    assert (np.diff(logarithms[: nearest + 1]) > 0.0).all()
    assert (np.diff(logarithms[nearest:]) < 0.0).all()
    begin, end = (abs(found[k, friction.MEAN] - grip) for k in (0, -1))
    assert end < begin
    assert found[-1, friction.CAUTIOUS] <= grip
    # Seldom is a likelier friction claimed than the truth, from the first slip on.
    later = found[40:, friction.LOGARITHM : friction.MISS]
    assert (later.max(axis=1) - later[:, nearest] < 0.5).all()


@pytest.mark.parametrize("car", CARS)
def test_without_slip_the_estimate_stays(car: str) -> None:
    agent, parameters = made(car), vehicle.load(car)
    straight = [
        seen(np.array([20.0 - 0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.0]), -2.0, 0.0) for k in range(100)
    ]
    still = estimates(agent, straight)
    assert not still[:, friction.LOGARITHM : friction.MISS].any()
    np.testing.assert_array_equal(still[:, friction.MEAN], still[0, friction.MEAN])
    both = estimates(agent, [*slalom(parameters, 0.5, 0.9), *straight])
    # The first observation of the straight does not continue the slalom.
    learned = both[-100:, friction.LOGARITHM : friction.MISS]
    np.testing.assert_array_equal(learned[1:], np.broadcast_to(learned[1], learned[1:].shape))


def test_an_observation_that_no_friction_explains_tells_none() -> None:
    agent = made("bmw-320i")
    rows = slalom(vehicle.load("bmw-320i"), 0.5, 0.9)
    rows[60][LATERAL_SPEED] += 5.0
    found = estimates(agent, rows)[:, friction.LOGARITHM : friction.MISS]
    for k in (60, 61):
        np.testing.assert_array_equal(found[k], found[k - 1])
    assert (found[62] != found[61]).any()


def test_the_range_is_the_environments_or_about_its_number() -> None:
    for known, least, most in (((0.4, 0.9), 0.4, 0.9), (0.6, 0.3, 0.9), (math.inf, 0.4, 1.2)):
        agent = made("m2-minibus", known)
        ends = agent.solver.constants[[layout.LEAST_FRICTION, layout.MOST_FRICTION]]
        assert ends == pytest.approx([least, most])
        row = np.zeros(agent.task.layout.size, dtype=np.float32)
        _, memory = agent.predict(row)
        assert least < agent.diagnostics(memory[0])["friction"] < most


def test_agents_that_cannot_estimate_say_so_in_one_line() -> None:
    env = PathTrackingEnv("T2")
    for name in ("lpv-nmpc-ipopt", "lpv-mpc-frozen"):
        with pytest.raises(ValueError, match="cannot estimate friction, only lpv-nmpc") as refused:
            agents.make(name, env, friction="estimated")
        assert "\n" not in str(refused.value)


def test_memories_are_copied_and_pickled_with_their_estimates() -> None:
    env = PathTrackingEnv("T2", vehicle="bmw-320i", conditions=IDEAL.replace(friction=0.5))
    agent = agents.make("lpv-nmpc", env, friction="estimated")
    observation, _ = env.reset(options={"arc_length": 60.0})
    memory = None
    for _ in range(30):
        action, memory = agent.predict(observation, memory)
        observation, *_ = env.step(action)
    assert memory is not None
    assert memory.frictions[0, friction.LOGARITHM : friction.MISS].any()
    copies = [copy.deepcopy(memory), pickle.loads(pickle.dumps(memory))]  # noqa: S301
    wanted, _ = agent.predict(observation, memory)
    for other in copies:
        action, after = agent.predict(observation, other)
        np.testing.assert_array_equal(action, wanted)
        np.testing.assert_array_equal(after.frictions, memory.frictions)
    # A lost observation breaks the chain: the next one is not compared with that before it.
    lost = observation.copy()
    lost[5] = np.nan
    agent.predict(lost, memory)
    assert memory.frictions[0, friction.BEGUN] == 0.0
    before = memory.frictions[0, friction.LOGARITHM : friction.MISS].copy()
    agent.predict(observation, memory)
    np.testing.assert_array_equal(memory.frictions[0, friction.LOGARITHM : friction.MISS], before)
