"""The vector environment against Gymnasium's `SyncVectorEnv` over the single environment."""

import copy
import math
import os
import pickle
import subprocess
import sys
from typing import Any

import gymnasium
import numba
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

import trajectories
from lpv_track_env import PATH_TRACKING
from lpv_track_env.conditions import REALTIME
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import COURSE_CAR, M2_MINIBUS, VEHICLES
from tests.helpers.vector_equality import assert_equal, step_both

Array = NDArray[Any]

# Episodes of some 40 steps, with every way to end but the goal.
LIVELY: dict[str, Any] = {
    "trajectory": "figure-eight",
    "initial_error_range": (0.7, 0.3, 3.0),
    "random_start": True,
    "max_lateral_error": 0.8,
    "time_limit": 2.0,
}
MODES = tuple(AutoresetMode)


def make(n: int, **settings: Any) -> PathTrackingVectorEnv:
    return PathTrackingVectorEnv(n, **settings)


def sync(n: int, mode: AutoresetMode, **settings: Any) -> SyncVectorEnv:
    """Gymnasium's own: what is right by definition."""
    envs = [lambda: PathTrackingEnv(**settings)] * n
    return SyncVectorEnv(envs, autoreset_mode=mode)


def actions(n: int, steps: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform([-3.0, -0.2], [4.0, 0.2], (steps, n, 2)).astype(np.float32)


# Equality with single environments ------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("vehicle", VEHICLES)
@pytest.mark.parametrize("n", [1, 3, 17, 100])
def test_equals_gymnasiums_own(n: int, vehicle: str, mode: AutoresetMode) -> None:
    settings = {**LIVELY, "vehicle": vehicle}
    ours, theirs = make(n, autoreset_mode=mode, **settings), sync(n, mode, **settings)
    first, second = ours.reset(seed=5), theirs.reset(seed=5)
    assert_equal(first[0], second[0])
    assert_equal(first[1], second[1])
    ends: set[Any] = set()
    for action in actions(n, 150 if n < 100 else 60):
        *_, infos = step_both(ours, theirs, action, mode)
        final = infos.get("final_info", infos)
        ends |= set(final["end"][final["_end"]]) - {""}
    assert "left_corridor" in ends
    if n >= 17:
        assert "time_limit" in ends


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("estimator", ["ekf", "raw", "truth"])
def test_equals_gymnasiums_own_under_conditions(estimator: str, mode: AutoresetMode) -> None:
    """Two paths and two vehicles, drawn; estimates, brakes and misses are infos like others."""
    conditions = REALTIME.replace(estimator=estimator, computing_delay=(0.01, 0.07))
    settings = {**LIVELY, "conditions": conditions, "max_lateral_error": 1.5}
    for vehicle in VEHICLES:
        given = {**settings, "vehicle": vehicle}
        ours, theirs = make(9, autoreset_mode=mode, **given), sync(9, mode, **given)
        for one, other in zip(ours.reset(seed=5), theirs.reset(seed=5), strict=True):
            assert_equal(one, other)
        misses = 0
        for action in actions(9, 60):
            *_, infos = step_both(ours, theirs, action, mode)
            misses = max(misses, infos["deadline_misses"].max())
        assert misses > 0


def test_threads_change_nothing_under_conditions() -> None:
    settings = {
        **LIVELY, "trajectory": ["T2", "T4"], "vehicle": list(VEHICLES), "conditions": "realtime",
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }  # fmt: skip
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba sees one processor")
    one, two = make(70, **settings), make(70, threads=2, **settings)
    assert_equal(one.reset(seed=3)[0], two.reset(seed=3)[0])
    for action in actions(70, 40):
        for ours, theirs in zip(one.step(action), two.step(action), strict=True):
            assert_equal(ours, theirs)


@pytest.mark.parametrize("mode", MODES)
def test_ends_of_the_path_and_of_the_heading(mode: AutoresetMode) -> None:
    settings = {
        "trajectory": "u-turn", "random_start": True, "initial_error_range": (0.1, 1.6, 5.0),
        "control_period": 0.1, "preview_steps": 3, "preview_period": 0.7,
    }  # fmt: skip
    ours, theirs = make(40, autoreset_mode=mode, **settings), sync(40, mode, **settings)
    ours.reset(seed=1)
    theirs.reset(seed=1)
    ends = set()
    for action in actions(40, 60) * np.float32([0.2, 1.0]):
        *_, infos = step_both(ours, theirs, action, mode)
        final = infos.get("final_info", infos)
        ends |= set(final["end"][final["_end"]]) - {""}
    assert {"finished", "wrong_heading"} <= ends


@pytest.mark.parametrize("mode", MODES)
def test_states_that_are_no_longer_finite(mode: AutoresetMode) -> None:
    ours, theirs = make(5, autoreset_mode=mode, **LIVELY), sync(5, mode, **LIVELY)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    # No action brings this about: the field's r vy must overflow.
    ours.records[2, [1, 3]] = 1e200
    theirs.envs[2].unwrapped._record[[1, 3]] = 1e200
    *_, infos = step_both(ours, theirs, actions(5, 1)[0], mode)
    assert infos.get("final_info", infos)["end"][2] == "non_finite"
    for action in actions(5, 5):
        step_both(ours, theirs, action, mode)


def test_vehicles_with_different_substeps_in_one_block() -> None:
    """A light car whose poles at standstill ask for shorter steps, beside others."""
    stiff = COURSE_CAR.replace(mass=500.0, yaw_inertia=900.0)
    ours = make(40, vehicle=[stiff, M2_MINIBUS], autoreset_mode="Disabled", random_start=True)
    ours.reset(seed=3)
    assert len({task.substeps for task in ours.tasks}) == 2
    singles = []
    for i in range(40):
        singles.append(PathTrackingEnv(vehicle=ours.task_of(i).vehicle, random_start=True))
        singles[i].reset(seed=3 + i)
    assert {env.vehicle.name for env in singles} == {"course-car", "m2-minibus"}
    for action in actions(40, 20) * np.float32([0.1, 0.1]):
        observations, rewards, *_ = ours.step(action)
        for i, env in enumerate(singles):
            observation, reward, *_ = env.step(action[i])
            np.testing.assert_array_equal(observations[i], observation)
            assert rewards[i] == reward


@pytest.mark.parametrize("mode", MODES)
def test_threads_change_nothing(mode: AutoresetMode) -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba sees one processor")
    one = make(100, autoreset_mode=mode, **LIVELY)
    two = make(100, autoreset_mode=mode, threads=2, **LIVELY)
    assert_equal(one.reset(seed=9)[0], two.reset(seed=9)[0])
    for action in actions(100, 60):
        step_both(one, two, action, mode)


def test_episode_does_not_depend_on_the_number_of_environments() -> None:
    few, many = make(3, **LIVELY), make(70, **LIVELY)
    few.reset(seed=4)
    many.reset(seed=4)
    for action in actions(70, 90):
        np.testing.assert_array_equal(few.step(action[:3])[0], many.step(action)[0][:3])


def test_copies_go_on_alike() -> None:
    env = make(5, **LIVELY)
    env.reset(seed=2)
    for action in actions(5, 10):
        env.step(action)
    clones = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]  # noqa: S301
    for action in actions(5, 60, seed=1):
        wanted = env.step(action)
        for clone in clones:
            for ours, theirs in zip(wanted, clone.step(action), strict=True):
                assert_equal(ours, theirs)


# Resets -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [7, [7, 8, 3, 4], [1, None, 2, None]])
def test_seeds(seed: Any) -> None:
    mode = AutoresetMode.NEXT_STEP
    ours, theirs = make(4, **LIVELY), sync(4, mode, **LIVELY)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    for _ in range(2):
        assert_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
        assert_equal(ours.reset()[0], theirs.reset()[0])


def test_unseeded_resets_differ() -> None:
    one, other = make(3, **LIVELY), make(3, **LIVELY)
    first, second = one.reset()[0], other.reset()[0]
    assert len({row.tobytes() for row in (*first, *second)}) == 6
    assert not np.array_equal(one.reset()[0], first)


@pytest.mark.parametrize(
    "options",
    [
        {"arc_length": 30.0},
        {"lateral_error": 0.3, "heading_error": -0.1, "speed_error": 0.5},
        {"trajectory": "circle", "vehicle": "course-car", "arc_length": 10.0},
    ],
)
def test_reset_options(options: dict[str, Any]) -> None:
    mode = AutoresetMode.NEXT_STEP
    ours, theirs = make(4, **LIVELY), sync(4, mode, **LIVELY)
    for seed in (3, None):
        first = ours.reset(seed=seed, options=dict(options))
        second = theirs.reset(seed=seed, options=dict(options))
        assert_equal(first[0], second[0])
        assert_equal(first[1], second[1])
        # They hold for the episodes that begin; those after are the constructor's again.
        for action in actions(4, 90):
            step_both(ours, theirs, action, mode)
    assert_equal(ours.reset()[0], theirs.reset()[0])
    assert len(ours._packed) == len(ours.tasks)


def test_reset_options_for_some_environments() -> None:
    mode = AutoresetMode.DISABLED
    # Nothing ends, so every episode keeps the path it began with.
    settings = {**LIVELY, "max_lateral_error": 5.0, "time_limit": 60.0}
    ours, theirs = make(4, autoreset_mode=mode, **settings), sync(4, mode, **settings)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    for trajectory, marked in (("circle", [0, 2]), ("sine", [2]), ("circle", [1, 3]), (None, [2])):
        mask = np.isin(np.arange(4), marked)
        options = {} if trajectory is None else {"trajectory": trajectory}
        first, second = (
            env.reset(options={**options, "reset_mask": mask.copy()}) for env in (ours, theirs)
        )
        assert_equal(first[0], second[0])
        assert_equal(first[1], second[1])
        for action in 0.1 * actions(4, 3):
            step_both(ours, theirs, action, mode)
    names = [ours.task_of(i).path.name for i in range(4)]
    assert names == ["circle", "circle", "figure-eight", "circle"]
    assert [env.unwrapped.path.name for env in theirs.envs] == names  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"arc_length": -1.0}, ValueError, "arc_length must be >= 0"),
        ({"arc_lenght": 1.0}, ValueError, "unknown reset option 'arc_lenght'"),
        ({"trajectory": "T9"}, ValueError, "unknown trajectory 'T9'"),
        ({"reset_mask": [True, False]}, TypeError, "must be a NumPy array of dtype bool"),
        ({"reset_mask": np.array([1, 0])}, TypeError, "must be a NumPy array of dtype bool"),
        ({"reset_mask": np.array([True])}, ValueError, r"must have shape \(2,\), not \(1,\)"),
        ({"reset_mask": np.zeros(2, bool)}, ValueError, "must mark at least one"),
    ],
)
def test_bad_reset_changes_nothing(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    env = make(2, **LIVELY)
    env.reset(seed=0)
    untouched = copy.deepcopy(env)
    with pytest.raises(error, match=message):
        env.reset(options=options)
    with pytest.raises(ValueError, match="3 seeds for num_envs=2"):
        env.reset(seed=[1, 2, 3])
    for action in actions(2, 60):
        step_both(env, untouched, action, AutoresetMode.NEXT_STEP)


# Paths and vehicles drawn -----------------------------------------------------------------------


def test_paths_and_vehicles_are_drawn_by_environment_and_episode() -> None:
    names, cars = ["T1", "circle", trajectories.load("sine")], [M2_MINIBUS, COURSE_CAR]
    env = make(600, trajectory=names, vehicle=cars, time_limit=0.1)
    env.reset(seed=0)
    tasks = [env.task_of(i) for i in range(600)]
    drawn = [(task.path.name, task.vehicle.name) for task in tasks]
    counts = {pair: drawn.count(pair) for pair in drawn}
    # Six pairs, 100 each if uniform: five standard deviations are 46.
    assert len(counts) == 6
    assert min(counts.values()) > 54
    assert max(counts.values()) < 146
    for i in range(0, 600, 50):
        single = PathTrackingEnv(tasks[i].path, tasks[i].vehicle)
        np.testing.assert_array_equal(env.reset(seed=0)[0][i], single.reset(seed=i)[0])
    for action in actions(600, 3):
        env.step(action)
    again = [env.task_of(i).path.name for i in range(600)]
    assert again != [name for name, _ in drawn]
    few = make(7, trajectory=names, vehicle=cars, time_limit=0.1)
    few.reset(seed=0)
    for action in actions(7, 3):
        few.step(action)
    assert [few.task_of(i).path.name for i in range(7)] == again[:7]


def test_single_items_of_a_sequence_draw_nothing() -> None:
    settings = {**LIVELY, "trajectory": ["figure-eight"], "vehicle": ("m2-minibus",)}
    np.testing.assert_array_equal(
        make(4, **settings).reset(seed=0)[0], make(4, **LIVELY).reset(seed=0)[0]
    )


def test_one_table_for_all_vehicles() -> None:
    cars = [M2_MINIBUS.replace(mass=3000.0 + k) for k in range(50)]
    env = make(2, trajectory=["T1", "T2"], vehicle=cars)
    lengths = [len(trajectories.load(name).x) for name in ("T1", "T2")]
    assert len(env.arrays.tables) == sum(lengths)


def test_action_space_is_the_widest() -> None:
    narrow = M2_MINIBUS.replace(max_steering_angle=0.3, acceleration_range=(-6.0, 2.0))
    env = make(2, vehicle=[narrow, M2_MINIBUS])
    np.testing.assert_allclose(env.single_action_space.low, [-6.0, -math.pi / 6])  # type: ignore[attr-defined]
    np.testing.assert_allclose(env.single_action_space.high, [3.5, math.pi / 6])  # type: ignore[attr-defined]


# Contract -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_made_by_gymnasium(mode: AutoresetMode) -> None:
    env = gymnasium.make_vec(
        PATH_TRACKING, num_envs=3, vectorization_mode="vector_entry_point", trajectory="T2",
        autoreset_mode=mode,
    )  # fmt: skip
    assert isinstance(env, PathTrackingVectorEnv)
    assert env.metadata["autoreset_mode"] is mode
    theirs = sync(3, mode, trajectory="T2")
    for name in ("single_observation_space", "single_action_space", "observation_space",
                 "action_space", "num_envs", "render_mode"):  # fmt: skip
        assert getattr(env, name) == getattr(theirs, name), name
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert env.observation_space.contains(env.step(env.action_space.sample())[0])
    env.close()


def test_what_is_handed_out_is_a_copy() -> None:
    settings = {**LIVELY, "max_lateral_error": 5.0}
    for mode in MODES:
        env, untouched = (make(3, autoreset_mode=mode, **settings) for _ in range(2))
        results = [env.reset(seed=0)]
        untouched.reset(seed=0)
        for action in 0.1 * actions(3, 3):
            results.append(env.step(action)[::4])  # type: ignore[arg-type]
            untouched.step(action)
        for observation, infos in results:
            observation[:] = 7.0
            infos["state"][:] = 7.0
            infos["lateral_error"][:] = 7.0
        env.state[:] = 7.0
        if mode is AutoresetMode.DISABLED:
            mask = np.array([True, False, False])
            resets = [e.reset(options={"reset_mask": mask})[0] for e in (env, untouched)]
            np.testing.assert_array_equal(*resets)
        for action in 0.1 * actions(3, 3):
            np.testing.assert_array_equal(env.step(action)[0], untouched.step(action)[0])


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.array([[0, 0], [0, math.nan], [0, 0]]), "environment 1, entry 1 .steering angle., is"),
        (
            np.array([[0, 0], [0, 0], [math.inf, 0]]),
            "environment 2, entry 0 .acceleration., is not",
        ),
        (np.zeros((2, 2)), r"must be an array \(3, 2\) of numbers"),
        (np.zeros(2), r"must be an array \(3, 2\)"),
        (np.zeros((3, 2), dtype=bool), r"must be an array \(3, 2\)"),
        (np.zeros((3, 2), dtype=complex), r"must be an array \(3, 2\)"),
        ([["a", "b"]] * 3, r"must be an array \(3, 2\)"),
        ([[0.0, 0.0], [0.0], [0.0, 0.0]], r"must be an array \(3, 2\)"),
        (None, r"must be an array \(3, 2\)"),
    ],
)
def test_bad_actions_are_refused_and_change_nothing(action: Any, message: str) -> None:
    env = make(3, **LIVELY)
    env.reset(seed=0)
    untouched = copy.deepcopy(env)
    with pytest.raises(ValueError, match=message):
        env.step(action)
    for good in actions(3, 5):
        step_both(env, untouched, good, AutoresetMode.NEXT_STEP)


def test_action_that_is_ignored_may_be_anything() -> None:
    env, untouched = (make(2, **{**LIVELY, "time_limit": 0.05}) for _ in range(2))
    env.reset(seed=0)
    untouched.reset(seed=0)
    action = np.zeros((2, 2))
    assert env.step(action)[3].all()
    untouched.step(action)
    assert_equal(env.step(np.full((2, 2), math.nan))[0], untouched.step(action)[0])


def test_any_real_numbers_are_actions() -> None:
    one, other = (make(2, **LIVELY) for _ in range(2))
    one.reset(seed=0)
    other.reset(seed=0)
    assert_equal(one.step([[1, 0], [0, 0]])[0], other.step(np.array([[1.0, 0], [0, 0]]))[0])  # type: ignore[arg-type]


def test_order_of_calls() -> None:
    env = make(2, autoreset_mode="Disabled", time_limit=0.05)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) first"):
        env.step(np.zeros((2, 2)))
    env.reset(seed=0)
    assert env.step(np.zeros((2, 2)))[3].all()
    state = env.state
    with pytest.raises(gymnasium.error.ResetNeeded, match="environment 0 has ended"):
        env.step(np.zeros((2, 2)))
    np.testing.assert_array_equal(env.state, state)
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded, match="environment 1 has ended"):
        env.step(np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 0}, "num_envs must be a whole number from 1 to 1,000,000, not 0"),
        ({"trajectory": []}, "trajectory: an empty sequence"),
        ({"trajectory": ["T1", "T9"]}, "unknown trajectory 'T9'"),
        ({"vehicle": ["tank"]}, "unknown vehicle 'tank'"),
        ({"autoreset_mode": "Never"}, "unknown autoreset_mode 'Never'; known: NextStep, SameStep"),
        ({"threads": 0}, "threads must be from 1 to"),
        ({"threads": 10_000}, "threads must be from 1 to"),
        ({"render_mode": "human"}, "unknown render_mode 'human'; known: rgb_array"),
        ({"control_period": 0.0}, "control_period must be in"),
    ],
)
def test_bad_argument_is_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PathTrackingVectorEnv(**{"trajectory": "straight", **settings})


def test_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    env = make(2, trajectory="u-turn", render_mode="rgb_array", random_start=True)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) first"):
        env.render()
    env.reset(seed=0)
    frames = env.render()
    assert frames is not None
    assert [frame.shape for frame in frames] == [(600, 900, 3)] * 2
    assert all(frame.mean() > 0 for frame in frames)
    assert not np.array_equal(*frames)
    env.close()


def test_waiting_threads_do_not_spin() -> None:
    """The setting must stand before the first parallel kernel starts its threads."""
    code = (
        "import os\n"
        "from lpv_track_env.vector_env import PathTrackingVectorEnv\n"
        "PathTrackingVectorEnv(2, 'straight')\n"
        "print(os.environ.get('OMP_WAIT_POLICY'))\n"
        "PathTrackingVectorEnv(2, 'straight', threads=2)\n"
        "print(os.environ.get('OMP_WAIT_POLICY'))\n"
    )
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba sees one processor")
    variables = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True,
        env=variables,
    )  # fmt: skip
    assert done.stdout.split() == ["None", "passive"]


AFTER_FORK = """
import multiprocessing
import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv
from lpv_track_env import PATH_TRACKING
from lpv_track_env.vector_env import PathTrackingVectorEnv

fork = multiprocessing.get_context("fork")
env = PathTrackingVectorEnv(40, "straight", threads=2)
env.reset(seed=0)
action = np.full((40, 2), 0.1)
env.step(action)

def go_on(sent):
    sent.send([env.step(action)[0] for _ in range(3)])

received, sent = fork.Pipe(duplex=False)
child = fork.Process(target=go_on, args=(sent,))
child.start()
assert received.poll(100.0)
np.testing.assert_array_equal(received.recv(), [env.step(action)[0] for _ in range(3)])
child.join(10.0)
assert child.exitcode == 0

class Inside(gymnasium.Env):
    def __init__(self):
        self.many = PathTrackingVectorEnv(2, "straight", threads=2)
        self.observation_space = self.many.single_observation_space
        self.action_space = self.many.single_action_space

    def reset(self, **_):
        return self.many.reset(seed=0)[0][0], {}

    def step(self, action):
        observations, rewards, *_ = self.many.step(np.stack([action, action]))
        return observations[0], float(rewards[0]), False, False, {}

for make in (Inside, lambda: gymnasium.make(PATH_TRACKING, trajectory="straight")):
    many = AsyncVectorEnv([make, make], context="fork")
    many.reset(seed=0)
    _, rewards, *_ = many.step(np.zeros((2, 2), np.float32))
    print(*rewards)
    many.close()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_process_forked_after_threads_goes_on_in_one() -> None:
    """OpenMP would end it: `Terminating: fork() called from a process already using it`."""
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba sees one processor")
    done = subprocess.run(
        [sys.executable, "-c", AFTER_FORK], capture_output=True, text=True, timeout=200,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.split()) == 4
    # Once in the first child and in each of the two that have such an environment inside.
    assert done.stderr.count("continuing with threads=1") == 3
