"""fatrop, with its own order of the NMPC's problem, against IPOPT."""

import casadi as ca
import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import agents
from agents.nmpc.casadi_solvers import IpoptSolver
from agents.nmpc.fatrop import FatropSolver
from agents.nmpc.problem import NmpcProblem, Status
from agents.weights import TrackingWeights
from lpv_track_env.vehicle import COURSE_CAR, M2_MINIBUS, VehicleParameters

Array = NDArray[np.float64]
ID = "lpv_track_env/PathTracking-v0"
WEIGHTS = TrackingWeights().as_array()

pytestmark = pytest.mark.skipif(
    not ca.has_nlpsol("fatrop"), reason="this CasADi was built without fatrop"
)


def problem(vehicle: VehicleParameters) -> NmpcProblem:
    # Unequal stages and penalties: no entry can stand in for another.
    return NmpcProblem(
        vehicle, horizon=12, first_period=0.03, stages=tuple(np.linspace(0.04, 0.09, 12)),
        linear_penalty=(20.0, 15.0, 25.0), quadratic_penalty=(100.0, 80.0, 120.0),
    )  # fmt: skip


def situation(rng: np.random.Generator, vehicle: VehicleParameters) -> tuple[Array, ...]:
    """State beside an arc, at times sharper than the sideslip's limit allows; weights."""
    speed, curvature = rng.uniform(2.5, 8.0), rng.uniform(-0.14, 0.14)
    sharpest = 0.9 * vehicle.max_steering_angle / vehicle.wheelbase
    curvature = np.sign(curvature) * min(abs(curvature), 2.0 / speed**2, sharpest)
    sideslip = vehicle.rear_axle_distance * curvature
    state = np.array(
        [speed + rng.normal(0, 0.4), speed * sideslip, -sideslip, speed * curvature, 0.0, 0.0]
    )
    state[2] += rng.normal(0, 0.05)
    state[5] += rng.normal(0, 0.3)
    # A command in force that no bound on the change lets go of in time breaks that on vx'.
    last = np.array([rng.uniform(-2.0, 3.0), vehicle.wheelbase * curvature])
    s = speed * problem(vehicle).times
    heading = curvature * s
    x, y = np.sin(heading) / curvature, (1 - np.cos(heading)) / curvature
    weights = WEIGHTS * np.exp(rng.uniform(-1, 1, 12))
    return state, last, np.column_stack([np.full(13, speed), heading, x, y]), weights


@pytest.mark.parametrize("vehicle", [M2_MINIBUS, COURSE_CAR], ids=lambda car: car.name)
def test_same_optimum_as_ipopt(vehicle: VehicleParameters) -> None:
    fatrop = FatropSolver(problem(vehicle), tolerance=1e-9)
    ipopt = IpoptSolver(problem(vehicle), tolerance=1e-10)
    rng = np.random.default_rng(7)
    same, broken = 0, 0.0
    for _ in range(20):
        parameters = situation(rng, vehicle)
        ours, _ = fatrop.solve(*parameters)
        theirs, _ = ipopt.solve(*parameters)
        assert theirs.status is Status.SUCCESS
        if ours.status is not Status.SUCCESS:
            # It says so, near the optimum: see the class on tolerances below 1e-6.
            assert ours.cost == pytest.approx(theirs.cost, rel=1e-5)
            continue
        if abs(ours.cost - theirs.cost) > 1e-8 * theirs.cost:
            # The problem is not convex: then it must be an optimum that IPOPT would keep.
            kept = ipopt.solve_from(ours, *parameters)
            assert kept.status is Status.SUCCESS
            assert ours.cost == pytest.approx(kept.cost, rel=1e-8)
            continue
        same += 1
        for name in ("inputs", "states", "slack"):
            mine, other = getattr(ours, name), getattr(theirs, name)
            assert mine.shape == other.shape
            np.testing.assert_allclose(mine, other, atol=1e-4, err_msg=name)
        np.testing.assert_allclose(ours.inputs[0], theirs.inputs[0], atol=1e-5)
        broken = np.maximum(broken, theirs.slack.max(axis=0))
    assert same >= 13
    # Soft constraints were in play, or their terms would have gone unchecked.
    assert broken[1] > 1e-2
    assert broken[2] > 1e-2


@pytest.fixture(scope="module")
def solver() -> FatropSolver:
    return FatropSolver(problem(M2_MINIBUS))


@pytest.mark.parametrize("entry", range(4))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_parameters_that_are_not_finite_have_status_nan(
    solver: FatropSolver, entry: int, value: float
) -> None:
    parameters = [part.copy() for part in situation(np.random.default_rng(0), M2_MINIBUS)]
    parameters[entry].flat[1] = value
    solution, warm = solver.solve(*parameters)
    assert solution.status is Status.NAN
    assert solution.inputs is None
    assert warm is None


def test_a_warm_start_does_not_change_the_answer(solver: FatropSolver) -> None:
    parameters = situation(np.random.default_rng(1), M2_MINIBUS)
    cold, warm = solver.solve(*parameters)
    again, _ = solver.solve(*parameters, warm)
    assert cold.status is again.status is Status.SUCCESS
    assert again.cost == pytest.approx(cold.cost, rel=1e-6)


def test_at_a_crawl_it_ends_with_a_status(solver: FatropSolver) -> None:
    state, last, reference, weights = situation(np.random.default_rng(2), M2_MINIBUS)
    for speed in (0.0, 0.05, 0.5):
        state[0] = speed
        solution, _ = solver.solve(state, last, reference, weights)
        assert isinstance(solution.status, Status)
        assert solution.inputs is None or np.isfinite(solution.inputs).all()


def test_the_agent_drives_alike_with_either_solver() -> None:
    env = gymnasium.make(ID, trajectory="u-turn")
    observation, _ = env.reset(options={"arc_length": 30.0, "lateral_error": 0.3})
    actions, statuses = [], []
    for name in ("ipopt", "fatrop"):
        agent = agents.make("lpv-nmpc-ipopt", env, solver=name, tolerance=1e-9)
        action, memory = agent.predict(observation, episode_start=np.array([True]))
        action, memory = agent.predict(observation, memory)
        actions.append(action)
        statuses.append(agent.diagnostics(memory[0])["status"])
    env.close()
    assert statuses == ["SUCCESS", "SUCCESS"]
    np.testing.assert_allclose(actions[0], actions[1], atol=1e-5)


def test_a_build_without_fatrop_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ca, "has_nlpsol", lambda _: False)
    env = gymnasium.make(ID, trajectory="straight")
    with pytest.raises(ValueError, match="without fatrop: say solver='ipopt'"):
        agents.make("lpv-nmpc-ipopt", env, solver="fatrop")
    with pytest.raises(ValueError, match="known: ipopt, fatrop"):
        agents.make("lpv-nmpc-ipopt", env, solver="fatrope")


@pytest.mark.parametrize("solver", ["fatrop", "ipopt"])
def test_from_rest_on_a_straight_it_drives_off(solver: str) -> None:
    """There the symmetric plan is a stationary point, at which fatrop used to stay."""
    env = gymnasium.make(ID, trajectory="T1")
    observation, _ = env.reset(seed=0, options={"arc_length": 7.0, "speed": 0.0})
    agent, memory = agents.make("lpv-nmpc-ipopt", env, solver=solver), None
    for step in range(3):
        action, memory = agent.predict(observation, memory, np.array([step == 0]))
        shown = agent.diagnostics(memory[0])
        assert shown["status"] == "SUCCESS"
        assert shown["plan"][-1, 0] > 2.0
        observation, *_ = env.step(action)
