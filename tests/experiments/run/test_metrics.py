"""Every metric on episodes computed by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.run import metrics
from experiments.run.rollout import Trace
from lpv_track_env import vehicle
from lpv_track_env.bicycle import VX, derivative
from trajectories import ReferencePath, load
from trajectories.lane_changes import clearance, outline

CAR = vehicle.load("m2-minibus")
SPEED = 5.0


def straight(length=200.0, speed=SPEED):
    n = round(length / 0.25) + 1
    s = np.linspace(0.0, length, n)
    zero = np.zeros(n)
    return ReferencePath(s, s, zero, zero, zero, np.full(n, speed), name="line")


def episode(arc_length, lateral=0.0, heading=0.0, period=0.1, **changes):
    """A trace on the straight path along X, every array constant unless given."""
    arc_length = np.asarray(arc_length, dtype=float)
    n = len(arc_length)

    def full(value):
        return np.broadcast_to(np.asarray(value, dtype=float), (n,)).copy()

    lateral, heading = full(lateral), full(heading)
    state = np.column_stack([full(SPEED), full(0.0), heading, full(0.0), arc_length, lateral])
    arrays = {
        "time": period * np.arange(n),
        "state": state,
        "estimate": state,
        "arc_length": arc_length,
        "lateral_error": lateral,
        "heading_error": heading,
        "reference_speed": full(SPEED),
        "acceleration": full(CAR.rolling_deceleration),
        "steering_angle": full(0.0),
        "solve_time": full(0.0),
        "reward": full(0.1),
        "clipped": full(0.0),
        "stopping": full(0.0),
        "deadline_misses": full(0.0),
        "friction": full(0.0),
    }
    return Trace(**{**arrays, **changes})


def drive(n=101, **changes):
    return episode(SPEED * 0.1 * np.arange(n), **changes)


def test_a_constant_error_is_every_one_of_its_averages():
    values = metrics.evaluate(drive(lateral=-0.3, heading=0.02), straight(), CAR)
    for name in ("max_cte", "mean_cte", "mle", "ale", "mean_abs_lateral_error"):
        assert values[name] == pytest.approx(0.3, rel=1e-12)
    assert values["moe"] == pytest.approx(0.02)
    assert values["aoe"] == pytest.approx(0.02)


def test_a_sine_over_whole_periods_has_rms_of_its_amplitude_over_root_two():
    time = 0.1 * np.arange(101)
    trace = drive(lateral=0.4 * np.sin(2 * np.pi * time / 5.0), heading=-0.1 * np.ones(101))
    values = metrics.evaluate(trace, straight(), CAR)
    assert values["ale"] == pytest.approx(0.4 / math.sqrt(2.0), rel=1e-12)
    assert values["aoe"] == pytest.approx(0.1)
    assert values["mle"] == pytest.approx(0.4, rel=2e-3)
    assert values["mean_cte"] == pytest.approx(0.4 * 2 / np.pi, rel=0.02)


def test_rms_integrates_a_ramp_by_the_trapezoidal_rule():
    time = np.array([0.0, 1.0, 3.0])
    # Squares 0, 4, 16: areas 2 and 20 over 3 s.
    assert metrics.rms(time, np.array([0.0, -2.0, 4.0])) == pytest.approx(math.sqrt(22.0 / 3.0))
    assert metrics.rms(np.array([0.0]), np.array([7.0])) == 0.0


def test_cte_is_negative_to_the_left_of_a_straight_line():
    assert metrics.cross_track_error(drive(n=3, lateral=0.5), straight()) == pytest.approx(-0.5)
    assert metrics.cross_track_error(drive(n=3, lateral=-0.5), straight()) == pytest.approx(0.5)


def test_cte_on_a_circle_is_the_distance_to_it_with_the_sign_of_the_side():
    path = load("circle")
    radius = 1.0 / path.curvature[0]
    assert radius > 0  # counter-clockwise: the centre lies to the left
    s = np.array([1.0, 20.0, 55.0])
    foot = path.sample(s)
    for inwards in (0.7, -0.7):
        state = np.zeros((3, 6))
        state[:, 0] = SPEED
        state[:, 4] = foot.x - inwards * np.sin(foot.heading)
        state[:, 5] = foot.y + inwards * np.cos(foot.heading)
        trace = episode(s, lateral=inwards, state=state)
        assert metrics.cross_track_error(trace, path) == pytest.approx(-inwards, abs=1e-9)


def test_the_clock_sees_a_lag_that_the_foot_point_does_not():
    reached = SPEED * 0.1 * np.arange(101)
    lagging = np.maximum(reached - 2.0, 0.0)  # waits, then follows 2 m behind
    values = metrics.evaluate(episode(lagging), straight(), CAR)
    assert values["mle"] == 0.0
    assert values["max_time_indexed_distance"] == pytest.approx(2.0, abs=1e-9)
    behind = np.minimum(reached, 2.0)
    assert values["mean_time_indexed_distance"] == pytest.approx(behind.mean(), abs=1e-9)


def test_the_clock_starts_where_the_episode_does_and_stops_at_the_paths_end():
    path = straight(20.0)
    # From s = 10 m on, 10 m in 2 s; then the reference waits at the end and the vehicle with it.
    values = metrics.evaluate(episode(np.minimum(10.0 + 0.5 * np.arange(31), 20.0)), path, CAR)
    assert values["max_time_indexed_distance"] == pytest.approx(0.0, abs=1e-9)


def test_speed_errors():
    state = drive().state.copy()
    state[:, 0] = SPEED - 0.5
    values = metrics.evaluate(drive(state=state), straight(), CAR)
    assert values["max_speed_error"] == pytest.approx(0.5)
    assert values["rms_speed_error"] == pytest.approx(0.5)


def test_total_variation_and_rates_of_a_known_input():
    steering = np.array([0.0, 0.02, -0.01, -0.01])
    acceleration = np.array([0.2, 0.2, 0.5, 0.1])
    trace = episode(
        0.5 * np.arange(4), steering_angle=steering, acceleration=acceleration,
        clipped=np.array([4.0, 0.0, 2.0, 0.0]),
    )  # fmt: skip
    values = metrics.activity(trace, straight(), CAR)
    assert values["steering_variation"] == pytest.approx(0.02 + 0.03)
    assert values["acceleration_variation"] == pytest.approx(0.3 + 0.4)
    assert values["steering_rate_rms"] == pytest.approx(math.sqrt((0.2**2 + 0.3**2) / 3))
    assert values["jerk_rms"] == pytest.approx(math.sqrt((3.0**2 + 4.0**2) / 3))
    assert values["clipped_share"] == pytest.approx(1 / 3)


def test_nothing_is_violated_by_steady_driving_on_the_flat():
    values = metrics.violations(drive(), straight(), CAR)
    assert set(values.values()) == {0.0}


def violated_by(**changes):
    trace = drive(n=11, **changes)
    found = metrics.violations(trace, straight(), CAR)
    return {name: value for name, value in found.items() if value > 0}


def with_column(column, index, value):
    state = drive(n=11).state.copy()
    state[index, column] = value
    return state


def test_speed_over_and_under_its_range():
    found = violated_by(state=with_column(0, 3, 0.75))
    assert found["excess_speed"] == pytest.approx(0.25)
    assert found["violated_speed"] == pytest.approx(1 / 11)
    assert violated_by(state=with_column(0, 3, 31.5))["excess_speed"] == pytest.approx(1.5)


def test_lateral_velocity_over_its_share_of_speed():
    found = violated_by(state=with_column(1, slice(2, 4), -1.0))
    assert found["excess_lateral_velocity"] == pytest.approx(1.0 - 0.17 * SPEED)
    assert found["violated_lateral_velocity"] == pytest.approx(2 / 11)


def test_steering_angle_and_its_rate():
    limit = CAR.max_steering_angle
    steering = np.minimum(0.06 * np.arange(11), limit + 0.02)
    found = violated_by(steering_angle=steering)
    assert found["excess_steering_angle"] == pytest.approx(0.02)
    assert found["violated_steering_angle"] == pytest.approx(2 / 11)
    # 0.06 rad in 0.1 s; the ninth step is shorter, the last none.
    assert found["excess_steering_rate"] == pytest.approx(0.6 - CAR.max_steering_rate)
    assert found["violated_steering_rate"] == pytest.approx(9 / 10)


def test_jerk():
    acceleration = CAR.rolling_deceleration + np.array([0.0] * 5 + [0.8] * 6)
    found = violated_by(acceleration=acceleration)
    assert found == {
        "excess_jerk": pytest.approx(8.0 - CAR.max_jerk),
        "violated_jerk": pytest.approx(1 / 10),
    }


def test_longitudinal_acceleration_is_that_of_the_vector_field():
    trace = drive(n=11, acceleration=np.full(11, CAR.rolling_deceleration + 2.25))
    found = metrics.violations(trace, straight(), CAR)
    assert found["excess_longitudinal_acceleration"] == pytest.approx(0.25)
    assert found["violated_longitudinal_acceleration"] == 1.0
    braking = drive(n=11, acceleration=np.full(11, CAR.rolling_deceleration - 4.5))
    found = metrics.violations(braking, straight(), CAR)
    assert found["excess_longitudinal_acceleration"] == pytest.approx(0.5)
    # Turning costs speed: the field's front tyre drag and r vy count too.
    state = drive(n=11).state.copy()
    state[:, 3] = 0.4
    state[:, 1] = 0.5
    steering = np.full(11, 0.3)
    turning = drive(n=11, state=state, steering_angle=steering)
    asked = derivative(state[0], np.array([turning.acceleration[0], 0.3]), CAR)[0]
    found = metrics.violations(turning, straight(), CAR)
    expected = max(-4.0 - asked, asked - 2.0, 0.0)
    assert found["excess_longitudinal_acceleration"] == pytest.approx(expected)


def test_an_episode_without_a_step_has_no_activity_and_breaks_nothing():
    values = metrics.evaluate(episode([0.0]), straight(), CAR)
    assert values["steering_variation"] == values["violated_jerk"] == values["duration"] == 0.0
    assert values["excess_steering_rate"] == values["jerk_rms"] == values["clipped_share"] == 0.0


def test_reward_duration_and_share_completed():
    values = metrics.evaluate(drive(n=101), straight(100.0), CAR)
    assert values["reward"] == pytest.approx(10.1)
    assert values["duration"] == pytest.approx(10.0)
    assert values["completed"] == pytest.approx(0.5)
    late = metrics.evaluate(episode(60.0 + 0.5 * np.arange(41)), straight(100.0), CAR)
    assert late["completed"] == pytest.approx(0.5)  # 20 of the 40 m that were left


def test_a_closed_path_is_completed_after_a_whole_lap_from_any_start():
    path = load("circle")
    half = np.linspace(0.0, 0.5 * path.length, 50)
    values = metrics.evaluate(episode(30.0 + half), path, CAR)
    assert values["completed"] == pytest.approx(0.5)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=60))
def test_mle_is_max_cte_and_mean_cte_is_at_most_ale(errors):
    lateral = np.array(errors)
    trace = episode(0.5 * np.arange(len(lateral)), lateral=lateral)
    values = metrics.tracking(trace, straight(), CAR)
    assert values["max_cte"] == pytest.approx(values["mle"], abs=1e-9)
    assert values["mean_cte"] == pytest.approx(values["mean_abs_lateral_error"], abs=1e-9)
    # By the trapezoidal rule exactly (Jensen); the plain mean weighs the two ends in full.
    ends = (abs(lateral[0]) + abs(lateral[-1])) / (2 * len(lateral))
    assert values["mean_cte"] <= values["ale"] + ends + 1e-9
    assert values["ale"] <= values["mle"] + 1e-9


def test_heading_errors_come_wrapped_from_the_environment():
    """The metrics take the heading error as it is; on a lap of a circle it must not grow."""
    from experiments.run.case import run_case

    result = run_case({"agent": "stanley", "trajectory": "circle"})
    turned = result["trace"]["state"][:, 2]
    assert turned[-1] - turned[0] > 6.0
    assert np.abs(result["trace"]["heading_error"]).max() <= np.pi
    assert result["metrics"]["moe"] < 0.3


def test_what_was_known_is_measured_against_what_was():
    trace = drive()
    estimate = trace.state + np.array([0.0, 0.0, 0.0, 0.0, 0.3, -0.4])
    stopping, misses = np.zeros(101), np.minimum(np.arange(101), 7.0)
    stopping[41:61] = 1.0
    values = metrics.evaluate(
        drive(estimate=estimate, stopping=stopping, deadline_misses=misses), straight(), CAR
    )
    assert values["rms_estimate_error"] == pytest.approx(0.5)
    assert values["max_estimate_error"] == pytest.approx(0.5)
    assert values["rms_lateral_estimate_error"] == pytest.approx(0.4)
    assert values["stopping_share"] == pytest.approx(0.2)
    assert values["deadline_misses"] == 7.0
    ideal = metrics.evaluate(trace, straight(), CAR)
    assert ideal["rms_estimate_error"] == ideal["stopping_share"] == ideal["deadline_misses"] == 0.0


def recovered(lateral, heading=0.0):
    values = np.asarray(lateral, dtype=float)
    trace = drive(len(values), lateral=values, heading=heading)
    return metrics.recovery(trace, straight(), CAR)


def test_recovery_counts_the_other_side_and_the_time_until_it_lasts():
    found = recovered([2.0, 1.0, 0.05, -0.3, -0.2, 0.05, 0.02])
    assert found == {"overshoot": 0.3, "recovery_time": pytest.approx(0.5)}
    mirrored = recovered([-2.0, -1.0, -0.05, 0.3, 0.2, -0.05, -0.02])
    assert mirrored == {"overshoot": 0.3, "recovery_time": pytest.approx(0.5)}
    # Further out on its own side is no overshoot.
    assert recovered([2.0, 3.0, 1.0, 0.0])["overshoot"] == 0.0
    # It never comes back for good.
    assert recovered([2.0, 0.0, -0.1]) == {"overshoot": 0.1}


def test_recovery_from_a_start_on_the_path():
    # It leaves to the side of its heading: what lies on the other is overshoot.
    turned = np.array([0.5, 0.0, 0.0, 0.0])
    assert recovered([0.0, 0.8, -0.2, 0.0], turned)["overshoot"] == 0.2
    assert recovered([0.0, -0.8, 0.2, 0.0], -turned)["overshoot"] == 0.2
    # With no side of its own every error counts.
    assert recovered([0.0, 0.8, -0.2, 0.0])["overshoot"] == 0.8
    assert recovered([0.0, 0.05, -0.02]) == {"overshoot": 0.05, "recovery_time": 0.0}


def test_cones_are_measured_between_the_states_too():
    """A circle of 10 m about (0, 10): the car is between the cones between two states only."""
    rate = SPEED / 10.0
    path = replace(straight(), metadata={"cones": [[-0.5, 0.5, -1.5, 5.0]]})
    time = np.array([-0.8, 0.8])
    psi = rate * time
    state = np.column_stack(
        [np.full(2, SPEED), np.zeros(2), psi, np.full(2, rate), 10.0 * np.sin(psi),
         10.0 - 10.0 * np.cos(psi)]
    )  # fmt: skip
    trace = episode(np.zeros(2), state=state, time=time)
    values = metrics.evaluate(trace, path, CAR)
    middle = 0.5 * (CAR.front_axle_distance - CAR.rear_axle_distance)
    corners = outline(CAR.length, CAR.width, middle)
    fine = rate * np.linspace(-0.8, 0.8, 1001)
    exact = clearance(
        path.metadata["cones"], 10.0 * np.sin(fine), 10.0 - 10.0 * np.cos(fine), fine, corners
    )
    assert values["cone_clearance"] == pytest.approx(exact, abs=0.03)
    assert clearance(path.metadata["cones"], *state[:, [4, 5, 2]].T, corners) == math.inf
    assert "cone_clearance" not in metrics.evaluate(drive(), straight(), CAR)


def on_a_circle(radius: float, speed: float, friction: float, seconds: float = 40.0) -> Trace:
    """A trace at constant speed on a circle, at 20 Hz."""
    time = np.arange(0.0, seconds, 0.05)
    trace = episode(speed * time, period=0.05)
    rate, full = speed / radius, np.ones_like(time)
    state = np.column_stack(
        [speed * full, 0.0 * full, rate * time, rate * full, 0.0 * full, 0.0 * full]
    )
    return replace(trace, state=state, friction=friction * full)


@pytest.mark.parametrize("friction", [0.5, 0.0])
def test_grip_used_on_a_circle_is_v_squared_over_r_mu_g(friction):
    used = metrics.grip(on_a_circle(30.0, 10.0, friction), straight(), CAR)
    mu = friction or 1.0
    # The chord of a velocity that turns by 1/60 rad in a period is shorter than its arc.
    expected = 100.0 / 30.0 / (mu * 9.81) * np.sinc(1.0 / 120.0 / np.pi)
    assert used["grip_used_max"] == pytest.approx(expected, rel=1e-9)
    assert used["grip_used_rms"] == pytest.approx(expected, rel=1e-9)


def test_grip_used_by_braking_where_the_road_is_slippery():
    trace = drive(n=3)
    state = trace.state.copy()
    state[:, VX] = [10.0, 9.8, 9.8]  # 2 m/s^2 at first
    trace = replace(trace, state=state, friction=np.array([0.4, 1.0, 1.0]))
    used = metrics.grip(trace, straight(), CAR)
    assert used["grip_used_max"] == pytest.approx(2.0 / (0.4 * 9.81))
    assert used["grip_used_rms"] == pytest.approx(2.0 / (0.4 * 9.81) / np.sqrt(2.0))


def test_a_lap_ends_between_two_samples():
    circle = load("circle")
    trace = on_a_circle(30.0, 10.0, 1.0)
    begun = replace(trace, arc_length=trace.arc_length + 50.0)
    lap = metrics.lap(begun, circle, CAR)["lap_time"]
    assert lap == pytest.approx(circle.length / 10.0, abs=1e-9)
    assert metrics.lap(trace, straight(), CAR) == {}
    assert metrics.lap(on_a_circle(30.0, 10.0, 1.0, 18.0), circle, CAR) == {}
