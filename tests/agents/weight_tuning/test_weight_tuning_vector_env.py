"""The vector environment of weights against Gymnasium's `SyncVectorEnv` over the single one."""

import copy
import pickle
from typing import Any

import gymnasium
import numba
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from agents.weight_tuning.choice import WeightChoice
from agents.weight_tuning.env import WeightTuningEnv, WeightTuningVectorEnv
from lpv_track_env import WEIGHT_TUNING
from tests.helpers.tuned_drives import CALM, CHOICES, LIVELY, random_actions
from tests.helpers.vector_equality import assert_equal, step_both

Array = NDArray[Any]
MODES = tuple(AutoresetMode)


def make(n: int, **settings: Any) -> WeightTuningVectorEnv:
    return WeightTuningVectorEnv(n, **{**LIVELY, **settings})


def sync(n: int, mode: AutoresetMode, **settings: Any) -> SyncVectorEnv:
    """Gymnasium's own: what is right by definition."""
    envs = [lambda: WeightTuningEnv(**{**LIVELY, **settings})] * n
    return SyncVectorEnv(envs, autoreset_mode=mode)


# Equality ------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
@pytest.mark.parametrize("n", [1, 7])
def test_equals_gymnasiums_own(n: int, conditions: str, mode: AutoresetMode) -> None:
    """Also over the episodes that follow; infos, masks and dtypes too."""
    settings = {"conditions": conditions, "choice": CHOICES["stages"]}
    ours, theirs = make(n, autoreset_mode=mode, **settings), sync(n, mode, **settings)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for one, other in zip(ours.reset(seed=5), theirs.reset(seed=5), strict=True):
        assert_equal(one, other)
    ends: list[Any] = []
    for action in random_actions(CHOICES["stages"], 30, n):
        if n > 1:
            action[0, 0] = np.nan
        *_, infos = step_both(ours, theirs, action, mode)
        final = infos.get("final_info", infos)
        ends += [end for end in final["end"][final["_end"]] if end]
    assert len(ends) > 2 * n
    if n > 1:
        assert set(ends) == {"left_corridor", "time_limit"}


@pytest.mark.parametrize("mode", MODES)
def test_a_catalogue_equals_gymnasiums_own(mode: AutoresetMode) -> None:
    settings = {"choice": CHOICES["catalogue"]}
    ours, theirs = make(4, autoreset_mode=mode, **settings), sync(4, mode, **settings)
    for one, other in zip(ours.reset(seed=5), theirs.reset(seed=5), strict=True):
        assert_equal(one, other)
    for action in random_actions(CHOICES["catalogue"], 20, 4):
        step_both(ours, theirs, action, mode)


def test_threads_and_numbers_change_nothing() -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:  # type: ignore[attr-defined]
        pytest.skip("numba sees one processor")
    settings = {"trajectory": ["T2", "T4"], "vehicle": ["m2-minibus", "course-car"]}
    settings["autoreset_mode"] = "SameStep"
    one, two, few = make(20, **settings), make(20, threads=2, **settings), make(3, **settings)
    first = one.reset(seed=3)
    for ours, theirs in zip(first, two.reset(seed=3), strict=True):
        assert_equal(ours, theirs)
    np.testing.assert_array_equal(few.reset(seed=3)[0], first[0][:3])
    for action in random_actions(WeightChoice(), 20, 20):
        result = one.step(action)
        for ours, theirs in zip(result, two.step(action), strict=True):
            assert_equal(ours, theirs)
        for ours, theirs in zip(result[:4], few.step(action[:3])[:4], strict=True):
            np.testing.assert_array_equal(ours[:3], theirs)
    drawn = [two.drives.task_of(i) for i in range(20)]
    assert len({(task.path.name, task.vehicle.name) for task in drawn}) == 4


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
def test_what_is_seen_at_the_time_limit_is_what_would_be_seen(conditions: str) -> None:
    """A learner bootstraps from it. On a circle no band ends a window before its time."""
    settings = {**CALM, "conditions": conditions, "trajectory": "circle"}
    short = make(5, **{**settings, "time_limit": 0.8}, autoreset_mode="SameStep")
    long = make(5, **settings, autoreset_mode="SameStep")
    short.reset(seed=1)
    long.reset(seed=1)
    for action in random_actions(short.choice, 2, 5):
        *_, truncated, infos = short.step(action)
        wanted, *_ = long.step(action)
    assert truncated.all()
    np.testing.assert_array_equal(np.stack(infos["final_obs"]), wanted)


def test_copies_go_on_alike() -> None:
    env = make(4)
    env.reset(seed=2)
    actions = random_actions(env.choice, 30, 4)
    for action in actions[:5]:
        env.step(action)
    clones = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]  # noqa: S301
    for action in actions[5:]:
        wanted = env.step(action)
        for clone in clones:
            for ours, theirs in zip(wanted, clone.step(action), strict=True):
                assert_equal(ours, theirs)


# Contract ------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_made_by_gymnasium(mode: AutoresetMode) -> None:
    env = gymnasium.make_vec(
        WEIGHT_TUNING, num_envs=3, vectorization_mode="vector_entry_point", trajectory="T2",
        autoreset_mode=mode,
    )  # fmt: skip
    assert isinstance(env, WeightTuningVectorEnv)
    assert env.metadata["autoreset_mode"] is mode
    assert env.metadata["render_fps"] == 2
    assert env.reset(seed=0)[0] in env.observation_space
    assert env.step(env.action_space.sample())[0] in env.observation_space


def test_an_ended_environments_action_is_ignored_in_next_step() -> None:
    env = make(3, **{**CALM, "time_limit": 0.4, "trajectory": "circle"})
    env.reset(seed=0)
    assert env.step(np.zeros((3, 3)))[3].all()
    observations, rewards, terminated, truncated, infos = env.step(np.full((3, 3), np.nan))
    assert not (terminated | truncated).any()
    assert not rewards.any()
    assert not infos["rejected"].any()
    assert not infos["solves"].any()
    assert observations in env.observation_space


def test_reset_needed_in_disabled() -> None:
    env = make(3, autoreset_mode="Disabled", time_limit=0.4, max_lateral_error=5.0)
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\) first"):
        env.step(np.zeros((3, 3)))
    env.reset(seed=0)
    ended = np.zeros(3, dtype=bool)
    while not ended.any():
        _, _, terminated, truncated, _ = env.step(np.zeros((3, 3)))
        ended = terminated | truncated
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset_mask"):
        env.step(np.zeros((3, 3)))
    env.reset(options={"reset_mask": ended})
    env.step(np.zeros((3, 3)))


def test_an_empty_mask_is_all() -> None:
    """`reset_mask` of None: every environment begins anew, its NMPC and its table forgotten."""
    one, other = make(2, **CALM), make(2, **CALM)
    for env in (one, other):
        env.reset(seed=0)
        env.step(np.ones((2, 3)))
    assert_equal(one.reset(seed=4, options={"reset_mask": None})[0], other.reset(seed=4)[0])
    for _ in range(3):
        assert_equal(one.step(np.zeros((2, 3)))[0], other.step(np.zeros((2, 3)))[0])


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"arc_length": -1.0}, ValueError, "arc_length must be >= 0"),
        ({"arc_lenght": 1.0}, ValueError, "unknown reset option 'arc_lenght'"),
        ({"reset_mask": [True, False]}, TypeError, "must be a NumPy array of dtype bool"),
        ({"reset_mask": np.zeros(2, bool)}, ValueError, "must mark at least one"),
    ],
)
def test_bad_resets_and_actions_change_nothing(
    options: dict[str, Any], error: type[Exception], message: str
) -> None:
    env = make(2)
    env.reset(seed=0)
    untouched = copy.deepcopy(env)
    with pytest.raises(error, match=message):
        env.reset(seed=3, options=options)
    with pytest.raises(ValueError, match="3 seeds for num_envs=2"):
        env.reset(seed=[1, 2, 3])
    for wrong in (np.zeros((2, 2)), np.zeros(3), [[0.0] * 3, [0.0]], np.zeros((2, 3), complex)):
        with pytest.raises(ValueError, match=r"^actions must be an array \(2, 3\) .* not"):
            env.step(wrong)
    assert env.np_random_seed == untouched.np_random_seed
    for action in random_actions(env.choice, 12, 2):
        step_both(env, untouched, action, AutoresetMode.NEXT_STEP)


@pytest.mark.parametrize("seed", [7, [7, 8, 3, 4], [1, None, 2, None]])
def test_seeds_and_options(seed: Any) -> None:
    ours, theirs = make(4), sync(4, AutoresetMode.NEXT_STEP)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    for options in ({}, {"trajectory": "circle", "vehicle": "course-car", "lateral_error": 0.2}):
        results = [env.reset(seed=seed, options=dict(options)) for env in (ours, theirs)]
        assert_equal(results[0][0], results[1][0])
        assert_equal(results[0][1], results[1][1])
        for action in random_actions(ours.choice, 8, 4):
            step_both(ours, theirs, action, AutoresetMode.NEXT_STEP)


def test_solves_are_all_that_were_asked_for() -> None:
    env = make(4, autoreset_mode="SameStep")
    env.reset(seed=0)
    assert env.solves == 0
    told = 0
    for action in random_actions(env.choice, 20, 4):
        infos = env.step(action)[4]
        told += infos["solves"].sum()
        told += infos["final_info"]["solves"].sum() if "final_info" in infos else 0
    assert env.solves == told > 400
    env.reset(seed=1)
    assert env.solves == told


def test_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")
    env = make(2, render_mode="rgb_array", trajectory="T2")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    assert env.render() is not None
    env.step(np.zeros((2, 3)))
    frames = env.render()
    assert frames is not None
    assert [frame.shape for frame in frames] == [(600, 900, 3)] * 2
    assert not np.array_equal(*frames)
    # The weights in use stand on a card of their own, without which all else stays.
    plain = env.drives.render()
    assert plain is not None
    rows, columns = np.nonzero((plain[0] != frames[0]).any(axis=2))
    assert len(rows) > 500
    assert columns.max() < 250
    assert rows.max() < 300
    env.close()
    with pytest.raises(ValueError, match="render_mode"):
        make(2, render_mode="human")
