"""The real-time NMPC as an agent of batches: memories, weights, and observations of every kind."""

import subprocess
import sys
from typing import Any

import numba
import numpy as np
import pytest

import agents
from agents.nmpc import layout, rti
from agents.weights import TrackingWeights, WeightSchedule
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.observation import PREVIEW_START
from tests.helpers.driven_vehicles import drives, environment, made
from trajectories import CurvatureBands

BEGIN = np.array([True])


def most_threads() -> int:
    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


# Batches and memories ------------------------------------------------------------------------


ESTIMATED = {"friction": "estimated"}


@pytest.mark.parametrize("n", [1, 3, 17])
@pytest.mark.parametrize("threads", [1, min(2, most_threads())])
@pytest.mark.parametrize("settings", [{}, ESTIMATED], ids=str)
def test_batch_is_single_vehicles_bit_for_bit(
    n: int, threads: int, settings: dict[str, Any]
) -> None:
    rows, together = drives(n, 8), made(threads=threads, **settings)
    batches = [together.predict(row)[0] for row in rows]
    alone = made(**settings)
    for k in range(n):
        alone.reset()
        for step, row in enumerate(rows):
            action, _ = alone.predict(row[k])
            assert action.shape == (2,)
            assert action.dtype == np.float32
            np.testing.assert_array_equal(batches[step][k], action)


@pytest.mark.parametrize("n", [1, 3, 17])
@pytest.mark.parametrize("settings", [{}, ESTIMATED], ids=str)
def test_episode_start_clears_the_marked_rows_alone(n: int, settings: dict[str, Any]) -> None:
    # From the time on at which the steering no longer runs along its limits.
    agent, untouched, fresh = (made(**settings) for _ in range(3))
    rows = drives(n, 38)[30:]
    marked = np.arange(n) % 3 == 0
    for row in rows[:5]:
        agent.predict(row, None, np.zeros(n, dtype=bool))
        untouched.predict(row)
    for k, row in enumerate(rows[5:]):
        actions, _ = agent.predict(row, None, marked if k == 0 else np.zeros(n, dtype=bool))
        going_on, beginning = untouched.predict(row)[0], fresh.predict(row)[0]
        np.testing.assert_array_equal(actions[~marked], going_on[~marked])
        np.testing.assert_array_equal(actions[marked], beginning[marked])
        # In the row that begins its warm start is gone, so the actions do differ.
        if k == 0:
            assert (going_on[marked] != beginning[marked]).any()


def test_failures_of_one_row_are_not_anothers() -> None:
    rows, agent, healthy = drives(3, 8), made(max_failures=2), made(max_failures=2)
    report = []
    for k, row in enumerate(rows):
        lost = row.copy()
        if k >= 2:
            lost[1, 5] = np.nan
        if k >= 4:
            lost[2, 0] = np.inf
        actions, memory = agent.predict(lost, None, np.array([False, False, k == 7]))
        np.testing.assert_array_equal(actions[0], healthy.predict(row)[0][0])
        report.append([agent.diagnostics(memory[i])["fallback"] for i in range(3)])
    # Row 2 begins anew in the last step: no plan any more, one failure.
    assert [row[1] for row in report] == ["", "", "plan", "plan", "stop", "stop", "stop", "stop"]
    assert [row[2] for row in report] == ["", "", "", "", "plan", "plan", "stop", "stanley"]
    assert not any(row[0] for row in report)


def test_failures_are_found_in_every_threads_share() -> None:
    rows, alone, shared = drives(5, 4), made(), made(threads=min(2, most_threads()))
    for row in rows:
        lost = row.copy()
        lost[[0, 4], 5] = np.nan
        np.testing.assert_array_equal(alone.predict(lost)[0], shared.predict(lost)[0])
    memory = shared.predict(lost)[1]
    assert [shared.diagnostics(memory[k])["fallback"] for k in range(5)] == [
        "stanley", "", "", "", "stanley"
    ]  # fmt: skip


def test_control_of_one_row_of_a_batch_is_predict_of_that_row() -> None:
    sets = tuple(TrackingWeights(R=(0.01, scale)) for scale in (1.0, 3.0, 9.0, 27.0))
    schedule = WeightSchedule(CurvatureBands(), sets)
    rows, together, single = drives(3, 8), made(weights=schedule), made(weights=schedule)
    unpack = together.task.layout.unpack
    _, memory = single.predict(rows[0])
    together.predict(rows[0])
    for row in rows[1:]:
        row[1, 5] = np.nan
        wanted, reached = together.predict(row)
        for k in range(3):
            action = single.control(unpack(row[k]), memory[k])
            np.testing.assert_array_equal(np.float32(action), wanted[k])
            ours = single.diagnostics(memory[k])
            assert ours["fallback"] == together.diagnostics(reached[k])["fallback"]
        np.testing.assert_array_equal(memory.bands, reached.bands)
        np.testing.assert_array_equal(memory.plans, reached.plans)
        np.testing.assert_array_equal(memory.flags, reached.flags)
    assert ours["status"] == "SUCCESS"
    assert single.diagnostics(memory[1])["status"] == "NAN"


@pytest.mark.parametrize("threads", [0, -1, 10_000])
def test_impossible_threads_are_refused(threads: int) -> None:
    with pytest.raises(ValueError, match=rf"threads must be from 1 to \d+ .*, not {threads}"):
        made(threads=threads)


def test_nothing_is_compiled_within_a_control_period() -> None:
    """In a fresh process: making the agent compiles, or loads, all that its first call needs."""
    code = (
        "import gymnasium, lpv_track_env, agents\n"
        "from agents.nmpc import rti\n"
        "env = gymnasium.make('lpv_track_env/PathTracking-v0', trajectory='u-turn')\n"
        "observation, _ = env.reset(seed=0)\n"
        "agent = agents.make('lpv-nmpc', env)\n"
        "made = len(rti.control.signatures)\n"
        "agent.predict(observation)\n"
        "print(made, len(rti.control.signatures))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "1"]


def test_memories_are_handed_in_and_out() -> None:
    rows, agent, other = drives(3, 6), made(), made()
    # Two drives with one agent: what is handed in is written, its own memory is left alone.
    _, mine = agent.predict(rows[0], None, BEGIN)
    _, handed = other.predict(rows[1][::-1])
    wanted, twin = [made(), made()], []
    wanted[0].predict(rows[0])
    wanted[1].predict(rows[1][::-1])
    for row in rows[2:]:
        first, back = agent.predict(row)
        second, handed = agent.predict(row[::-1], handed)
        assert back is mine
        np.testing.assert_array_equal(first, wanted[0].predict(row)[0])
        np.testing.assert_array_equal(second, wanted[1].predict(row[::-1])[0])
        twin.append(handed)
    assert all(memory is twin[0] for memory in twin)
    assert len(handed) == 3
    # Of another size: it begins anew, as every agent does.
    actions, new = agent.predict(rows[3][:2], handed)
    np.testing.assert_array_equal(actions, made().predict(rows[3][:2])[0])
    assert len(new) == 2


def test_actions_and_diagnostics_handed_out_are_copies() -> None:
    rows, agent, untouched = drives(3, 5), made(), made()
    for row in rows:
        actions, memory = agent.predict(row)
        np.testing.assert_array_equal(actions, untouched.predict(row)[0])
        report = agent.diagnostics(memory[1])
        for value in (actions, report["plan"], report["slack"], report["weights"]):
            value[:] = 7.0


def test_diagnostics_of_a_row() -> None:
    rows, agent = drives(3, 2), made()
    for row in rows:
        _, memory = agent.predict(row)
    single = made()
    for k in range(3):
        single.reset()
        for row in rows:
            _, alone = single.predict(row[k])
        wanted, report = single.diagnostics(alone[0]), agent.diagnostics(memory[k])
        assert report.keys() == wanted.keys()
        assert report["status"] == "SUCCESS"
        assert report["plan"].shape == (16, 2)
        # The plan begins where the vehicle is, in the frame of the path's foot point.
        np.testing.assert_allclose(report["plan"][0], [0.0, rows[-1][k][5]])
        assert report["slack"].shape == (3,)
        for name in ("status", "iterations", "cost", "fallback"):
            assert report[name] == wanted[name]
    np.testing.assert_array_equal(agent.diagnostics(memory[-1])["plan"], report["plan"])
    with pytest.raises(IndexError, match="row 3 of 3"):
        memory[3]


@pytest.mark.parametrize("shape", [(47,), (49,), (3, 47), (0, 47), (2, 3, 48), (48, 1), ()])
def test_observations_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    agent = made()
    with pytest.raises(ValueError, match="this layout has 48 entries"):
        agent.predict(np.zeros(shape, dtype=np.float32))


def test_any_array_of_an_observation_does() -> None:
    """Other memory layouts and types act alike, and none has the solver compiled for it anew."""
    rows, agent = drives(3, 1)[0], made()
    wanted = agent.predict(rows)[0]
    known = len(rti.control.signatures)  # type: ignore[attr-defined]
    doubles = rows.astype(np.float64)
    fixed = doubles.copy()
    fixed.flags.writeable = False
    kinds = {
        "strided": np.repeat(rows, 2, axis=0)[::2], "Fortran's order": np.asfortranarray(rows),
        "double": doubles, "doubles, strided": np.repeat(doubles, 2, axis=1)[:, ::2],
        "read-only doubles": fixed, "list": rows.tolist(),
    }  # fmt: skip
    for name, same in kinds.items():
        actions, _ = agent.predict(same, None, np.ones(3, dtype=bool))
        np.testing.assert_array_equal(actions, wanted, err_msg=name)
        assert len(rti.control.signatures) == known, f"compiled anew for: {name}"  # type: ignore[attr-defined]


# Settings ------------------------------------------------------------------------------------


def test_new_weights_hold_from_the_next_step_and_keep_the_warm_start() -> None:
    rows, agent, heavy = drives(3, 4), made(), TrackingWeights(Q=(1.0, 1.0, 100.0, 100.0))
    born, old = made(weights=heavy), made()
    _, memory = agent.predict(rows[0])
    _, state = old.predict(rows[0])
    assert agent.set_weights(heavy)
    assert not np.array_equal(agent.predict(rows[1])[0], old.predict(rows[1])[0])
    # An agent made with these weights that goes on from the same memory does the same.
    _, state = old.predict(rows[0], None, BEGIN)
    actions, _ = agent.predict(rows[1], agent.predict(rows[0], None, BEGIN)[1])
    assert len(state) == len(memory) == 3
    old.set_weights(heavy)
    _, state = old.predict(rows[0], None, BEGIN)
    np.testing.assert_array_equal(born.predict(rows[1], state)[0], actions)


def test_schedule_by_band_chooses_for_every_row() -> None:
    """Each row is what an agent with that band's weights does."""
    sets = tuple(TrackingWeights(R=(0.01, scale)) for scale in (1.0, 3.0, 9.0, 27.0))
    schedule = WeightSchedule(CurvatureBands(), sets)
    rows, agent = drives(17, 1)[0], made(weights=schedule)
    actions, memory = agent.predict(rows)
    assert len(set(memory.bands)) > 1
    for k, (row, action, band) in enumerate(zip(rows, actions, memory.bands, strict=True)):
        fixed = made(weights=sets[band])
        wanted, alone = fixed.predict(row)
        np.testing.assert_array_equal(wanted, action)
        for report in (agent.diagnostics(memory[k]), fixed.diagnostics(alone[0])):
            np.testing.assert_array_equal(report["weights"], sets[band].as_array())
    broken = rows.copy()
    broken[0, PREVIEW_START] = np.nan
    assert np.isfinite(agent.predict(broken)[0]).all()


def test_control_period_shorter_than_the_previews() -> None:
    """It plans on stages of 0.1 s, acts every 0.05 s, and moves its plan on by halves."""
    env = environment(control_period=0.05, preview_period=0.1, preview_steps=15)
    agent = made(env, stages=0.1)
    np.testing.assert_array_equal(agent.problem.periods, [0.1] * 15)
    np.testing.assert_allclose(
        agent.problem.input_steps[:2, 0], agent.problem.vehicle.max_jerk * np.array([0.05, 0.1])
    )
    observation, info = env.reset(seed=0)
    lateral, clipped, done = [], 0, False
    while not done:
        action, memory = agent.predict(observation)
        assert agent.diagnostics(memory[0])["status"] == "SUCCESS"
        observation, _, terminated, truncated, info = env.step(action)
        lateral.append(abs(info["lateral_error"]))
        clipped += bool(info["clipped"])
        done = terminated or truncated
    assert info["end"] == "finished"
    assert max(lateral) < 0.05
    assert clipped == 0
    # Blind, it follows its last plan: each of its stages lasts two steps.
    env.reset(options={"arc_length": 40.0})
    observation, _ = env.reset(options={"arc_length": 40.0, "lateral_error": 0.3})
    _, memory = agent.predict(observation, None, BEGIN)
    plan, lost = memory.plans[0].copy(), observation.copy()
    lost[5] = np.nan
    followed = [agent.predict(lost)[0] for _ in range(4)]
    np.testing.assert_allclose(followed, plan[[0, 1, 1, 2]], rtol=1e-6)


UNEVEN = (0.03, 0.05, 0.05, *[0.1] * 5, 0.2, 0.3, 0.4)
"""Stages of 1.53 s, s."""


def test_stages_of_any_length() -> None:
    """They drive as the default ones do; a lost observation's action is that of its time."""
    env = environment()
    agent = made(env, stages=UNEVEN)
    observation, info = env.reset(seed=0)
    lateral, done = [], False
    while not done:
        action, memory = agent.predict(observation)
        assert agent.diagnostics(memory[0])["status"] == "SUCCESS"
        assert agent.diagnostics(memory[0])["plan"].shape == (12, 2)
        observation, _, terminated, truncated, info = env.step(action)
        lateral.append(abs(info["lateral_error"]))
        done = terminated or truncated
    assert info["end"] == "finished"
    assert max(lateral) < 0.05
    observation, _ = env.reset(options={"arc_length": 40.0, "lateral_error": 0.3})
    _, memory = agent.predict(observation, None, BEGIN)
    plan, lost = memory.plans[0].copy(), observation.copy()
    lost[5] = np.nan
    # At 0.05, 0.1, ... s; stages begin at 0, 0.03, 0.08, 0.13, 0.23, ... s.
    followed = [agent.predict(lost)[0] for _ in range(6)]
    np.testing.assert_allclose(followed, plan[[1, 2, 3, 3, 4, 4]], rtol=1e-6)


@pytest.mark.parametrize("settings", [{}, {"stages": UNEVEN}, {"friction": 0.1}], ids=str)
def test_the_compiled_problem_is_that_of_the_situation(settings: dict[str, Any]) -> None:
    """State and reference of a solve, which the solvers by CasADi get from Python."""
    agent = made(**settings)
    stages, lanes = (space[0] for space in layout.working_space(agent.problem.horizon, 1))
    for row in drives(17, 1)[0].astype(np.float64):
        for lateral in (row[5], 1.7, -6.0):
            row[5] = lateral
            state, _, reference = agent.situation(agent.task.layout.unpack(row))
            rti.load_observation(row, agent.solver.constants, stages, lanes)
            found = stages[:, layout.REFERENCE : layout.REFERENCE_Y + 1]
            np.testing.assert_allclose(found, reference, atol=1e-12)
            np.testing.assert_array_equal(stages[0, layout.PLAN_VX : layout.PLAN_Y + 1], state)


def test_compiled_weights_are_scheduled_as_the_problem_says() -> None:
    agent, scheduled = made(), np.zeros(layout.STAGE)
    weights = np.arange(1.0, 13.0)
    for vx in (-3.0, 0.0, 7.0, 29.0, 1e6):
        rti.schedule_weights(weights, vx, agent.solver.constants, scheduled)
        np.testing.assert_allclose(
            scheduled[:12], agent.problem.weights_at(weights, vx), rtol=1e-14
        )


def test_mirrored_observations_have_mirrored_actions() -> None:
    rows = drives(17, 2)
    sign = np.concatenate([[1, -1, -1, 1, -1, -1, -1, 1], -np.ones(20), np.ones(20)])
    for settings in ({}, {"stages": UNEVEN}):
        left, right = made(**settings), made(**settings)
        for row in rows:
            mirrored = right.predict(row * sign.astype(np.float32))[0]
            np.testing.assert_allclose(mirrored, left.predict(row)[0] * [1, -1], atol=1e-6)


@pytest.mark.parametrize(
    ("stages", "nodes"),
    [
        (None, 20), ((0.2,) * 10, 20), ((0.05,) * 40, 20), ((0.05,) * 10, 5), ((0.3,) * 4, 12),
        ((0.1, 0.02), 2), ((0.25,), 3), (UNEVEN, 16),
    ],
    ids=repr,
)  # fmt: skip
@pytest.mark.parametrize("name", ["lpv-nmpc", "lpv-nmpc-tuned"])
def test_bands_are_chosen_by_the_preview_that_the_stages_reach(
    name: str, stages: tuple[float, ...] | None, nodes: int
) -> None:
    schedule = WeightSchedule(
        CurvatureBands((0.05,), ("straight", "sharp")),
        (TrackingWeights(), TrackingWeights(R=(0.01, 5.0))),
    )
    env = environment(trajectory="straight")
    agent = agents.make(name, env, stages=stages, weights=schedule)
    observation, _ = env.reset(seed=0)
    for k in range(20):
        row = observation.copy()
        row[PREVIEW_START + k] = 0.1
        _, memory = agent.predict(row, episode_start=BEGIN)
        in_use = agent.diagnostics(memory[0])["weights"]
        np.testing.assert_array_equal(in_use, schedule.weights[k < nodes].as_array())


def test_horizon_shorter_than_the_preview() -> None:
    rows, agent = drives(3, 1)[0], made(stages=0.1, horizon=7)
    _, memory = agent.predict(rows)
    assert agent.diagnostics(memory[0])["plan"].shape == (8, 2)
    # What lies beyond the horizon is not looked at.
    changed = rows.copy()
    changed[:, PREVIEW_START + 7 : PREVIEW_START + 20] = 0.1
    np.testing.assert_array_equal(
        *(made(stages=0.1, horizon=7).predict(seen)[0] for seen in (changed, rows))
    )


@pytest.mark.parametrize(
    ("trajectory", "arc_length"),
    [("u-turn", 45.0), ("u-turn", 55.0), ("T6", 400.0), ("T2", 205.0), ("T3", 235.0)],
)
def test_it_drives_off_from_standstill_in_a_bend(trajectory: str, arc_length: float) -> None:
    env = PathTrackingEnv(trajectory)
    agent = agents.make("lpv-nmpc", env)
    observation, _ = env.reset(seed=0, options={"arc_length": arc_length, "speed": 0.0})
    for step in range(160):
        action, _ = agent.predict(observation, episode_start=np.array([step == 0]))
        observation, _, ended, _, info = env.step(action)
        # Without a reference that it can reach it cut the bends by 0.3 m.
        assert abs(info["lateral_error"]) < 0.1
        if ended:
            break
    assert info["speed_error"] > -0.5
