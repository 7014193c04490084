"""The reference rebuilt from the observation's preview, and the turns that follow it."""

import math

import numpy as np
import pytest
from scipy.integrate import simpson

import trajectories
from agents.reference import (
    LEAD,
    NEAR_PATH,
    NODE,
    fill_nodes,
    fill_nodes_at,
    local_reference,
    mean_curvature,
    point_at,
)
from agents.speed_cap import SHARE
from agents.steady_turn import early_turn, lagged_sideslip, steady_turn, transient_turn
from lpv_track_env import bicycle
from lpv_track_env.observation import ObservationLayout, TrackingObservation
from lpv_track_env.vehicle import VEHICLES

PERIOD = 0.05
LAYOUT = ObservationLayout(preview_steps=20, preview_period=PERIOD)


def observed(reference_speed, curvature, speed, layout=LAYOUT) -> TrackingObservation:
    """An observation on the path, previews (K,) or scalars."""
    row = np.zeros(layout.size)
    slices = layout.slices
    row[slices["reference_speed"]] = reference_speed
    row[slices["preview_curvature"]] = curvature
    row[slices["preview_speed"]] = speed
    return layout.unpack(row)


@pytest.mark.parametrize(("period", "tolerance"), [(0.02, 1e-4), (0.05, 1e-3), (0.1, 5e-3)])
def test_nodes_lie_on_the_path(period, tolerance):
    path = trajectories.load("T1")
    steps = np.arange(21)
    for s in np.linspace(0.0, path.length - 30.0, 60):
        at, preview = path.sample(s), path.preview(s, period, 20)
        found = local_reference(
            observed(at.speed, *preview, layout=ObservationLayout(20, period)), period
        )
        places = path.arc_length_at(at.time + period * steps)
        truth = path.sample(places)
        c, d = np.cos(at.heading), np.sin(at.heading)
        dx, dy = truth.x - at.x, truth.y - at.y
        np.testing.assert_allclose(found.x, dx * c + dy * d, atol=tolerance)
        np.testing.assert_allclose(found.y, dy * c - dx * d, atol=tolerance)
        np.testing.assert_allclose(found.heading, truth.heading - at.heading, atol=tolerance)
        np.testing.assert_allclose(found.arc_length, places - s, atol=tolerance)
        np.testing.assert_allclose(found.speed, truth.speed, atol=1e-9)


@pytest.mark.parametrize("radius", [8.0, -8.0, 0.5, 1e9])
def test_circle_is_exact(radius):
    found = local_reference(observed(5.0, 1.0 / radius, 5.0), PERIOD)
    s = 5.0 * PERIOD * np.arange(21)
    np.testing.assert_allclose(found.arc_length, s, rtol=1e-12)
    np.testing.assert_allclose(found.heading, s / radius, rtol=1e-12)
    np.testing.assert_allclose(found.x, radius * np.sin(s / radius), atol=1e-9)
    np.testing.assert_allclose(found.y, 2.0 * radius * np.sin(0.5 * s / radius) ** 2, atol=1e-9)


def test_straight_with_constant_acceleration():
    speed = 4.0 + 2.0 * PERIOD * np.arange(21)
    found = local_reference(observed(speed[0], 0.0, speed[1:]), PERIOD)
    time = PERIOD * np.arange(21)
    np.testing.assert_allclose(found.x, 4.0 * time + time**2, rtol=1e-12)
    assert not found.y.any()
    assert not found.heading.any()


def test_a_batch_is_its_rows():
    rng = np.random.default_rng(1)
    rows = rng.uniform(0.1, 3.0, size=(3, 4, LAYOUT.size))
    batch = local_reference(LAYOUT.unpack(rows), PERIOD)
    single = local_reference(LAYOUT.unpack(rows[2, 1]), PERIOD)
    for many, one in zip(batch, single, strict=True):
        assert many.shape == (3, 4, 21)
        np.testing.assert_allclose(many[2, 1], one, rtol=1e-12)


def drawn(rng):
    """Speed at the foot point, and speeds (20,) and curvatures (20,) of a lively preview."""
    return rng.uniform(0.0, 5.0), rng.uniform(-0.5, 0.5, 20), rng.uniform(0.0, 5.0, 20)


def test_nodes_at_the_previews_own_times_are_its_nodes():
    rng = np.random.default_rng(2)
    for count in (1, 7, 20):
        first, curvature, speed = drawn(rng)
        mine, whole = np.zeros((count + 1, NODE)), np.zeros((count + 1, NODE))
        fill_nodes_at(
            curvature, first, speed, PERIOD, np.full(count, PERIOD), math.inf, 0.0, math.inf,
            math.inf, 0.0, 1.0, np.zeros(21), mine,
        )  # fmt: skip
        fill_nodes(curvature, first, speed, PERIOD, whole)
        np.testing.assert_allclose(mine, whole, rtol=1e-12, atol=1e-12)


def test_nodes_at_any_times_lie_on_the_previews_arcs():
    """Against numerical integration, across the intervals' boundaries."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        first, curvature, speed = drawn(rng)
        lengths = rng.dirichlet(np.ones(9)) * 20 * PERIOD
        found = local_reference(observed(first, curvature, speed), PERIOD, lengths)
        speeds = np.concatenate([[first], speed])
        known = PERIOD * np.arange(21)
        for node, time in enumerate(np.concatenate([[0.0], np.cumsum(lengths)])):
            x = y = heading = s = 0.0
            for k in range(20):
                end = min(time, known[k + 1])
                if end <= known[k]:
                    break
                # Simpson's rule on a hundred steps; the heading is quadratic in time.
                t = np.linspace(known[k], end, 201)
                slope = (speeds[k + 1] - speeds[k]) / PERIOD
                gone = speeds[k] * (t - known[k]) + 0.5 * slope * (t - known[k]) ** 2
                angle, v = heading + curvature[k] * gone, speeds[k] + slope * (t - known[k])
                x, y = x + simpson(v * np.cos(angle), x=t), y + simpson(v * np.sin(angle), x=t)
                heading, s = angle[-1], s + gone[-1]
            wanted = (s, x, y, heading, np.interp(time, known, speeds))
            np.testing.assert_allclose([value[node] for value in found], wanted, atol=1e-9)


def test_nodes_do_not_depend_on_those_between():
    rng = np.random.default_rng(4)
    first, curvature, speed = drawn(rng)
    seen = observed(first, curvature, speed)
    fine = np.repeat([0.01, 0.035, 0.05, 0.12], 4)
    coarse = fine.reshape(-1, 4).sum(axis=1)
    one, other = (local_reference(seen, PERIOD, lengths) for lengths in (fine, coarse))
    for many, few in zip(one, other, strict=True):
        np.testing.assert_allclose(many[::4], few, rtol=1e-12, atol=1e-12)


def test_beyond_the_preview_the_reference_goes_on_along_its_last_arc():
    first, curvature, speed = drawn(np.random.default_rng(5))
    curvature[-1], speed[-1] = 0.2, 3.0
    lengths = np.array([19.5 * PERIOD, 0.5 * PERIOD, 0.4, 1.3])
    found = local_reference(observed(first, curvature, speed), PERIOD, lengths)
    np.testing.assert_allclose(found.speed[2:], 3.0)
    np.testing.assert_allclose(np.diff(found.arc_length)[2:], [1.2, 3.9])
    np.testing.assert_allclose(np.diff(found.heading)[2:], [0.24, 0.78])
    for k, turn in ((2, 0.24), (3, 0.78)):
        ahead = found.heading[k] + 0.5 * turn
        chord = 2.0 / 0.2 * math.sin(0.5 * turn)
        assert found.x[k + 1] - found.x[k] == pytest.approx(chord * math.cos(ahead))
        assert found.y[k + 1] - found.y[k] == pytest.approx(chord * math.sin(ahead))


@pytest.mark.parametrize("speed", [0.0, 5.0, 20.0])
@pytest.mark.parametrize("error", [0.0, 0.3, -NEAR_PATH, NEAR_PATH, 0.8, -2.0, 10.0])
def test_a_vehicle_far_beside_the_path_is_led_back_to_it(error, speed):
    """An offset that decays along the path, with the heading of the curve that it makes.

    The nodes go along this curve, which is the longer way outside of the bend and across, at the
    path's speed.
    """
    bend, row = 0.02, observed(8.0, 0.02, 8.0)._replace(longitudinal_speed=speed)
    lengths = np.full(200, 0.005)
    path, led = (
        local_reference(one, PERIOD, lengths, leading=2.0)
        for one in (row._replace(lateral_error=0.0), row._replace(lateral_error=error))
    )
    excess = max(abs(error) - NEAR_PATH, 0.0)
    if excess == 0.0:
        for one, other in zip(led, path, strict=True):
            np.testing.assert_array_equal(one, other)
        return
    heading = bend * led.arc_length
    dx, dy = led.x - np.sin(heading) / bend, led.y - (1.0 - np.cos(heading)) / bend
    c, d = np.cos(heading), np.sin(heading)
    np.testing.assert_allclose(dx * c + dy * d, 0.0, atol=1e-9)
    offset = dy * c - dx * d
    assert offset[0] == pytest.approx(math.copysign(excess, error))
    assert (np.diff(np.abs(offset)) < 0.0).all()
    slope = np.gradient(offset, led.arc_length)
    tangent = np.tan(led.heading - heading)
    np.testing.assert_allclose(tangent[2:-2], slope[2:-2], rtol=2e-3)
    assert np.abs(slope).max() <= 0.4 + 1e-3
    np.testing.assert_array_equal(led.speed, path.speed)
    # With standing start goals (speed 0) nodes are slower than the path anyway.
    pace = np.hypot(np.diff(led.x), np.diff(led.y)) / np.hypot(np.diff(path.x), np.diff(path.y))
    longer = np.maximum(np.hypot(1.0 - bend * offset, slope), 1.0)[:-1]
    shorter = np.minimum(np.hypot(1.0 - bend * offset, slope), 1.0)[:-1]
    assert (np.diff(led.arc_length) <= np.diff(path.arc_length) / longer * 1.002).all()
    np.testing.assert_allclose(pace, shorter, rtol=4e-3)
    mirrored = local_reference(
        observed(8.0, -0.02, 8.0)._replace(lateral_error=-error, longitudinal_speed=speed),
        PERIOD, lengths, leading=2.0,
    )  # fmt: skip
    np.testing.assert_allclose([mirrored.y, mirrored.heading], [-led.y, -led.heading], atol=1e-12)


@pytest.mark.parametrize("vx", [7.7, 8.0, 12.0])
def test_a_vehicle_as_fast_as_the_path_has_its_nodes(vx):
    rng = np.random.default_rng(6)
    first, curvature, _ = drawn(rng)
    # As much faster from node to node as the vehicle can be.
    speed = 8.0 + SHARE * 2.0 * PERIOD * np.arange(1, 21)
    seen = observed(8.0, curvature, speed)._replace(longitudinal_speed=vx)
    lengths = np.full(20, PERIOD)
    for ours, whole in zip(
        local_reference(seen, PERIOD, lengths, leading=2.0),
        local_reference(seen, PERIOD, lengths), strict=True,
    ):  # fmt: skip
        np.testing.assert_allclose(ours, whole, rtol=1e-12, atol=1e-12)
    assert first > 0.0


@pytest.mark.parametrize("vx", [-1.0, 0.0, 2.5, 6.0])
def test_a_slow_vehicle_is_led_along_the_path_as_fast_as_it_can_drive(vx):
    _, curvature, _ = drawn(np.random.default_rng(7))
    speed = np.concatenate([np.linspace(8.0, 9.0, 10), np.linspace(9.0, 4.0, 10)])
    seen = observed(8.0, curvature, speed)._replace(longitudinal_speed=vx)
    lengths = np.full(100, 0.02)
    led = local_reference(seen, PERIOD, lengths, leading=2.0)
    time = np.concatenate([[0.0], np.cumsum(lengths)])
    fastest = max(vx, 0.0) + LEAD + SHARE * 2.0 * time
    assert (led.speed <= fastest + 1e-12).all()
    # It passes the places of the reference, no faster than that either.
    fine = local_reference(seen, PERIOD, np.full(2000, 0.001))
    for name, value in (("x", led.x), ("y", led.y), ("heading", led.heading)):
        there = np.interp(led.arc_length, fine.arc_length, getattr(fine, name))
        np.testing.assert_allclose(value, there, atol=1e-5)
    allowed = np.minimum(fastest, np.interp(led.arc_length, fine.arc_length, fine.speed))
    np.testing.assert_allclose(led.speed, allowed, rtol=2e-3)
    gone = np.cumsum(0.5 * (led.speed[1:] + led.speed[:-1]) * lengths)
    np.testing.assert_allclose(led.arc_length[1:], gone, rtol=0.02)


FINE = np.full(4000, 0.001)
"""Lengths of nodes a millisecond apart, s."""


@pytest.mark.parametrize("grip", [0.05, 2.0, 5.0])
@pytest.mark.parametrize("radius", [10.0, -60.0])
def test_on_a_circle_the_fastest_speed_is_that_at_the_grip(grip, radius):
    """A vehicle that is as fast as friction allows stays so: v^2 / R = grip."""
    allowed = math.sqrt(grip * abs(radius))
    fast = observed(1.5 * allowed, 1.0 / radius, 1.5 * allowed)
    found = local_reference(
        fast._replace(longitudinal_speed=allowed), PERIOD, FINE[:1000], leading=2.0, grip=grip,
        braking=4.0,
    )  # fmt: skip
    np.testing.assert_allclose(found.speed, allowed, rtol=1e-9)
    np.testing.assert_allclose(found.arc_length[1:], allowed * np.cumsum(FINE[:1000]), rtol=1e-9)
    np.testing.assert_allclose(found.heading, found.arc_length / radius, rtol=1e-9, atol=1e-12)
    slow = observed(0.9 * allowed, 1.0 / radius, 0.9 * allowed)
    for one, other in zip(
        local_reference(slow, PERIOD, FINE, leading=2.0, grip=grip, braking=4.0),
        local_reference(slow, PERIOD, FINE, leading=2.0), strict=True,
    ):  # fmt: skip
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("grip", "braked"), [(3.0, 0.6 * 3.0), (8.0, 0.8 * 4.0)])
def test_before_a_bend_the_reference_brakes_over_the_distance_that_it_takes(grip, braked):
    """(v0^2 - v1^2) / (2 b) before the bend, and no earlier."""
    speed, radius, straight = 12.0, 12.0, 16
    curvature = np.where(np.arange(20) < straight, 0.0, 1.0 / radius)
    row = observed(speed, curvature, speed)._replace(longitudinal_speed=speed)
    found = local_reference(row, PERIOD, FINE, leading=2.0, grip=grip, braking=4.0)
    bend, slow = straight * PERIOD * speed, math.sqrt(grip * radius)
    reached = np.sqrt(
        np.clip(slow**2 + 2.0 * braked * (bend - found.arc_length), slow**2, speed**2)
    )
    if slow**2 + 2.0 * braked * bend < speed**2:
        # Too fast already: it brakes all the way from where it is.
        reached = np.sqrt(np.clip(speed**2 - 2.0 * braked * found.arc_length, slow**2, None))
    # Between the preview's nodes, 0.6 m apart, the braking that begins there is spread.
    seen = found.arc_length < bend + 4 * PERIOD * speed
    np.testing.assert_allclose(found.speed[seen], reached[seen], atol=braked * PERIOD)
    began = np.flatnonzero(found.speed < speed - 1e-9)[0]
    assert found.arc_length[began] >= bend - (speed**2 - slow**2) / (2.0 * braked) - PERIOD * speed
    # Up to there it is the preview's own.
    whole = local_reference(row, PERIOD, FINE, leading=2.0)
    np.testing.assert_allclose(found.arc_length[:began], whole.arc_length[:began], rtol=1e-9)


def test_no_reference_leaves_the_friction_circle():
    rng, tried = np.random.default_rng(9), 0
    for _ in range(100):
        grip = rng.uniform(1.0, 8.0)
        speed = np.abs(rng.uniform(5.0, 15.0) + np.cumsum(rng.uniform(-0.6, 0.6, 21)))
        curvature = rng.uniform(-0.15, 0.15) * (rng.uniform(size=20) < 0.3)
        row = observed(speed[0], curvature, speed[1:])
        nodes = local_reference(row, PERIOD).arc_length
        # A slow vehicle that accelerates at once has the reference of friction alone.
        found = local_reference(row, PERIOD, FINE, leading=1e9, grip=grip, braking=4.0)
        known = found.arc_length[-1] > nodes
        passed = np.interp(nodes, found.arc_length[1:], found.speed[1:])[known]
        assert (passed <= speed[known] + 1e-2).all()
        tried += int((passed < speed[known] - 0.1).any())
        for k in range(len(passed) - 1):
            first, last = passed[k], passed[k + 1]
            along = (last**2 - first**2) / (2.0 * (nodes[k + 1] - nodes[k]))
            assert max(first, last) ** 2 * abs(curvature[k]) < 1.01 * grip
            assert math.hypot(min(first, last) ** 2 * curvature[k], along) < 1.01 * grip + 0.05
    assert tried > 50


def test_a_vehicle_that_heads_elsewhere_is_led_as_one_that_is_slow():
    _, curvature, _ = drawn(np.random.default_rng(8))
    seen = observed(8.0, curvature, 8.0)._replace(longitudinal_speed=8.0, heading_error=1.0)
    slow = observed(8.0, curvature, 8.0)._replace(longitudinal_speed=8.0 * math.cos(1.0))
    lengths = np.full(20, PERIOD)
    turned, led = (local_reference(one, PERIOD, lengths, leading=2.0) for one in (seen, slow))
    for one, other in zip(turned, led, strict=True):
        np.testing.assert_array_equal(one, other)
    assert led.speed[0] == pytest.approx(8.0 * math.cos(1.0) + LEAD)


def test_points_between_behind_and_beyond():
    radius = 10.0
    found = local_reference(observed(5.0, 1.0 / radius, 5.0), PERIOD)
    for s in (0.0, 0.13, 2.2, 4.999, 5.0):
        point = point_at(found, s)
        assert point.x == pytest.approx(radius * math.sin(s / radius), abs=1e-9)
        assert point.y == pytest.approx(radius * (1.0 - math.cos(s / radius)), abs=1e-9)
        assert point.heading == pytest.approx(s / radius)
    assert point_at(found, -2.0) == pytest.approx((-2.0, 0.0, 0.0))
    straight, end = point_at(found, 8.0), point_at(found, 5.0)
    assert straight.heading == end.heading
    assert straight.x == pytest.approx(end.x + 3.0 * math.cos(end.heading))
    curved = point_at(found, 8.0, 1.0 / radius)
    assert curved.x == pytest.approx(radius * math.sin(0.8))


def test_mean_curvature_of_any_stretch():
    curvature = np.repeat([0.0, 0.1], 10)
    found = local_reference(observed(5.0, curvature, 5.0), PERIOD)
    assert mean_curvature(found, 0.0, 2.0) == pytest.approx(0.0)
    assert mean_curvature(found, 2.0, 3.0) == pytest.approx(0.05)
    assert mean_curvature(found, 3.0, 50.0) == pytest.approx(0.1)
    assert mean_curvature(found, 90.0, 99.0) == pytest.approx(0.1)
    assert mean_curvature(found, -5.0, 0.0) == pytest.approx(0.0)


@pytest.mark.parametrize("vehicle", list(VEHICLES.values()), ids=list(VEHICLES))
@pytest.mark.parametrize("speed", [1.0, 3.0, 10.0, 20.0])
@pytest.mark.parametrize("curvature", [0.01, -0.04])
def test_a_steady_turn_is_an_equilibrium_on_the_circle(vehicle, speed, curvature):
    turn = steady_turn(curvature, speed, vehicle)
    state = np.array([speed, speed * math.tan(turn.sideslip), 0.0, turn.yaw_rate, 0.0, 0.0])
    rate = bicycle.derivative(state, np.array([0.0, turn.steering_angle]), vehicle)
    if abs(turn.steering_angle) < vehicle.max_steering_angle:
        np.testing.assert_allclose(rate[[bicycle.VY, bicycle.YAW_RATE]], 0.0, atol=2e-3)
    assert turn.yaw_rate / math.hypot(state[0], state[1]) == pytest.approx(curvature)


@pytest.mark.parametrize("vehicle", VEHICLES.values(), ids=VEHICLES)
@pytest.mark.parametrize("speed", [1.0, 4.0, 8.0])
def test_the_sharpest_turns_are_the_steady_turns_at_the_limits(vehicle, speed):
    # Steady turns end at full lock: here the sideslip binds everywhere.
    wide = vehicle.replace(max_steering_angle=1.5)
    by_sideslip = wide.sharpest_turns(np.array([speed]))[1][0]
    assert math.tan(steady_turn(by_sideslip, speed, wide).sideslip) == pytest.approx(
        vehicle.max_lateral_velocity_ratio * np.sign(lever_of(vehicle, speed)), rel=1e-9
    )
    # The steady turn has the cosine of the steering angle, the limit's formula has not.
    gentle = vehicle.replace(max_steering_angle=0.02)
    by_steering = gentle.sharpest_turns(np.array([speed]))[0][0]
    assert steady_turn(by_steering, speed, gentle).steering_angle == pytest.approx(0.02, rel=1e-3)


def lever_of(vehicle, speed):
    """Lateral speed per yaw rate of a steady turn, m."""
    return vehicle.rear_axle_distance - (
        vehicle.mass * speed**2 * vehicle.front_axle_distance
        / (vehicle.wheelbase * vehicle.rear_cornering_stiffness)
    )  # fmt: skip


def test_steady_turns_agree_with_rajamani_for_small_angles():
    vehicle = VEHICLES["course-car"]
    turn = steady_turn(1e-4, 8.0, vehicle)
    expected = 1e-4 * (vehicle.wheelbase + vehicle.understeer_gradient * 64.0)
    assert turn.steering_angle == pytest.approx(expected, rel=1e-6)
    assert steady_turn(0.1, 0.0, vehicle).yaw_rate == 0.0


def test_a_transient_turn_settles():
    vehicle = VEHICLES["m2-minibus"]
    turn = steady_turn(0.05, 5.0, vehicle)
    assert transient_turn(turn, turn.sideslip, 5.0, vehicle) == turn
    # Entering a curve, the rear axle has not swung in: the front is turned less.
    entering = transient_turn(turn, 0.0, 5.0, vehicle)
    assert entering.steering_angle < turn.steering_angle
    sideslip = 0.0
    for _ in range(100):
        sideslip = lagged_sideslip(turn, sideslip, 0.25, vehicle)
    assert sideslip == pytest.approx(turn.sideslip)


def test_only_corners_that_cannot_be_driven_are_begun_early():
    limit = 0.08
    assert early_turn(local_reference(observed(5.0, 0.15, 5.0), PERIOD), limit) == (0.0, 0.0, 0.0)
    corner = np.zeros(20)
    corner[4] = -0.8 / 0.25  # 0.8 rad to the right within 0.25 m, from 1 m ahead on
    early = early_turn(local_reference(observed(5.0, corner, 5.0), PERIOD), limit)
    assert early.heading == pytest.approx(-(0.4 - limit * 1.25))
    assert early.lateral_offset == pytest.approx(-(early.heading**2) / (2.0 * limit))
    assert early.curvature == -limit
    corner[:] = 0.0
    corner[19] = -0.8 / 0.25  # still too far away
    later = early_turn(local_reference(observed(5.0, corner, 5.0), PERIOD), limit)
    assert later.curvature == pytest.approx(0.0)
