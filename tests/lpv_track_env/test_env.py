"""The path tracking environment: the contract in its docstring, line by line."""

import copy
import inspect
import math
import pickle
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import PassiveEnvChecker
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import trajectories
from lpv_track_env import HIGHWAY_TRACK, PATH_TRACKING, WEIGHT_TUNING, kernels, vehicle
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.episodes import REWARD_KEYS
from lpv_track_env.highway.env import HighwayTrackEnv
from lpv_track_env.reward import TERMS, RewardWeights
from lpv_track_env.vector_env import PathTrackingVectorEnv
from lpv_track_env.vehicle import COURSE_CAR, M2_MINIBUS, VEHICLES
from trajectories import shapes
from trajectories.catalog import SHAPE_LIMITS

Array = NDArray[Any]
Step = tuple[Array, float, bool, bool, dict[str, Any]]

OPTIONS: dict[str, dict[str, Any]] = {
    "default": {},
    "fixed": {"speed_mode": "fixed"},
    "fixed-speed": {"speed_mode": "fixed", "fixed_speed": 4.0},
    "course-car": {"vehicle": "course-car"},
    "vehicle-object": {"vehicle": M2_MINIBUS.replace(mass=2800.0)},
    "raw": {"trajectory": "T2-raw"},
    "raw-fixed": {"trajectory": "T4-raw", "speed_mode": "fixed"},
    "closed": {"trajectory": "circle"},
    "crossing": {"trajectory": "figure-eight", "random_start": True},
    "random": {"trajectory": "random-3"},
    "straight": {"trajectory": "straight"},
    "fast-control": {"trajectory": "sine", "control_period": 0.02},
    "slow-control": {"trajectory": "sine", "control_period": 0.1},
    "one-node": {"trajectory": "u-turn", "preview_steps": 1},
    "far-preview": {"trajectory": "u-turn", "preview_steps": 50, "preview_period": 0.2},
    "errors": {"trajectory": "T2", "initial_error_range": (0.5, 0.1, 1.0)},
    "random-start": {
        "trajectory": "T2",
        "initial_error_range": (0.5, 0.1, 1.0),
        "random_start": True,
    },
    "narrow": {"trajectory": "double-lane-change", "max_lateral_error": 0.5},
    "short": {"trajectory": "straight", "time_limit": 0.2},
    "weights": {"trajectory": "straight", "reward_weights": RewardWeights(lateral=3.0, end=0.0)},
    "frames": {"trajectory": "u-turn", "render_mode": "rgb_array"},
}


def make(**settings: Any) -> PathTrackingEnv:
    env = gymnasium.make(PATH_TRACKING, **settings).unwrapped
    assert isinstance(env, PathTrackingEnv)
    return env


def drive(env: PathTrackingEnv, observation: Array, factor: float = 1.0) -> Array:
    """Feedforward of the preview and feedback, at `factor` of the reference speed."""
    o = env.layout.unpack(observation)
    car, vx = env.vehicle, max(float(o.longitudinal_speed), 1.0)
    ahead = max(round(0.2 / env.layout.preview_period), 1)
    curvature = float(o.preview_curvature[:ahead].mean())
    steering = (car.wheelbase + car.understeer_gradient * vx**2) * curvature
    steering -= 1.5 * float(o.heading_error) + 2.0 * float(o.lateral_error) / (1.0 + vx)
    wanted = factor * float(o.preview_speed[ahead - 1])
    a = car.rolling_deceleration + 1.5 * (wanted - float(o.longitudinal_speed))
    return np.array([a, steering], dtype=np.float32)


def episode(env: PathTrackingEnv, factor: float = 1.0, **options: float) -> list[Step]:
    """All steps of an episode under `drive`."""
    observation, _ = env.reset(seed=0, options=options)
    steps: list[Step] = []
    while not steps or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(drive(env, observation, factor)))
        observation = steps[-1][0]
    return steps


def assert_same(one: Step, other: Step) -> None:
    """Bit for bit."""
    np.testing.assert_array_equal(one[0], other[0])
    assert one[1:4] == other[1:4]
    first, second = dict(one[4]), dict(other[4])
    np.testing.assert_array_equal(first.pop("state"), second.pop("state"))
    assert first == second


# Other people's checkers ---------------------------------------------------------------------


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_gymnasium_check_env(options: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions are in SI units: scaling them is a learner's business.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized space")
        env = make(**options)
        # Every render mode is tried where the scene is this test's business.
        check_env(env, skip_render_check="render_mode" not in options)
        env.close()


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_stable_baselines_check_env(options: dict[str, Any]) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = make(**options)
    # warn=False: its advice that actions be scaled to [-1, 1] is a learner's business.
    checker.check_env(env, warn=False, skip_render_check=False)
    env.close()


def test_passive_checker_finds_nothing_in_an_episode() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(PATH_TRACKING, trajectory="u-turn", disable_env_checker=False)
        assert isinstance(env, PassiveEnvChecker)
        observation, _ = env.reset(seed=3)
        done = False
        while not done:
            inner = env.unwrapped
            assert isinstance(inner, PathTrackingEnv)
            observation, _, terminated, truncated, _ = env.step(drive(inner, observation))
            done = terminated or truncated


def test_module_qualified_id_needs_no_import(tmp_path: Path) -> None:
    code = (
        "import gymnasium\n"
        "name = 'lpv_track_env:lpv_track_env/PathTracking-v0'\n"
        "env = gymnasium.make(name, trajectory='straight')\n"
        "env.reset(seed=0)\n"
        "print(env.step(env.action_space.sample())[0].shape, env.spec.id)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120,
        check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == ["(48,)", "lpv_track_env/PathTracking-v0"]


def test_documented_arguments_are_the_arguments() -> None:
    documented = inspect.getdoc(PathTrackingEnv) or ""
    section = documented.split("## Arguments")[1].split("## Version history")[0]
    for name in ("trajectory", "vehicle", "speed_mode", "fixed_speed", "conditions",
                 "control_period", "preview_steps", "preview_period", "reward_weights",
                 "max_lateral_error", "time_limit"):  # fmt: skip
        assert name in section
        assert name in inspect.signature(PathTrackingEnv).parameters


@pytest.mark.parametrize(
    ("name", "argument", "nearest"),
    [
        (PATH_TRACKING, "contditions", "conditions"),
        (HIGHWAY_TRACK, "sceen", "scene"),
        (HIGHWAY_TRACK, "preview_stps", "preview_steps"),
        (HIGHWAY_TRACK, "fixed_speed", ""),
        (WEIGHT_TUNING, "choise", "choice"),
        (WEIGHT_TUNING, "plant", ""),
    ],
)
def test_an_unknown_argument_is_refused_with_the_nearest(
    name: str, argument: str, nearest: str
) -> None:
    expected = rf"unknown argument '{argument}'; known: .*\(nearest: {nearest}"
    with pytest.raises(TypeError, match=expected):
        gymnasium.make(name, **{argument: 1})
    if name != HIGHWAY_TRACK:
        with pytest.raises(TypeError, match=expected):
            gymnasium.make_vec(
                name, num_envs=2, vectorization_mode="vector_entry_point", **{argument: 1}
            )


@pytest.mark.parametrize("kind", [PathTrackingVectorEnv, HighwayTrackEnv])
def test_environments_around_it_have_its_arguments(kind: type) -> None:
    own, tracking = (
        inspect.signature(kind).parameters,
        inspect.signature(PathTrackingEnv).parameters,
    )
    for name in set(own) & set(tracking):
        assert own[name].default == tracking[name].default
    assert {"conditions", "control_period", "preview_steps", "time_limit"} <= set(own)


# Determinism ---------------------------------------------------------------------------------

NOISY = {
    "trajectory": "T2",
    "initial_error_range": (0.5, 0.1, 1.0),
    "random_start": True,
}


def rollout(env: PathTrackingEnv, actions: Array) -> list[Step]:
    return [env.step(action) for action in actions]


def smooth_actions(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform([-0.5, -0.05], [1.0, 0.05], (count, 2)).astype(np.float32)


def test_same_seed_same_episode() -> None:
    actions = smooth_actions(60)
    one, other = make(**NOISY), make(**NOISY)
    starts = [env.reset(seed=11) for env in (one, other)]
    np.testing.assert_array_equal(starts[0][0], starts[1][0])
    for first, second in zip(rollout(one, actions), rollout(other, actions), strict=True):
        assert_same(first, second)
    # The stream runs on alike, and differs from seed to seed and from episode to episode.
    following = [env.reset()[0] for env in (one, other)]
    np.testing.assert_array_equal(following[0], following[1])
    assert not np.array_equal(following[0], starts[0][0])
    assert not np.array_equal(one.reset(seed=12)[0], starts[0][0])
    np.testing.assert_array_equal(one.reset(seed=11)[0], starts[0][0])


@pytest.mark.parametrize("way", ["pickle", "deepcopy"])
def test_a_copy_made_in_mid_episode_goes_on_alike(way: str) -> None:
    env = make(**NOISY)
    env.reset(seed=5, options={"lateral_error": 0.3})
    actions = smooth_actions(60)
    rollout(env, actions[:30])
    clone = pickle.loads(pickle.dumps(env)) if way == "pickle" else copy.deepcopy(env)  # noqa: S301
    for one, other in zip(rollout(env, actions[30:]), rollout(clone, actions[30:]), strict=True):
        assert_same(one, other)
    np.testing.assert_array_equal(env.reset()[0], clone.reset()[0])


def test_a_copy_shares_nothing() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    clone = copy.deepcopy(env)
    before = env.state
    clone.step(np.array([1.0, 0.1], dtype=np.float32))
    np.testing.assert_array_equal(env.state, before)


def test_mirrored_path_and_actions_give_a_mirrored_episode() -> None:
    path = trajectories.load("random-3")
    left, right = make(trajectory=path), make(trajectory=path.mirrored())
    k = left.layout.preview_steps
    sign = np.concatenate([[1, -1, -1, 1, -1, -1, -1, 1], -np.ones(k), np.ones(k)])
    options = {"arc_length": 20.0, "lateral_error": 0.4, "heading_error": -0.1}
    observation, _ = left.reset(seed=0, options=options)
    mirrored_options = {"arc_length": 20.0, "lateral_error": -0.4, "heading_error": 0.1}
    mirrored, _ = right.reset(seed=0, options=mirrored_options)
    np.testing.assert_array_equal(mirrored, sign * observation)
    rng = np.random.default_rng(1)
    for _ in range(400):
        action = drive(left, observation) + rng.normal(0.0, [0.3, 0.03]).astype(np.float32)
        observation, reward, terminated, _, info = left.step(action)
        mirrored, other, ended, _, mirrored_info = right.step(action * np.float32([1.0, -1.0]))
        np.testing.assert_array_equal(mirrored, sign * observation)
        assert other == reward
        assert mirrored_info["clipped"] == info["clipped"]
        assert mirrored_info["lateral_error"] == -info["lateral_error"]
        assert terminated == ended
        if terminated:
            break
    assert info["arc_length"] > 100.0


# Actions -------------------------------------------------------------------------------------

BAD_ACTIONS: dict[str, tuple[Any, str]] = {
    "nan-acceleration": (np.array([math.nan, 0.0]), "entry 0 .acceleration. is not finite"),
    "inf-acceleration": (np.array([math.inf, 0.0], np.float32), "entry 0 .acceleration."),
    "nan-steering": (np.array([0.0, math.nan], np.float32), "entry 1 .steering angle. is not"),
    "inf-steering": ([0.0, -math.inf], "entry 1 .steering angle."),
    "short": (np.zeros(1, np.float32), "must be two numbers"),
    "long": (np.zeros(3, np.float32), "must be two numbers"),
    "scalar": (0.5, "must be two numbers"),
    "empty": (np.zeros(0), "must be two numbers"),
    "column": (np.zeros((2, 1)), "must be two numbers"),
    "row": (np.zeros((1, 2)), "must be two numbers"),
    "square": (np.zeros((2, 2)), "must be two numbers"),
    "none": (None, "must be two numbers"),
    "nones": ([None, None], "must be two numbers"),
    "text": ("ab", "must be two numbers"),
    "digits": ("12", "must be two numbers"),
    "texts": (["1", "2"], "must be two numbers"),
    "bytes": (b"12", "must be two numbers"),
    "complex": (np.array([1.0 + 1.0j, 0.0]), "must be two numbers"),
    "bools": (np.array([True, False]), "must be two numbers"),
    "dict": ({1: 0.0, 2: 0.0}, "must be two numbers"),
    "objects": (np.array([object(), object()]), "must be two numbers"),
    "ragged": ([0.0, [1.0]], "must be two numbers"),
    "huge": ([10**400, 0], "must be two numbers"),
    "record": (np.array((1.0, 0.0), dtype=[("a", float), ("b", float)]), "must be two numbers"),
    "dates": (np.array(["2000", "2001"], "M8[D]"), "must be two numbers"),
    "subclass-nan": (np.array([0.0, math.nan]).view(np.recarray), "entry 1 .steering angle."),
}


@pytest.mark.parametrize(("action", "message"), BAD_ACTIONS.values(), ids=BAD_ACTIONS.keys())
def test_bad_action_is_refused_and_changes_nothing(action: Any, message: str) -> None:
    env = make(trajectory="u-turn")
    env.reset(seed=0)
    env.step(np.array([0.5, 0.01], dtype=np.float32))
    untouched = copy.deepcopy(env)
    with pytest.raises(ValueError, match=message):
        env.step(action)
    good = np.array([0.3, 0.02], dtype=np.float32)
    assert_same(env.step(good), untouched.step(good))


GOOD_ACTIONS: dict[str, Any] = {
    "list": [0.4, 0.01],
    "tuple": (0.4, 0.01),
    "integers": [1, 0],
    "array-scalars": [np.float32(0.4), np.float64(0.01)],
    "float32": np.array([0.4, 0.01], np.float32),
    "float64": np.array([0.4, 0.01]),
    "float16": np.array([0.4, 0.01], np.float16),
    "int64": np.array([1, 0]),
    "uint8": np.array([1, 0], np.uint8),
    "big-endian": np.array([0.4, 0.01], ">f4"),
    "strided": np.array([0.4, 9.0, 0.01, 9.0], np.float32)[::2],
    "subclass": np.array([0.4, 0.01], np.float32).view(np.recarray),
}


@pytest.mark.parametrize("action", GOOD_ACTIONS.values(), ids=GOOD_ACTIONS.keys())
def test_any_two_real_numbers_are_an_action(action: Any) -> None:
    env, other = make(trajectory="u-turn"), make(trajectory="u-turn")
    env.reset(seed=0)
    other.reset(seed=0)
    wanted = other.step(np.array(action, dtype=np.float64))
    assert_same(env.step(action), wanted)
    # As the dynamics see it, and so neither swapped nor rounded.
    assert env._command[:2].tolist() == np.array(action, dtype=np.float64).tolist()


def test_a_readonly_action_is_taken_and_left_alone() -> None:
    env = make(trajectory="u-turn")
    env.reset(seed=0)
    action = np.array([0.4, 0.01], dtype=np.float32)
    action.flags.writeable = False
    env.step(action)
    assert action.tolist() == np.array([0.4, 0.01], dtype=np.float32).tolist()


def test_info_holds_plain_python_values_and_the_state() -> None:
    env = make(trajectory="u-turn")
    _, first = env.reset(seed=0)
    assert {first[key] for key in REWARD_KEYS} == {0.0}
    _, reward, terminated, truncated, info = env.step(np.array([0.4, 0.3], dtype=np.float32))
    for said in (first, info):
        assert type(said) is dict
        assert list(said) == [
            "lateral_error", "heading_error", "speed_error", "arc_length", "state", "clipped",
            *(f"reward_{name}" for name in TERMS), "end",
        ]  # fmt: skip
        state, clipped = said["state"], said["clipped"]
        assert isinstance(state, np.ndarray)
        assert (state.shape, state.dtype) == ((6,), np.float64)
        assert state.base is None
        assert {type(said[key]) for key in REWARD_KEYS} == {float}
        assert type(clipped) is int
        assert said["end"] == ""
        assert {type(said[name]) for name in list(said)[:4]} == {float}
    assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
    record = env._record
    for name in ("lateral_error", "heading_error", "speed_error", "arc_length", "clipped"):
        assert info[name] == record[getattr(kernels, name.upper())]
    assert info["clipped"] == kernels.RATE_STEERING
    assert [info[key] for key in REWARD_KEYS] == record[kernels.TERMS :][: len(TERMS)].tolist()
    assert reward == record[kernels.REWARD]
    np.testing.assert_array_equal(info["state"], record[:6])


@pytest.mark.parametrize("period", [0.02, 0.05, 0.1])
def test_rate_limits_are_exact(period: float) -> None:
    env = make(trajectory="straight", control_period=period)
    env.reset(seed=0)
    rolling = env.vehicle.rolling_deceleration
    for k in range(1, 4):
        *_, info = env.step(np.array([3.0, 0.5], dtype=np.float32))
        a, delta = env._record[[kernels.ACCELERATION, kernels.STEERING]]
        assert a == pytest.approx(rolling + k * 5.0 * period, abs=1e-12)
        assert delta == pytest.approx(k * math.pi / 300 / 0.02 * period, abs=1e-12)
        assert info["clipped"] == kernels.RATE_ACCELERATION + kernels.RATE_STEERING


def test_range_limits_and_their_bits() -> None:
    env = make(trajectory="circle", max_lateral_error=1000.0)
    env.reset(seed=0)
    for _ in range(25):
        observation, _, terminated, _, info = env.step(np.array([1e30, 1e30], dtype=np.float32))
        assert not terminated
    o = env.layout.unpack(observation)
    assert float(o.acceleration) == 3.5
    assert float(o.steering_angle) == pytest.approx(math.pi / 6, rel=1e-7)
    assert info["clipped"] == kernels.RANGE_ACCELERATION + kernels.RANGE_STEERING
    # The space's own corners are in range, whatever float32 makes of pi/6.
    *_, info = env.step(env.action_space.high)  # type: ignore[attr-defined]
    assert info["clipped"] == 0


@settings(deadline=None, max_examples=40)
@given(
    st.lists(
        st.tuples(st.floats(width=32, allow_nan=False, allow_infinity=False),
                  st.floats(width=32, allow_nan=False, allow_infinity=False)),
        min_size=1, max_size=30,
    )
)  # fmt: skip
def test_any_finite_actions_keep_the_observation_in_its_space(
    actions: list[tuple[float, float]],
) -> None:
    env = ANY_ACTIONS
    env.reset(seed=0)
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(np.float32(action))
        assert env.observation_space.contains(observation)
        assert math.isfinite(reward)
        assert np.isfinite(info["state"]).all()
        if terminated or truncated:
            break


ANY_ACTIONS = PathTrackingEnv(trajectory="u-turn")


# Order of calls ------------------------------------------------------------------------------


def test_step_before_reset_and_after_the_end() -> None:
    action = np.zeros(2, dtype=np.float32)
    env = make(trajectory="straight", time_limit=0.1)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\)"):
        env.step(action)
    env.reset(seed=0)
    env.step(action)
    assert env.step(action)[3]
    state = env.state
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\)"):
        env.step(action)
    np.testing.assert_array_equal(env.state, state)
    env.reset(seed=0)
    env.step(action)


def test_as_made_it_is_bare_and_keeps_the_order_of_calls_itself() -> None:
    """No wrapper of Gymnasium's stands before it: what they would refuse, it must."""
    env = gymnasium.make(PATH_TRACKING, trajectory="straight", render_mode="rgb_array")
    assert env.unwrapped is env
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) before step"):
        env.step(env.action_space.sample())
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) before render"):
        env.render()
    env.reset(seed=0)
    frame: Any = env.render()
    assert frame.shape == (600, 900, 3)
    env.close()


# Ends ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "end"),
    [
        ({"lateral_error": 20.0}, "left_corridor"),
        ({"lateral_error": -20.0}, "left_corridor"),
        ({"heading_error": math.pi}, "wrong_heading"),
        ({"heading_error": -2.0}, "wrong_heading"),
        ({"lateral_error": 20.0, "heading_error": math.pi, "speed": 0.0}, "left_corridor"),
        ({"lateral_error": 1e9}, "left_corridor"),
    ],
)
@pytest.mark.parametrize("trajectory", ["T2", "figure-eight"])
def test_hopeless_start_ends_with_a_reason(
    trajectory: str, options: dict[str, float], end: str
) -> None:
    env = make(trajectory=trajectory)
    observation, info = env.reset(seed=0, options=options)
    assert env.observation_space.contains(observation)
    assert info["end"] == ""
    observation, reward, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
    assert env.observation_space.contains(observation)
    assert math.isfinite(reward)
    assert (terminated, truncated, info["end"]) == (True, False, end)
    assert info["reward_end"] == -20.0


@pytest.mark.parametrize("speed", [0.0, -5.0, 40.0, 1e-9])
@pytest.mark.parametrize("name", VEHICLES)
def test_any_speed_stays_finite(name: str, speed: float) -> None:
    car = vehicle.load(name).replace(speed_range=(-5.0, 30.0))
    env = make(trajectory="circle", vehicle=car, max_lateral_error=1e6)
    reference = float(env.path.speed[0])
    env.reset(seed=0, options={"speed_error": speed - reference})
    assert env.state[0] == pytest.approx(speed, abs=1e-12)
    for action in smooth_actions(100):
        observation, reward, terminated, _, info = env.step(action * np.float32([1.0, 8.0]))
        assert env.observation_space.contains(observation)
        assert math.isfinite(reward)
        assert np.isfinite(info["state"]).all()
        if terminated:
            assert info["end"] in {"wrong_heading", "finished"}
            break


def test_absurd_speed_neither_hangs_nor_breaks() -> None:
    for trajectory in ("straight", "circle"):
        env = make(trajectory=trajectory)
        env.reset(seed=0, options={"speed_error": 1e12})
        observation, _, terminated, _, _ = env.step(np.zeros(2, dtype=np.float32))
        assert terminated
        assert env.observation_space.contains(observation)


def test_path_is_finished() -> None:
    steps = episode(make(trajectory="u-turn"))
    assert steps[-1][2:4] == (True, False)
    assert steps[-1][4]["end"] == "finished"
    assert steps[-1][4]["reward_end"] == 0.0
    assert all(info["end"] == "" for *_, info in steps[:-1])
    assert not any(terminated or truncated for _, _, terminated, truncated, _ in steps[:-1])


def test_time_limit_truncates() -> None:
    env = make(trajectory="straight", time_limit=1.0, control_period=0.1)
    steps = episode(env)
    assert len(steps) == 10
    assert steps[-1][2:4] == (False, True)
    assert steps[-1][4]["end"] == "time_limit"
    assert steps[-1][4]["reward_end"] == 0.0


def test_default_time_limit_is_half_as_much_again() -> None:
    env = make(trajectory="straight")
    wanted = 1.5 * env.path.duration + 10.0
    assert env.task.max_steps == math.ceil(wanted / 0.05)


def test_leaving_the_corridor_terminates() -> None:
    env = make(trajectory="straight", max_lateral_error=1.0)
    env.reset(seed=0)
    ends = []
    while not ends:
        *_, terminated, truncated, info = env.step(np.array([1.0, 0.05], dtype=np.float32))
        if terminated or truncated:
            ends = [terminated, truncated, info["end"]]
    assert ends == [True, False, "left_corridor"]
    assert 1.0 < info["lateral_error"] < 1.5


def test_state_that_is_no_longer_finite_terminates() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    # No action brings this about: the field's r vy must overflow.
    env._record[[1, 3]] = 1e200
    before = env.state
    observation, reward, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
    assert (terminated, truncated, info["end"]) == (True, False, "non_finite")
    assert env.observation_space.contains(observation)
    assert math.isfinite(reward)
    np.testing.assert_array_equal(info["state"], before)


@pytest.mark.parametrize("start", [0.0, 100.0])
def test_closed_path_is_one_lap(start: float) -> None:
    env = make(trajectory="circle")
    steps = episode(env, arc_length=start)
    assert steps[-1][4]["end"] == "finished"
    driven = steps[-1][4]["arc_length"] - start
    stride = env.path.speed.max() * env.control_period * 1.2
    assert env.path.length - 1e-9 <= driven < env.path.length + stride
    # Once round: the heading has turned by a full circle, unwrapped.
    assert steps[-1][4]["state"][2] - env.path.sample(start).heading == pytest.approx(
        2.0 * math.pi, abs=0.1
    )


def test_figure_eight_stays_on_the_local_branch() -> None:
    env = make(trajectory="figure-eight")
    steps = episode(env)
    assert steps[-1][4]["end"] == "finished"
    arc_lengths = np.array([info["arc_length"] for *_, info in steps])
    strides = np.diff(arc_lengths)
    assert strides.min() > 0.0
    assert strides.max() < env.path.speed.max() * env.control_period * 1.2
    # The other branch crosses at some 90 degrees: a foot point there would show.
    assert max(abs(info["heading_error"]) for *_, info in steps) < 0.5
    # It did pass the crossing, on both branches: the other branch was as near as this one.
    positions = np.array([info["state"][4:] for *_, info in steps])
    near = arc_lengths[np.hypot(*positions.T) < 1.0]
    assert np.ptp(near) > 0.4 * env.path.length


def test_vehicle_that_cannot_take_the_bend_fails_cleanly() -> None:
    """A bend of 5 m radius; at pi/6 the course's car turns on no less than about 9 m."""
    geometry = shapes.build(shapes.fit(shapes.parse("S 30 | L 180 r5 | S 30"), SHAPE_LIMITS))
    path = shapes.from_geometry(geometry, SHAPE_LIMITS, "tight")
    assert COURSE_CAR.wheelbase * np.abs(path.curvature).max() > math.tan(math.pi / 6)
    env = make(trajectory=path, vehicle="course-car", max_lateral_error=2.0)
    steps = episode(env)
    assert all(env.observation_space.contains(step[0]) for step in steps)
    assert any(step[4]["clipped"] & kernels.RANGE_STEERING for step in steps)
    assert steps[-1][4]["end"] == "left_corridor"


# Reset options -------------------------------------------------------------------------------


def test_reset_options_set_the_start() -> None:
    env = make(trajectory="T2")
    given_options = {
        "arc_length": 100.0, "lateral_error": 0.4, "heading_error": -0.2, "speed_error": 0.7,
    }  # fmt: skip
    _, info = env.reset(seed=0, options=given_options)
    for name, value in given_options.items():
        assert info[name] == pytest.approx(value, abs=1e-6), name
    at = env.path.sample(100.0)
    x, y = info["state"][4:]
    # Left of the path: on the side of the normal (-sin, cos).
    left = -(x - at.x) * math.sin(at.heading) + (y - at.y) * math.cos(at.heading)
    assert left == pytest.approx(0.4, abs=1e-9)
    assert info["state"][2] == pytest.approx(float(at.heading) - 0.2, abs=1e-9)
    assert info["state"][0] == pytest.approx(float(at.speed) + 0.7, abs=1e-9)


def test_reset_options_hold_for_one_episode() -> None:
    env = make(trajectory="T2")
    env.reset(seed=0, options={"trajectory": "circle", "vehicle": "course-car"})
    assert env.path.name == "circle"
    assert env.vehicle is COURSE_CAR
    for action in smooth_actions(5):
        assert env.step(action)[4]["arc_length"] > 0.0
    env.reset()
    assert env.path.name == "T2"
    assert env.vehicle is M2_MINIBUS
    # Parameters and paths themselves, for domain randomisation.
    heavy = M2_MINIBUS.replace(mass=4500.0)
    _, info = env.reset(options={"vehicle": heavy, "trajectory": trajectories.load("sine")})
    assert env.vehicle is heavy
    assert info["state"][1] == 0.0


def test_vehicle_option_changes_the_dynamics() -> None:
    env = make(trajectory="u-turn")
    action = np.array([0.5, 0.02], dtype=np.float32)
    env.reset(seed=0)
    light = env.step(action)
    env.reset(seed=0, options={"vehicle": M2_MINIBUS.replace(yaw_inertia=20000.0)})
    slow = env.step(action)
    assert abs(slow[4]["state"][3]) < abs(light[4]["state"][3])


def test_fixed_speed_holds_for_an_optional_trajectory() -> None:
    env = make(trajectory="T2", speed_mode="fixed", fixed_speed=3.0)
    env.reset(seed=0, options={"trajectory": "circle"})
    np.testing.assert_array_equal(env.path.speed, 3.0)


BAD_RESETS: dict[str, tuple[dict[str, Any], str]] = {
    "unknown": (
        {"lateral_eror": 1.0},
        r"unknown reset option 'lateral_eror'; known: trajectory.* \(nearest: lateral_error\)",
    ),
    "negative": ({"arc_length": -1.0}, "arc_length must be >= 0 and at most 200 m"),
    "beyond": ({"arc_length": 201.0}, "arc_length must be >= 0 and at most 200 m"),
    "nan": ({"heading_error": math.nan}, "heading_error must be in .*, not nan"),
    "inf": ({"speed_error": math.inf}, "speed_error must be in .*, not inf"),
    "text": ({"lateral_error": "left"}, "lateral_error must be in .*, not 'left'"),
    "none": ({"lateral_error": None}, "lateral_error must be in .*, not None"),
    "trajectory": ({"trajectory": "T7"}, "unknown trajectory 'T7'"),
    "vehicle": ({"vehicle": "tank"}, "unknown vehicle 'tank'"),
    "late": ({"trajectory": "T2", "lateral_error": math.nan}, "lateral_error must be in"),
    "reverse": (
        {"speed_error": -99.0},
        r"speed_error -99 m/s: .* start at -96 m/s, .*'m2-minibus' drives at 0 .* at least -3$",
    ),
    "reverse-there": ({"speed_error": -9.9, "arc_length": 200.0}, r"start at -6.9 m/s"),
    "reverse-speed": ({"speed": -0.5}, "speed -0.5 m/s: .* at least 0$"),
    "speed-twice": ({"speed": 1.0, "speed_error": 1.0}, "give one of them"),
}


@pytest.mark.parametrize(("options", "message"), BAD_RESETS.values(), ids=BAD_RESETS.keys())
def test_bad_reset_option_is_refused_and_the_episode_goes_on(
    options: dict[str, Any], message: str
) -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    env.step(np.array([0.5, 0.01], dtype=np.float32))
    untouched = copy.deepcopy(env)
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    action = np.array([0.3, 0.02], dtype=np.float32)
    assert_same(env.step(action), untouched.step(action))


def test_initial_errors_are_drawn_within_their_range() -> None:
    env = make(trajectory="straight", initial_error_range=(0.5, 0.1, 1.0), random_start=True)
    draws = np.array(
        [
            [info[key] for key in ("lateral_error", "heading_error", "speed_error", "arc_length")]
            for info in (env.reset(seed=seed)[1] for seed in range(200))
        ]
    )
    half = np.array([0.5, 0.1, 1.0])
    assert (np.abs(draws[:, :3]) <= half + 1e-9).all()
    assert (np.abs(draws[:, :3]).max(axis=0) > 0.9 * half).all()
    assert (np.abs(draws[:, :3].mean(axis=0)) < 0.2 * half).all()
    assert draws[:, 3].min() >= 0.0
    assert 0.7 * env.path.length < draws[:, 3].max() <= 0.8 * env.path.length + 1e-6


# Arguments -----------------------------------------------------------------------------------

BAD_ARGUMENTS: dict[str, tuple[dict[str, Any], str]] = {
    "trajectory": ({"trajectory": "T1raw"}, r"unknown trajectory 'T1raw'; known: T1.*nearest: T1"),
    "vehicle": ({"vehicle": "m2"}, r"unknown vehicle 'm2'; known: m2-minibus, course-car"),
    "speed_mode": (
        {"speed_mode": "fix"},
        r"unknown speed_mode 'fix'; known: variable, fixed, grip \(nearest: fixed\)",
    ),
    "speed_mode-none": ({"speed_mode": None}, "unknown speed_mode None"),
    "conditions": (
        {"conditions": "simulated"},
        r"unknown conditions 'simulated'; known: simulation.* \(nearest: simulation\)",
    ),
    "render_mode": (
        {"render_mode": "rgb"},
        r"unknown render_mode 'rgb'; known: human, rgb_array \(nearest: rgb_array\)",
    ),
    "fixed_speed": ({"fixed_speed": 5.0}, "fixed_speed needs speed_mode='fixed'"),
    "fixed_speed-zero": ({"speed_mode": "fixed", "fixed_speed": 0.0}, "fixed_speed must be posit"),
    "fixed_speed-nan": (
        {"speed_mode": "fixed", "fixed_speed": math.nan}, "fixed_speed must be positive",
    ),
    "grip": ({"grip": 0.8}, "grip needs speed_mode='grip'"),
    "grip-none": ({"speed_mode": "grip"}, "speed_mode='grip' needs grip, a share"),
    "grip-zero": ({"speed_mode": "grip", "grip": 0.0}, r"grip must be in \[0.05, 2\], not 0.0"),
    "grip-fixed": (
        {"speed_mode": "grip", "grip": 0.8, "fixed_speed": 5.0}, "fixed_speed needs speed_mode='f",
    ),
    "period": ({"control_period": 0.0}, r"control_period must be in \[0.001, 1\] s, not 0.0"),
    "period-nan": ({"control_period": math.nan}, "control_period must be in"),
    "preview": ({"preview_steps": 0}, "preview_steps must be a whole number from 1 to 1,000"),
    "preview_period": ({"preview_period": -1.0}, "preview_period must be positive and at"),
    "corridor": ({"max_lateral_error": 0.0}, "max_lateral_error must be positive"),
    "time_limit": ({"time_limit": -1.0}, "time_limit must be positive"),
    "time_limit-inf": ({"time_limit": math.inf}, "time_limit must be positive"),
    "errors": ({"initial_error_range": (1.0, 2.0)}, "initial_error_range must be 3 numbers"),
    "errors-negative": ({"initial_error_range": (1.0, -2.0, 0.0)}, "initial_error_range.+ must be"),
    "errors-nan": ({"initial_error_range": (math.nan, 0.0, 0.0)}, "initial_error_range.+ must be"),
    "errors-reverse": (
        {"initial_error_range": (0.0, 0.0, 99.0)},
        "an error of 99 m/s is more than any speed of path 'straight' .* at most 10 m",
    ),
    "errors-inf": ({"initial_error_range": (math.inf, 0.0, 0.0)}, "initial_error_range.+ must be"),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS.keys())
def test_bad_argument_is_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PathTrackingEnv(**{"trajectory": "straight", **arguments})


@pytest.mark.parametrize("name", list(RewardWeights.__dataclass_fields__))
def test_bad_reward_weight_is_named(name: str) -> None:
    for value in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match=f"reward weight {name} must be"):
            RewardWeights(**{name: value})
    if name.endswith("_scale"):
        with pytest.raises(ValueError, match=name):
            RewardWeights(**{name: 0.0})


def test_unknown_argument_is_refused() -> None:
    with pytest.raises(TypeError, match="control_perod"):
        make(control_perod=0.1)


def test_speed_beyond_the_vehicles_is_lowered_with_a_warning() -> None:
    path = trajectories.load("straight").with_speed(35.0)
    with pytest.warns(UserWarning, match="speed lowered to the vehicle's 30 m/s"):
        env = make(trajectory=path)
    assert env.path.speed.max() == 30.0
    assert "speed lowered" in env.path.metadata["warnings"][-1]


def right_angle(tmp_path: Path) -> Path:
    """Two straights of 50 m that meet at a right angle, every 5 m."""
    along = np.arange(0.0, 51.0, 5.0)
    points = [*((s, 0.0) for s in along), *((50.0, s) for s in along[1:])]
    file = tmp_path / "corner.csv"
    file.write_text("x,y\n" + "".join(f"{x},{y}\n" for x, y in points))
    return file


@pytest.mark.parametrize(
    ("changes", "limit"),
    [
        ({}, r"its limit \|vy\| <= 0.17 vx lets vehicle 'm2-minibus' turn on 10\.\d m or more"),
        ({"max_lateral_velocity_ratio": 0.5}, r"its steering angle of 0.524 rad .* on 6\.\d m"),
        ({"max_steering_angle": 0.2}, r"its steering angle of 0.2 rad .* on 16\.\d m"),
    ],
)
def test_a_bend_too_sharp_is_told_with_the_limit_that_binds(
    tmp_path: Path, changes: dict[str, float], limit: str
) -> None:
    file = right_angle(tmp_path)
    car = M2_MINIBUS.replace(**changes)
    with pytest.warns(UserWarning, match="bend of") as caught:
        make(trajectory=str(file), vehicle=car)
    texts = [str(one.message) for one in caught]
    assert len(texts) == 2
    assert "bend of 1.4 m radius at 50.1 m between points 5 m apart: more smoothing" in texts[0]
    assert re.search(rf"'corner': bend of 1.4 m radius at 50.1 m, {limit}", texts[1])


def test_a_bend_that_the_vehicle_takes_is_not_told(tmp_path: Path) -> None:
    nimble = M2_MINIBUS.replace(max_lateral_velocity_ratio=1.9, max_steering_angle=1.5,
                                rear_axle_distance=0.4, front_axle_distance=0.4,
                                implausible=True)  # fmt: skip
    with pytest.warns(UserWarning, match="more smoothing") as caught:
        make(trajectory=str(right_angle(tmp_path)), vehicle=nimble)
    assert len(caught) == 1


def test_frames_are_as_many_as_control_periods() -> None:
    for period, fps in ((0.02, 50), (0.05, 20), (0.1, 10)):
        assert make(trajectory="straight", control_period=period).metadata["render_fps"] == fps
    assert PathTrackingEnv.metadata["render_fps"] == 20


# Observation ---------------------------------------------------------------------------------


@pytest.mark.parametrize("trajectory", ["T2", "figure-eight", "T2-raw"])
def test_observation_says_what_the_contract_says(trajectory: str) -> None:
    env = make(trajectory=trajectory, preview_steps=15, preview_period=0.1)
    path, layout = env.path, env.layout
    observation, info = env.reset(seed=0, options={"lateral_error": 0.3, "heading_error": 0.1})
    for _ in range(300):
        o = layout.unpack(observation)
        vx, vy, psi, r, x, y = info["state"]
        s = info["arc_length"]
        foot = path.project(x, y, near=s)
        assert foot.arc_length == pytest.approx(s, abs=1e-3)
        np.testing.assert_allclose(
            [o.longitudinal_speed, o.lateral_speed, o.yaw_rate], [vx, vy, r], rtol=1e-6, atol=1e-9
        )
        lateral, heading = info["lateral_error"], info["heading_error"]
        assert float(o.lateral_error) == pytest.approx(lateral, rel=1e-6, abs=1e-9)
        assert float(o.heading_error) == pytest.approx(heading, rel=1e-6, abs=1e-9)
        assert lateral == pytest.approx(foot.lateral_error, abs=1e-5)
        turned = psi - foot.heading - heading
        assert math.cos(turned) == pytest.approx(1.0, abs=1e-6)
        assert float(o.reference_speed) == pytest.approx(float(path.sample(s).speed), rel=1e-6)
        assert info["speed_error"] == pytest.approx(vx - float(path.sample(s).speed), abs=1e-12)
        preview = path.preview(s, 0.1, 15)
        np.testing.assert_allclose(o.preview_curvature, preview.curvature, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(o.preview_speed, preview.speed, rtol=1e-6)
        observation, _, terminated, _, info = env.step(drive(env, observation))
        if terminated:
            break
    assert info["arc_length"] > 30.0


def test_observation_repeats_the_actuators() -> None:
    env = make(trajectory="straight")
    env.reset(seed=0)
    observation, *_ = env.step(np.array([0.3, -0.01], dtype=np.float32))
    o = env.layout.unpack(observation)
    assert float(o.acceleration) == pytest.approx(0.3)
    assert float(o.steering_angle) == pytest.approx(-0.01)


def test_signs() -> None:
    env = make(trajectory="u-turn")  # turns left
    observation, info = env.reset(
        seed=0, options={"arc_length": 55.0, "lateral_error": 0.2, "heading_error": 0.05}
    )
    o = env.layout.unpack(observation)
    assert float(o.lateral_error) > 0
    assert float(o.heading_error) > 0
    assert (o.preview_curvature > 0).all()
    assert info["lateral_error"] == pytest.approx(0.2, abs=1e-3)
    env = make(trajectory="straight")
    env.reset(seed=0)
    for _ in range(20):
        observation, *_ = env.step(np.array([0.2, 0.05], dtype=np.float32))
    o = env.layout.unpack(observation)
    # Steered left from a straight: turning left, pointing left, standing left.
    for entry in (o.steering_angle, o.yaw_rate, o.heading_error, o.lateral_error):
        assert float(entry) > 1e-3


def test_values_beyond_a_bound_saturate() -> None:
    racer = M2_MINIBUS.replace(speed_range=(1.0, 200.0), implausible=True)
    env = make(trajectory=trajectories.load("straight").with_speed(150.0), vehicle=racer)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    o = env.layout.unpack(observation)
    assert float(o.longitudinal_speed) == float(o.reference_speed) == 100.0
    np.testing.assert_array_equal(o.preview_speed, 100.0)
    assert info["state"][0] == 150.0


def test_what_is_handed_out_is_a_copy() -> None:
    env = make(trajectory="straight")
    first, first_info = env.reset(seed=0)
    kept, kept_state = first.copy(), first_info["state"].copy()
    second, _, _, _, second_info = env.step(np.array([1.0, 0.1], dtype=np.float32))
    assert not np.shares_memory(first, second)
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(first_info["state"], kept_state)
    second[:] = 7.0
    second_info["state"][:] = 7.0
    env.state[:] = 7.0
    assert env.state[0] < 4.0
    untouched = make(trajectory="straight")
    untouched.reset(seed=0)
    untouched.step(np.array([1.0, 0.1], dtype=np.float32))
    action = np.array([0.5, 0.0], dtype=np.float32)
    assert_same(env.step(action), untouched.step(action))


# Reward --------------------------------------------------------------------------------------


def test_reward_terms_are_the_documented_formulas() -> None:
    weights = RewardWeights(
        progress=1.1, lateral=0.9, heading=0.7, speed=0.6, input_rate=0.3, end=9.0,
        lateral_scale=0.4, heading_scale=0.3, speed_scale=0.8, jerk_scale=4.0,
        steering_rate_scale=0.6,
    )  # fmt: skip
    env = make(trajectory="u-turn", reward_weights=weights, max_lateral_error=1.0)
    _, info = env.reset(seed=0, options={"lateral_error": 0.2})
    before = info["arc_length"]
    a, delta = env.vehicle.rolling_deceleration, 0.0
    h = env.control_period

    def rho(z: float) -> float:
        return math.sqrt(1.0 + z * z) - 1.0

    terminated = False
    while not terminated:
        action = np.array([1.0 + 0.2 * (info["arc_length"] % 1.0), 0.04], dtype=np.float32)
        _, reward, terminated, _, info = env.step(action)
        new_a, new_delta = env._record[[kernels.ACCELERATION, kernels.STEERING]]
        reference = info["state"][0] - info["speed_error"]
        wanted = {
            "progress": 1.1 * (info["arc_length"] - before) / reference,
            "lateral": -0.9 * h * rho(info["lateral_error"] / 0.4),
            "heading": -0.7 * h * rho(info["heading_error"] / 0.3),
            "speed": -0.6 * h * rho(info["speed_error"] / 0.8),
            "input_rate": -0.3 * h * (((new_a - a) / h / 4.0) ** 2
                                      + ((new_delta - delta) / h / 0.6) ** 2),
            "end": -9.0 if terminated else 0.0,
        }  # fmt: skip
        assert tuple(wanted) == TERMS
        for name, value in wanted.items():
            assert info[f"reward_{name}"] == pytest.approx(value, rel=1e-9, abs=1e-12), name
        assert reward == pytest.approx(sum(info[key] for key in REWARD_KEYS), rel=1e-12)
        before, a, delta = info["arc_length"], float(new_a), float(new_delta)
    assert info["end"] == "left_corridor"


@pytest.mark.parametrize("period", [0.02, 0.05, 0.1])
def test_perfect_tracking_gives_one_a_second(period: float) -> None:
    env = make(trajectory="straight", speed_mode="fixed", fixed_speed=8.0, control_period=period)
    env.reset(seed=0)
    hold = np.array([env.vehicle.rolling_deceleration, 0.0])
    for _ in range(50):
        _, reward, terminated, _, info = env.step(hold)
        assert not terminated
        assert reward / period == pytest.approx(1.0, abs=1e-9)
        assert info["clipped"] == 0


@pytest.mark.parametrize("trajectory", ["T2", "circle", "straight"])
def test_driving_beats_parking_crawling_rushing_and_crashing(trajectory: str) -> None:
    env = make(trajectory=trajectory)

    def total(steps: list[Step]) -> float:
        return sum(reward for _, reward, *_ in steps)

    driven = episode(env)
    assert driven[-1][4]["end"] == "finished"
    duration = env.path.duration
    assert 0.9 * duration < total(driven) < 1.02 * duration

    env.reset(seed=0, options={"speed_error": -float(env.path.speed[0])})
    parked = []
    while not parked or not parked[-1][3]:
        parked.append(env.step(np.zeros(2, dtype=np.float32)))
        assert not parked[-1][2]
    assert abs(env.state[0]) < 1e-9
    assert total(parked) < 0.0

    env.reset(seed=0)
    crashed = []
    while not crashed or not crashed[-1][2]:
        crashed.append(env.step(np.array([1.0, -0.5], dtype=np.float32)))
    assert total(crashed) < 0.0

    best = total(driven)
    for factor in (0.5, 1.3):
        other = episode(env, factor)
        assert total(other) < best
