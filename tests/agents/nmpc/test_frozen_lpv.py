"""LPV-MPC with frozen matrices: exact where it should be, and what it leaves out."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import agents
from agents.nmpc import linearisation
from agents.nmpc.frozen import FORMS, FrozenLpvSolver, _held
from agents.nmpc.layout import DERIVATIVES, working_space
from agents.nmpc.problem import NmpcProblem, Status
from agents.nmpc.rti_solver import RtiSolver
from lpv_track_env.bicycle import derivative
from lpv_track_env.vehicle import M2_MINIBUS, VEHICLES
from tests.helpers.driven_vehicles import environment
from tests.helpers.nmpc_situations import hard


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=list(VEHICLES))
def test_both_forms_are_the_field(form: str, vehicle: Any) -> None:
    solver = FrozenLpvSolver(NmpcProblem(vehicle), form=form)
    rng = np.random.default_rng(0)
    for _ in range(500):
        x = rng.uniform([0.2, -2, -1.5, -1, -5, -5], [25, 2, 1.5, 1, 5, 5])
        u = rng.uniform([-5, -0.5], [3, 0.5])
        a, b, constant = solver._continuous(x, u, rng.uniform(-1, 1))
        wanted = derivative(x, u, vehicle)
        np.testing.assert_allclose(a @ x + b @ u + constant, wanted, rtol=1e-9, atol=1e-9)
        # What the two are about: whether a turn moves the car sideways.
        assert (a[4:, 2] != 0.0).all() == (form == "sinc")


def test_the_hold_is_exact() -> None:
    """Against SciPy's integrator of the frozen system."""
    solver = FrozenLpvSolver(NmpcProblem(M2_MINIBUS), form="sinc")
    x, u = np.array([7.0, 0.1, 0.2, 0.1, 1.0, -1.0]), np.array([0.5, 0.1])
    a, b, constant = solver._continuous(x, u, 0.05)
    ad, bd, offset = _held(a, b, constant, 0.05)
    flow = solve_ivp(
        lambda _, z: a @ z + b @ u + constant,
        (0.0, 0.05),
        x,
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
    )
    np.testing.assert_allclose(ad @ x + bd @ u + offset, flow.y[:, -1], rtol=1e-10, atol=1e-11)


def test_a_model_is_packed_as_it_is_unpacked() -> None:
    problem = NmpcProblem(M2_MINIBUS)
    case = hard(np.random.default_rng(1), problem)
    model = RtiSolver(problem).linearise(case.state, case.inputs)
    stages = working_space(20, 1)[0][0]
    linearisation.pack(model, case.inputs, stages)
    for one, other in zip(linearisation.unpacked(stages), model, strict=True):
        np.testing.assert_array_equal(one, other)
    assert stages[:-1, :DERIVATIVES].any(axis=0).all()


def test_a_true_linearisation_is_the_real_time_iterations_program() -> None:
    rng, problem = np.random.default_rng(2), NmpcProblem(M2_MINIBUS)
    solver = RtiSolver(problem)
    for _ in range(20):
        case = hard(rng, problem)
        status, inputs = solver.solve_qp(*case)
        model = solver.linearise(case.state, case.inputs)
        solution = solver.solve_model(model, *case[1:])
        assert status is solution.status is Status.SUCCESS
        assert solution.inputs is not None
        np.testing.assert_array_equal(solution.inputs, inputs)


def drive(env: gymnasium.Env, agent: agents.base.Agent) -> tuple[str, float, float]:
    """How an episode ends, rms lateral error m, steering variation rad."""
    observation, _ = env.reset(seed=0)
    errors, steering, begins, done = [], [], True, False
    while not done:
        action, _ = agent.predict(observation, episode_start=np.array([begins]))
        observation, _, terminated, truncated, info = env.step(action)
        errors.append(info["lateral_error"])
        steering.append(float(action[1]))
        begins, done = False, terminated or truncated
    variation = float(np.abs(np.diff(steering)).sum())
    return info["end"], float(np.sqrt(np.mean(np.square(errors)))), variation


def test_literal_form_weaves_and_the_other_form_drives() -> None:
    env = environment(trajectory="figure-eight")
    _, error, variation = drive(env, agents.make("lpv-nmpc", env))
    end, sinc_error, sinc_variation = drive(env, agents.make("lpv-mpc-frozen", env, form="sinc"))
    assert end == "finished"
    assert sinc_error < error + 0.002
    assert sinc_variation < 1.1 * variation
    _, literal_error, literal_variation = drive(env, agents.make("lpv-mpc-frozen", env))
    assert literal_error > 10.0 * error
    assert literal_variation > 3.0 * variation


def test_faults_are_reported() -> None:
    env = environment()
    with pytest.raises(ValueError, match=r"form.*literal, sinc"):
        agents.make("lpv-mpc-frozen", env, form="cosine")
    agent = agents.make("lpv-mpc-frozen", env)
    observation, _ = env.reset(seed=0)
    observation[3] = np.nan
    action, memories = agent.predict(observation)
    assert env.action_space.contains(action)
    assert agent.diagnostics(memories[0])["status"] == "NAN"  # type: ignore[attr-defined]
