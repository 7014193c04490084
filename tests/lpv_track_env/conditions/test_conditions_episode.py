"""Conditions at work in the environment, each against what it should do by itself."""

import copy
import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

import trajectories
from lpv_track_env import tyres
from lpv_track_env.bicycle import VX, VY, YAW_RATE, X, Y, derivative
from lpv_track_env.conditions import IDEAL, REALTIME, WIND_LEVER, Conditions
from lpv_track_env.conditions import layout as conditions_layout
from lpv_track_env.conditions.vehicle import AIR_DENSITY
from lpv_track_env.env import PathTrackingEnv
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.kernels import ARC_LENGTH
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import VEHICLES

Array = NDArray[np.float64]

CAR = VEHICLES["m2-minibus"]
HOLD = CAR.rolling_deceleration
PERIOD = 0.05


def make(trajectory: Any = "T2", **changed: Any) -> PathTrackingEnv:
    """An environment that is ideal but for what is changed, sensors included."""
    given = {"estimator": "truth", **changed}
    return PathTrackingEnv(trajectory, conditions=Conditions(**given))


def straight(**changed: Any) -> PathTrackingEnv:
    path = trajectories.load("straight").with_speed(10.0)
    env = make(path, **changed)
    env.reset(seed=0)
    return env


def act(env: PathTrackingEnv, a: float, delta: float) -> dict[str, Any]:
    return env.step(np.array([a, delta]))[4]


def random_actions(steps: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform([-1.0, -0.1], [1.5, 0.1], (steps, 2))


def test_ideal_conditions_are_the_simulation() -> None:
    """Through all kernels of real vehicles; the filter, too, finds perfect readings right."""
    for estimator in ("truth", "ekf"):
        one = PathTrackingEnv("T3")
        other = PathTrackingEnv("T3", conditions=IDEAL.replace(estimator=estimator))
        np.testing.assert_array_equal(one.reset(seed=1)[0], other.reset(seed=1)[0])
        for action in random_actions(150):
            ours, theirs = one.step(action), other.step(action)
            np.testing.assert_allclose(ours[0], theirs[0], atol=2e-6)
            assert ours[1] == pytest.approx(theirs[1], abs=1e-9)
            assert ours[2:4] == theirs[2:4]
            np.testing.assert_allclose(ours[4]["state"], theirs[4]["state"], atol=1e-9)
            np.testing.assert_allclose(theirs[4]["estimate"], ours[4]["state"], atol=1e-6)
            if ours[2]:
                break


def test_the_filter_slides_with_the_vehicle() -> None:
    """With perfect readings it follows a car that skids, on the tyres of the nominal friction."""
    env = PathTrackingEnv("T3", conditions=Conditions(friction=0.3), max_lateral_error=100.0)
    env.reset(seed=0, options={"speed": 9.0})
    used = []
    for action in random_actions(60) + np.array([0.0, 0.1]):
        info = act(env, *action)
        np.testing.assert_allclose(info["estimate"], info["state"], atol=2e-5)
        used.append(abs(info["state"][VX] * info["state"][YAW_RATE]) / (0.3 * GRAVITY))
    assert max(used) > 0.8
    drift = PathTrackingEnv("T3", "bmw-320i", plant="drift", conditions="realtime")
    for changed in (env, PathTrackingEnv("T3", conditions=REALTIME), drift):
        tyre = conditions_layout.SETTINGS + filtering.TYRE
        found = changed._conditioned.spec[tyre : tyre + 6]
        np.testing.assert_array_equal(found, tyres.of(changed.vehicle, changed.friction))


def test_the_filter_believes_its_gyro_where_the_road_is_more_slippery_than_its_model() -> None:
    """At the limit of friction 0.5, with a filter whose tyres have 0.75.

    The model turns faster than the vehicle; were its readings gated, so would the estimate.
    """
    conditions = REALTIME.replace(friction=(0.5, 1.0))
    path = trajectories.load("circle")
    path = path.with_speed(math.sqrt(0.55 * GRAVITY / path.curvature.max()))
    env = PathTrackingEnv(path, "bmw-320i", conditions=conditions, max_lateral_error=100.0)
    seed = 0
    while True:
        env.reset(seed=seed)
        assert env._conditioned is not None
        if env._conditioned.vehicle[conditions_layout.FRICTION] < 0.52:
            break
        seed += 1
    errors, spread = [], []
    for step in range(100):
        info = act(env, 0.2, min(0.005 * step, 0.15))
        errors.append(abs(info["estimate"][YAW_RATE] - info["state"][YAW_RATE]))
        spread.append(abs(info["state"][YAW_RATE]))
    assert max(spread) > 0.2
    assert max(errors) < 0.04


def test_steering_lags_behind_a_ramp_by_its_time_constant() -> None:
    """A command that turns at the highest rate: delta(t) = w (t - T + T exp(-t/T)), sampled."""
    lag, step = 0.15, CAR.max_steering_rate * PERIOD
    env = straight(steering_lag=lag)
    wheel, kept = 0.0, math.exp(-PERIOD / lag)
    for k in range(1, 9):
        act(env, HOLD, k * step)
        wheel = k * step + (wheel - k * step) * kept
        assert env.actuators[1] == pytest.approx(wheel, abs=1e-12)


def test_nothing_moves_within_the_dead_time() -> None:
    env = straight(steering_dead_time=0.12, drive_dead_time=0.07)
    before = env.actuators
    act(env, 0.4, 0.02)
    assert env.actuators == pytest.approx(before, abs=1e-15)
    act(env, 0.4, 0.02)
    # The drive's 70 ms have passed, the steering's 120 ms have not.
    assert env.actuators == pytest.approx((0.4, before[1]), abs=1e-15)
    act(env, 0.4, 0.02)
    assert env.actuators == pytest.approx((0.4, 0.02), abs=1e-15)


def test_a_delay_within_a_period_is_not_rounded() -> None:
    """Distance after a step of acceleration that lands 13 ms late, to a micrometre."""
    delay = 0.013
    env = straight(computing_delay=delay, rolling_factor=0.0 + 1e-12)
    # Without rolling resistance what the actuators hold at first, mu g, is an acceleration.
    a = HOLD + 0.2
    info = act(env, a, 0.0)
    rest = PERIOD - delay
    wanted = 10.0 * PERIOD + 0.5 * HOLD * PERIOD**2 + 0.5 * 0.2 * rest**2
    assert info["state"][X] == pytest.approx(wanted, abs=1e-6)
    assert info["state"][VX] == pytest.approx(10.0 + HOLD * PERIOD + 0.2 * rest, abs=1e-9)


def test_a_heavier_vehicle_accelerates_less() -> None:
    env = straight(mass_factor=1.25, rolling_factor=1e-12)
    for _ in range(3):
        info = act(env, 0.25, 0.0)
    act(env, 0.25, 0.0)
    before = info["state"][VX]
    for _ in range(20):
        info = act(env, 0.25, 0.0)
    gained = info["state"][VX] - before - 0.25 / 1.25 * PERIOD
    assert gained == pytest.approx(0.25 / 1.25 * 20 * PERIOD, abs=1e-9)


def test_other_parameters_are_the_bicycles_own() -> None:
    """A period with every factor changed against the vector field with the changed vehicle."""
    factors = {
        "mass_factor": 1.2, "inertia_factor": 1.1, "front_stiffness_factor": 0.9,
        "rear_stiffness_factor": 1.05, "rolling_factor": 1.3,
    }  # fmt: skip
    env = straight(**factors)
    changed = CAR.replace(
        mass=1.2 * CAR.mass,
        yaw_inertia=1.1 * CAR.yaw_inertia,
        front_cornering_stiffness=0.9 * CAR.front_cornering_stiffness,
        rear_cornering_stiffness=1.05 * CAR.rear_cornering_stiffness,
        rolling_resistance=1.3 * CAR.rolling_resistance,
    )
    state = env.state
    for k in range(10):
        a, delta = HOLD + 0.02 * k, 0.01 * k
        info = act(env, a, delta)
        h = PERIOD / 50
        action = np.array([a / 1.2, delta])
        for _ in range(50):
            k1 = derivative(state, action, changed)
            k2 = derivative(state + 0.5 * h * k1, action, changed)
            k3 = derivative(state + 0.5 * h * k2, action, changed)
            k4 = derivative(state + h * k3, action, changed)
            state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        np.testing.assert_allclose(info["state"], state, atol=1e-7)


def test_no_more_lateral_force_than_friction() -> None:
    env = straight(friction=0.3)
    largest = 0.0
    for k in range(60):
        before = env.state
        step = env.step(np.array([HOLD + 1.0, min(0.02 * k, 0.3)]))
        if step[2]:
            break
        state = step[4]["state"]
        lateral = (state[VY] - before[VY]) / PERIOD + before[YAW_RATE] * before[VX]
        largest = max(largest, abs(lateral))
    assert 0.25 * GRAVITY < largest < 0.31 * GRAVITY


def test_braking_takes_from_the_steering() -> None:
    """In a bend at the limit, full braking leaves less than half of the side force."""
    friction = 0.5
    path = trajectories.load("straight").with_speed(12.0)

    def pulled(command: float) -> float:
        """Mean lateral acceleration of some steps, after a turn and the same time under `a`."""
        env = PathTrackingEnv(
            path, conditions=IDEAL.replace(friction=friction), max_lateral_error=100.0
        )
        env.reset(seed=0)
        for _ in range(12):
            before = act(env, HOLD, 0.3)["state"]
        sideways = []
        for _ in range(24):
            now = act(env, command, 0.3)["state"]
            turning = 0.25 * (now[YAW_RATE] + before[YAW_RATE]) * (now[VX] + before[VX])
            sideways.append((now[VY] - before[VY]) / PERIOD + turning)
            before = now
        assert before[VX] > 5.0
        return float(np.mean(sideways[-3:]))

    held, braked = pulled(HOLD), pulled(-5.0)
    assert 0.9 * friction * GRAVITY < held <= 1.001 * friction * GRAVITY
    assert 0.0 < braked < 0.5 * held


def test_a_vehicle_stops_within_its_friction() -> None:
    """From 10 m/s: at most 0.95 mu g once the brakes are applied, whatever is commanded."""
    for friction in (0.1, 0.3):
        env = straight(friction=friction, rolling_factor=0.0)
        while env.state[VX] > 8.0:
            act(env, -5.0, 0.0)
        start = env.state
        while env.state[VX] > 2.0:
            act(env, -5.0, 0.0)
        end = env.state
        wanted = (start[VX] ** 2 - end[VX] ** 2) / (2.0 * 0.95 * friction * GRAVITY)
        assert end[X] - start[X] == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("closed", [False, True])
def test_a_slippery_stretch_lowers_the_friction_between_its_ends(closed: bool) -> None:
    """Full brakes: before it the same bits as without, on it at most 0.95 of a quarter of mu g."""
    path = trajectories.load("circle" if closed else "straight").with_speed(15.0)
    # Without curvature the vehicle starts straight on, so that it slows by its brakes alone.
    path = replace(path, curvature=np.zeros_like(path.curvature))
    given = IDEAL.replace(friction=0.8, rolling_factor=0.0)
    slippery = given.replace(slippery_stretch=(5.0, 25.0), slippery_factor=0.25)
    one, other = (
        PathTrackingEnv(path, conditions=conditions, max_lateral_error=100.0)
        for conditions in (given, slippery)
    )
    # On the closed path the stretch lies behind the seam.
    start = {"arc_length": path.length - 2.0 if closed else 0.0}
    for env in (one, other):
        env.reset(seed=0, options=start)
    lost: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(120):
        before, place = other.state[VX], other._record[ARC_LENGTH] % path.length
        action = np.array([-5.0, 0.0])
        ours, theirs = one.step(action), other.step(action)
        if not lost[True] and not 5.0 <= place < 25.0:
            np.testing.assert_array_equal(ours[0], theirs[0])
        lost[5.0 <= place < 25.0].append((before - theirs[4]["state"][VX]) / PERIOD)
        if theirs[2] or theirs[4]["state"][VX] < 0.5:
            break
    assert max(lost[True]) == pytest.approx(0.95 * 0.25 * 0.8 * GRAVITY, rel=1e-6)
    assert max(lost[False]) > 2.0 * max(lost[True])
    assert len(lost[True]) > 20


def test_side_wind_pushes_by_its_force() -> None:
    """First period of a straight drive: lateral and yaw acceleration by the air's force."""
    env = straight(wind_speed=8.0)
    assert env._conditioned is not None
    wind = 8.0 * env._conditioned.vehicle[[conditions_layout.WIND_X, conditions_layout.WIND_Y]]
    ahead, aside = wind - [10.0, 0.0]
    force = 0.5 * AIR_DENSITY * 12.0 * math.hypot(ahead, aside) * aside
    # Within 0.1 ms neither tyres nor heading have answered.
    short = PathTrackingEnv(
        env.path, conditions=env.conditions, control_period=0.001, preview_period=0.05
    )
    short.reset(seed=0)
    info = act(short, HOLD, 0.0)
    first = derivative(
        np.array([10.0, force / CAR.mass * 5e-4, 0.0, force * WIND_LEVER / CAR.yaw_inertia * 5e-4,
                  0.0, 0.0]), np.array([HOLD, 0.0]), CAR,
    )  # fmt: skip
    assert info["state"][VY] == pytest.approx((force / CAR.mass + first[VY]) * 1e-3, rel=1e-2)
    assert info["state"][YAW_RATE] == pytest.approx(
        (force * WIND_LEVER / CAR.yaw_inertia + first[YAW_RATE]) * 1e-3, rel=1e-2
    )


def test_readings_have_their_noise_and_bias() -> None:
    """Estimator "raw": speed, yaw rate and heading of 4,000 periods against the truth."""
    env = PathTrackingEnv(
        "circle", time_limit=300.0,
        conditions=Conditions(
            estimator="raw", speed_noise=0.2, speed_scale=0.01, yaw_rate_noise=0.01,
            yaw_rate_bias=0.02, heading_noise=0.03, heading_bias=-0.01,
        ),
    )  # fmt: skip
    env.reset(seed=1)
    # Driven on the spot: no action changes a reading's noise.
    rows = []
    for _ in range(4000):
        *_, ended, late, info = env.step(np.array([HOLD, 0.0]))
        truth, seen = info["state"], info["estimate"]
        rows.append(
            [seen[0] - 1.01 * truth[0], seen[3] - truth[3] - 0.02, seen[2] - truth[2] + 0.01]
        )
        if ended or late:
            env.reset()
    errors = np.array(rows)
    deviations = np.array([0.2, 0.01, 0.03])
    n = len(errors)
    assert np.all(np.abs(errors.mean(axis=0)) < 4.0 * deviations / math.sqrt(n))
    assert errors.std(axis=0) == pytest.approx(deviations, rel=4.0 / math.sqrt(2 * n))
    assert np.abs(np.corrcoef(errors.T) - np.eye(3)).max() < 4.0 / math.sqrt(n)


def test_fixes_come_at_their_rate_and_late() -> None:
    env = straight(estimator="raw", gnss_period=0.2, gnss_latency=0.15)
    truth, seen = [env.state[X]], []
    for _ in range(40):
        info = act(env, HOLD, 0.0)
        truth.append(info["state"][X])
        seen.append(info["estimate"][X])
    # Each is where the vehicle was three periods ago, and stands for four periods.
    changes = np.flatnonzero(np.diff(seen)) + 1
    np.testing.assert_array_equal(np.diff(changes), 4)
    for k in changes:
        assert seen[k] == truth[k + 1 - 3]


def test_white_and_lasting_errors_of_fixes() -> None:
    """Deviation of both kinds, and how long the second lasts: its autocorrelation at 2 s."""
    env = make(
        "circle", estimator="raw", gnss_period=PERIOD, gnss_noise=0.1, gnss_wander=0.5,
        gnss_wander_time=4.0,
    )  # fmt: skip
    white, lasting = [], []
    for seed in range(60):
        env.reset(seed=seed)
        errors = np.array(
            [(i := act(env, HOLD, 0.0))["estimate"][[X, Y]] - i["state"][[X, Y]] for _ in range(45)]
        )
        white.append(np.diff(errors, axis=0).std())
        lasting.append(errors[[0, 40]])
    # Differences hold the white error twice, and 2 (1 - exp(-T/tau)) of the lasting one.
    wanted = math.sqrt(2 * 0.1**2 + 2 * (1 - math.exp(-PERIOD / 4.0)) * 0.5**2)
    assert np.mean(white) == pytest.approx(wanted, rel=0.05)
    first, later = np.moveaxis(np.array(lasting), 1, 0)
    both = np.concatenate([first, later])
    assert both.std() == pytest.approx(math.hypot(0.1, 0.5), rel=0.25)
    kept = (first * later).mean() / both.var()
    assert kept == pytest.approx(math.exp(-0.5) * 0.25 / 0.26, abs=0.3)


def test_outliers_and_outages() -> None:
    env = make("circle", estimator="raw", gnss_period=PERIOD, gnss_outlier_rate=0.1)
    env.reset(seed=2)
    wrong = []
    for _ in range(600):
        *_, ended, late, info = env.step(np.array([HOLD, 0.0]))
        wrong.append(np.hypot(*(info["estimate"] - info["state"])[[X, Y]]))
        if ended or late:
            env.reset()
    wrong_ones = np.array(wrong)
    far = wrong_ones > 1e-9
    np.testing.assert_allclose(wrong_ones[far], 3.0, rtol=1e-9)
    assert far.mean() == pytest.approx(0.1, abs=0.05)
    env = straight(estimator="raw", gnss_period=PERIOD, gnss_dropout_rate=1.0,
                   gnss_dropout_duration=0.5)  # fmt: skip
    fresh = [(i := act(env, HOLD, 0.0))["estimate"][X] == i["state"][X] for _ in range(60)]
    gaps = [len(gap) for gap in "".join("x" if f else "." for f in fresh).split("x") if gap]
    # 0.5 s without fixes, and the one at which the outage began.
    assert gaps
    assert all(gap in {10, 11} for gap in gaps[:-1]), gaps


def test_without_fixes_the_vehicle_stops_and_goes_on_when_they_return() -> None:
    env = PathTrackingEnv(
        "circle", time_limit=60.0, max_lateral_error=500.0,
        conditions=Conditions(
            gnss_dropout_rate=0.4, gnss_dropout_duration=2.5, max_fix_age=1.5,
        ),
    )  # fmt: skip
    env.reset(seed=3)
    stopping, deviations, speeds, accelerations = [], [], [], []
    for _ in range(200):
        info = act(env, HOLD + 0.1, 0.0)
        accelerations.append(env.actuators[0])
        stopping.append(info["stopping"])
        deviations.append(info["position_deviation"])
        speeds.append(info["state"][VX])
        if info["end"]:
            break
    # A fix that is used makes the position more certain; nothing else does.
    used = np.flatnonzero(np.diff(deviations) < 0.0) + 1
    begins = stopping.index(True)
    last = used[used < begins].max()
    # The age at the beginning of a period, and that only of the second is over 1.5 s.
    assert begins - last == 32
    back = used[used > last].min()
    assert stopping[begins : back + 1] == [True] * (back + 1 - begins)
    assert stopping[back + 1] is False
    assert speeds[back] < speeds[begins] - 0.3
    assert speeds[back + 25] > speeds[back + 15]
    # Into the stop and out of it within the jerk limit.
    assert np.abs(np.diff(accelerations)).max() <= CAR.max_jerk * PERIOD + 1e-9


def test_never_a_fix_is_a_full_stop() -> None:
    env = straight(
        estimator="ekf", gnss_dropout_rate=10.0, gnss_dropout_duration=1e6, drive_lag=0.2
    )
    last: dict[str, Any] = {}
    for _ in range(240):
        last = act(env, HOLD + 1.0, 0.0)
    assert last["stopping"]
    assert abs(last["state"][VX]) < 0.05
    assert np.isfinite(last["estimate"]).all()


def test_a_controller_that_is_late_misses_its_turn() -> None:
    """70 ms for a period of 50: every second action is dropped, and counted."""
    env = straight()
    commands = []
    for k in range(12):
        env.set_computing_time(0.07)
        info = act(env, HOLD + 0.01 * k, 0.0)
        commands.append(env.actuators[0])
    # Sent at 0, 2, 4, ...; each is in force from 70 ms after, so at the end of the period after.
    assert info["deadline_misses"] == 6
    assert commands[1::2] == pytest.approx([HOLD + 0.01 * k for k in range(0, 12, 2)])
    assert commands[2::2] == pytest.approx(commands[1:-1:2])
    assert not info["stopping"]


def test_a_pipeline_is_late_and_misses_nothing() -> None:
    env = straight()
    for k in range(12):
        env.set_computing_time(0.07, 0.04)
        info = act(env, HOLD + 0.01 * k, 0.0)
    assert info["deadline_misses"] == 0
    assert env.actuators[0] == pytest.approx(HOLD + 0.01 * 10)


def test_without_commands_the_vehicle_brakes() -> None:
    """One computation of 0.6 s: after three periods the vehicle brakes, then it goes on."""
    env = straight()
    act(env, HOLD, 0.0)
    env.set_computing_time(0.6)
    stopping = [act(env, HOLD, 0.0)["stopping"] for _ in range(20)]
    # The last command landed at 0; at 0.05 the long one began; older than 0.15 from 0.2 s on.
    assert stopping.index(True) == 3
    ends = 3 + stopping[3:].index(False)
    assert ends * PERIOD + PERIOD == pytest.approx(0.65)
    assert env.state[VX] < 9.8


def test_the_steering_offset_is_found_and_taken_off() -> None:
    """A straight line, steered straight: without calibration the vehicle leaves it."""
    ends = []
    for calibrated in (True, False):
        env = straight(estimator="ekf", steering_offset=0.02, calibrate_steering=calibrated)
        for _ in range(60):
            info = act(env, HOLD, 0.0)
            if info["end"]:
                break
        ends.append(info["state"][YAW_RATE])
    wanted = 0.02 * 10.0 / (CAR.wheelbase + CAR.understeer_gradient * 100.0)
    assert ends[1] == pytest.approx(wanted, rel=0.05)
    assert abs(ends[0]) < 0.1 * wanted


def test_mirrored_drives_mirror() -> None:
    changed = {
        "steering_lag": 0.1, "steering_dead_time": 0.03, "drive_lag": 0.2, "friction": 0.7,
        "mass_factor": 1.1, "computing_delay": 0.011,
    }  # fmt: skip
    left, right = straight(**changed), straight(**changed)
    for action in random_actions(80):
        one = left.step(action)[4]["state"]
        other = right.step(action * [1.0, -1.0])[4]["state"]
        np.testing.assert_array_equal(one[[0, 4]], other[[0, 4]])
        np.testing.assert_array_equal(one[[1, 2, 3, 5]], -other[[1, 2, 3, 5]])


def test_what_is_seen_is_the_estimate_on_the_path() -> None:
    env = PathTrackingEnv("T4", conditions="realtime")
    observation, info = env.reset(seed=4)
    for action in random_actions(60, seed=4):
        seen, estimate = env.layout.unpack(observation), info["estimate"]
        foot = env.path.project(estimate[X], estimate[Y], near=info["arc_length"])
        assert float(seen.lateral_error) == pytest.approx(foot.lateral_error, abs=1e-5)
        assert float(seen.longitudinal_speed) == pytest.approx(estimate[VX], abs=1e-5)
        assert float(seen.yaw_rate) == pytest.approx(estimate[YAW_RATE], abs=1e-6)
        assert info["lateral_error"] != pytest.approx(foot.lateral_error, abs=1e-9)
        observation, *_, info = env.step(action)


def test_replay_and_pickling_bit_for_bit() -> None:
    env = PathTrackingEnv("T2", conditions="realtime", random_start=True)
    env.reset(seed=11)
    actions = random_actions(40)
    for action in actions[:20]:
        env.step(action)
    copies = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]  # noqa: S301
    for action in actions[20:]:
        wanted = env.step(action)
        for one in copies:
            got = one.step(action)
            np.testing.assert_array_equal(got[0], wanted[0])
            np.testing.assert_array_equal(got[4]["estimate"], wanted[4]["estimate"])
            assert got[1] == wanted[1]
    env.reset(seed=11)
    for action in actions:
        again = env.step(action)
    np.testing.assert_array_equal(again[0], wanted[0])


@pytest.mark.parametrize("estimator", ["ekf", "raw", "truth"])
def test_gymnasiums_checks(estimator: str) -> None:
    env = PathTrackingEnv("T2", conditions=REALTIME.replace(estimator=estimator))
    check_env(env, skip_render_check=True)


def test_computing_times_need_conditions() -> None:
    env = PathTrackingEnv("T2")
    with pytest.raises(ValueError, match=r"simulation.*have no delays"):
        env.set_computing_time(0.01)
    env = make()
    with pytest.raises(ValueError, match="computing times must be"):
        env.set_computing_time(-0.01)


def test_a_vehicle_gone_mad_ends_as_non_finite() -> None:
    env = straight(estimator="ekf")
    env._record[VY] = 1e308
    *_, terminated, _, info = env.step(np.array([0.0, 0.3]))
    assert terminated
    assert info["end"] in {"non_finite", "left_corridor"}
    assert np.isfinite(info["estimate"]).all()


@pytest.mark.parametrize("plant", ["single-track", "drift"])
def test_other_plants_meet_the_same_conditions(plant: str) -> None:
    """Ideal ones change nothing; sensors, actuators and delays are those of the bicycle."""
    car = VEHICLES["bmw-320i"]
    actions = random_actions(40)
    one = PathTrackingEnv("T2", car, plant=plant)
    other = PathTrackingEnv("T2", car, plant=plant, conditions=IDEAL)
    one.reset(seed=0)
    other.reset(seed=0)
    for action in actions:
        ours, theirs = one.step(action), other.step(action)
        # The mean of what is held is summed up: rounding.
        np.testing.assert_allclose(ours[4]["state"], theirs[4]["state"], atol=1e-9)
    late = Conditions(estimator="ekf", steering_lag=0.1, steering_dead_time=0.03, drive_lag=0.2,
                      computing_delay=0.01, gnss_noise=0.05, calibrate_steering=False)  # fmt: skip
    bicycle = PathTrackingEnv("T2", car, conditions=late)
    foreign = PathTrackingEnv("T2", car, plant=plant, conditions=late)
    for env in (bicycle, foreign):
        env.reset(seed=3)
    for action in actions:
        told = [env.step(action)[4] for env in (bicycle, foreign)]
        assert bicycle.actuators == pytest.approx(foreign.actuators, abs=1e-12)
        errors = [info["estimate"] - info["state"] for info in told]
        # The same noise of the same receiver, on another car's position.
        assert np.abs(errors[0] - errors[1]).max() < 0.05
        assert 0.0 < np.hypot(*errors[1][[X, Y]]) < 0.3
    copied = pickle.loads(pickle.dumps(foreign))  # noqa: S301
    for action in actions[:5]:
        np.testing.assert_array_equal(foreign.step(action)[0], copied.step(action)[0])
