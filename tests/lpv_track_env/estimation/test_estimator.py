"""The extended Kalman filter: consistent, and unmoved by what sensors and links do wrong."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from lpv_track_env import bicycle, tyres
from lpv_track_env.bicycle import PSI, VX, VY, YAW_RATE, X, Y
from lpv_track_env.estimation import filter as filtering
from lpv_track_env.estimation.estimator import Estimator, EstimatorSettings
from lpv_track_env.vehicle import VEHICLES

Array = NDArray[np.float64]

CAR = VEHICLES["m2-minibus"]
SETTINGS = EstimatorSettings()
RUNS, PERIODS, PERIOD = 25, 300, 0.05
TYRES = pytest.mark.parametrize("friction", [math.inf, 0.15])
"""The linear tyre, and one that slides on up to 0.7 of its patch in these drives."""


def simulated(
    state: Array, action: Array, duration: float, friction: float = math.inf, steps: int = 20
) -> Array:
    """The bicycle driven on by Runge-Kutta steps on NumPy: not the filter's compiled integrator."""
    h = duration / steps
    for _ in range(steps):
        k1 = bicycle.derivative(state, action, CAR, friction)
        k2 = bicycle.derivative(state + 0.5 * h * k1, action, CAR, friction)
        k3 = bicycle.derivative(state + 0.5 * h * k2, action, CAR, friction)
        k4 = bicycle.derivative(state + h * k3, action, CAR, friction)
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return state


class Drive:
    """A vehicle with the noise that the filter believes in, and a filter beside it."""

    def __init__(
        self,
        seed: int,
        latency: float = 0.1,
        settings: EstimatorSettings = SETTINGS,
        friction: float = math.inf,
    ) -> None:
        self.friction = friction
        self.rng = np.random.default_rng(seed)
        s, draw = settings, self.rng.normal
        self.latency, self.time = latency, 0.0
        self.biases = draw(size=3) * [
            s.initial_gyro_bias, s.initial_heading_bias, s.initial_steering_offset,
        ]  # fmt: skip
        self.state = np.array([8.0, draw() * s.lateral_speed_noise, 0.0, 0.0, 0.0, 0.0])
        self.filter = Estimator(CAR, s, period=PERIOD, friction=friction)
        self.filter.begin(
            0.0,
            draw() * s.position_deviation,
            draw() * s.position_deviation,
            self.biases[1] + draw() * s.heading_deviation,
            8.0 + draw() * s.speed_deviation,
        )
        self.on_the_way: list[tuple[float, float, float]] = []

    def go_on(self, fixes: bool = True, **changed: float) -> list[str]:
        """One period; `changed` replaces readings. What came of the fixes that arrived."""
        s, rng = SETTINGS, self.rng
        action = np.array(
            [0.2 + 0.5 * math.sin(0.2 * self.time), 0.02 + 0.1 * math.sin(0.3 * self.time)]
        )
        self.state = simulated(
            self.state, action + np.array([0.0, self.biases[2]]), PERIOD, self.friction
        )
        noise = [
            s.speed_noise, s.lateral_speed_noise, s.heading_noise, s.yaw_rate_noise,
            s.position_noise, s.position_noise,
        ]  # fmt: skip
        self.state = self.state + math.sqrt(PERIOD) * rng.normal(size=6) * noise
        walks = [s.gyro_bias_noise, s.heading_bias_noise, s.steering_offset_noise]
        self.biases += math.sqrt(PERIOD) * rng.normal(size=3) * walks
        self.time += PERIOD
        readings = {
            "heading": self.state[PSI] + self.biases[1] + rng.normal() * s.heading_deviation,
            "yaw_rate": self.state[3] + self.biases[0] + rng.normal() * s.yaw_rate_deviation,
            "speed": self.state[VX] + rng.normal() * s.speed_deviation,
        }
        self.filter.advance(self.time, action[0], action[1], **{**readings, **changed})
        if fixes and round(self.time / PERIOD) % 2 == 0:
            x, y = self.state[[X, Y]] + rng.normal(size=2) * s.position_deviation
            self.on_the_way.append((self.time, x, y))
        results = []
        while self.on_the_way and self.on_the_way[0][0] + self.latency <= self.time + 1e-9:
            results.append(self.filter.take_fix(*self.on_the_way.pop(0)))
        return results

    @property
    def error(self) -> Array:
        return np.concatenate([self.filter.state - self.state, self.filter.biases - self.biases])


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_consistent_over_many_runs(latency: float) -> None:
    """NIS and NEES lie in the two-sided 99.9 % chi-square band of their sums."""
    # Gates would cut the distributions' tails off.
    open_gates = replace(SETTINGS, fix_gate=1e6, reading_gate=1e6)
    fix_nis, reading_nis, nees = [], [], []
    for seed in range(RUNS):
        drive = Drive(seed, latency, open_gates)
        for _ in range(PERIODS):
            if drive.go_on():
                fix_nis.append(drive.filter.fix_nis)
            reading_nis.append(drive.filter.reading_nis[0])
            assert drive.filter.reading_nis[1] == 3
        # One NEES a run: within a run they are correlated.
        nees.append(drive.error @ np.linalg.solve(drive.filter.covariance, drive.error))
    for values, degrees in ((fix_nis, 2), (reading_nis, 3), (nees, 9)):
        low, high = chi2.ppf([0.0005, 0.9995], degrees * len(values))
        assert low <= np.sum(values) <= high, (degrees, np.mean(values))


@TYRES
def test_perfect_readings_are_followed_exactly(friction: float) -> None:
    state = np.array([8.0, 0.0, 0.3, 0.0, 5.0, -2.0])
    estimator = Estimator(CAR, SETTINGS, period=PERIOD, friction=friction)
    estimator.begin(0.0, 5.0, -2.0, 0.3, 8.0)
    for k in range(1, 200):
        action = np.array([0.3 * math.sin(0.1 * k), 0.1 * math.sin(0.05 * k)])
        state = simulated(state, action, PERIOD, friction)
        estimator.advance(k * PERIOD, *action, heading=state[2], yaw_rate=state[3], speed=state[0])
        assert estimator.take_fix(k * PERIOD, state[4], state[5]) == "used"
    np.testing.assert_allclose(estimator.state, state, atol=2e-6)
    np.testing.assert_allclose(estimator.biases, 0.0, atol=1e-6)


@TYRES
def test_prediction_covariance_is_that_of_the_model(friction: float) -> None:
    """One prediction against Jacobians of CasADi's on the same field, integrated by itself."""
    import casadi as ca

    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 2)
    steps, h = 10, PERIOD / 10
    after = x
    for _ in range(steps):
        k1 = bicycle.casadi_derivative(after, u, CAR, friction)
        k2 = bicycle.casadi_derivative(after + 0.5 * h * k1, u, CAR, friction)
        k3 = bicycle.casadi_derivative(after + 0.5 * h * k2, u, CAR, friction)
        k4 = bicycle.casadi_derivative(after + h * k3, u, CAR, friction)
        after = after + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    jacobians = ca.Function("j", [x, u], [ca.jacobian(after, x), ca.jacobian(after, u)])
    drive = Drive(3, friction=friction)
    for _ in range(100):
        drive.go_on()
    before, covariance = drive.filter.state, drive.filter.covariance
    offset = drive.filter.biases[2]
    drive.filter.advance(drive.time + PERIOD, 0.4, 0.05)
    by_state, by_input = jacobians(before, [0.4, 0.05 + offset])
    transition = np.eye(9)
    transition[:6, :6] = np.array(by_state)
    transition[:6, filtering.STEERING_OFFSET] = np.array(by_input)[:, 1]
    s = SETTINGS
    densities = np.square(
        [
            s.speed_noise, s.lateral_speed_noise, s.heading_noise, s.yaw_rate_noise,
            s.position_noise, s.position_noise, s.gyro_bias_noise, s.heading_bias_noise,
            s.steering_offset_noise,
        ]
    )  # fmt: skip
    # The noise of vy and r grows with the larger slip, by the one at which a tyre slides wholly.
    vx, vy, _, r = before[:4]
    front = 0.05 + offset - (vy + CAR.front_axle_distance * r) / vx
    rear = (CAR.rear_axle_distance * r - vy) / vx
    _, _, front_sharpness, rear_sharpness, _, _ = tyres.of(CAR, friction)
    slip = min(max(abs(front) * front_sharpness, abs(rear) * rear_sharpness), 1.0)
    assert (slip == 0.0) == (friction == math.inf)
    densities[[VY, YAW_RATE]] *= 1.0 + filtering.SLIDING_NOISE * slip**2
    wanted = transition @ covariance @ transition.T + PERIOD * np.diag(densities)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    np.testing.assert_allclose(drive.filter.covariance / scale, wanted / scale, atol=1e-4)


def test_late_fixes_count_as_if_in_time() -> None:
    """The same fixes with and without latency end in the same estimate, once all have come."""
    drives = [Drive(5, latency) for latency in (0.0, 0.15)]
    for k in range(120):
        for drive in drives:
            drive.go_on(fixes=k < 110)
    one, other = (drive.filter for drive in drives)
    np.testing.assert_allclose(one.state, other.state, atol=1e-12)
    np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-14)
    assert one.counts == other.counts


def test_a_fix_between_two_steps_is_moved_to_the_nearest() -> None:
    estimator = Estimator(CAR, SETTINGS, period=PERIOD)
    estimator.begin(0.0, 0.0, 0.0, 0.0, 10.0)
    for k in range(1, 7):
        estimator.advance(k * PERIOD, CAR.rolling_deceleration, 0.0, speed=10.0)
    before = estimator.state
    # Where it is at 0.22 s: 10 m/s x 0.22 s.
    assert estimator.take_fix(0.22, 2.2, 0.0) == "used"
    np.testing.assert_allclose(estimator.state, before, atol=1e-9)


def test_outage_grows_the_covariance_and_the_next_fix_ends_it() -> None:
    drive = Drive(2, latency=0.0)
    for _ in range(100):
        drive.go_on()
    before = drive.filter.position_deviation
    deviations = []
    for _ in range(40):
        drive.go_on(fixes=False)
        deviations.append(drive.filter.position_deviation)
    assert np.all(np.diff(deviations) > 0.0)
    assert deviations[-1] > 1.5 * before
    assert drive.filter.fix_age == pytest.approx(2.0)
    assert np.hypot(*drive.error[[X, Y]]) < 4.0 * deviations[-1]
    for _ in range(20):
        drive.go_on()
    assert drive.filter.position_deviation < 1.2 * before
    assert drive.filter.fix_age < 0.11


def test_outliers_are_gated() -> None:
    drive = Drive(7, latency=0.0)
    for _ in range(100):
        drive.go_on()
    for k in range(10):
        drive.go_on(fixes=False)
        before = drive.filter.state
        x, y = drive.state[[X, Y]] + [3.0, -1.0]
        assert drive.filter.take_fix(drive.time, x, y) == "gated"
        np.testing.assert_array_equal(drive.filter.state, before)
        assert drive.filter.counts["fixes_gated"] == k + 1


def test_a_jump_that_stays_is_believed_in_the_end() -> None:
    drive = Drive(8, latency=0.0)
    for _ in range(60):
        drive.go_on()
    jump = np.array([4.0, 3.0])
    results = []
    for k in range(80):
        drive.go_on(fixes=False)
        if k % 2 == 0:
            results.append(drive.filter.take_fix(drive.time, *(drive.state[[X, Y]] + jump)))
    assert results[:10] == ["gated"] * 10
    assert results[-5:] == ["used"] * 5
    offset = drive.filter.state[[X, Y]] - drive.state[[X, Y]]
    np.testing.assert_allclose(offset, jump, atol=0.3)


FAULTS: dict[str, tuple[float, float, float, str]] = {
    "duplicate": (0.0, 0.0, 0.0, "duplicate"),
    "out of order": (-0.05, 0.0, 0.0, "late"),
    "too late": (-5.0, 0.0, 0.0, "late"),
    "NaN": (0.05, math.nan, 0.0, "not finite"),
    "infinite": (0.05, 0.0, math.inf, "not finite"),
    "stamp NaN": (math.nan, 0.0, 0.0, "not finite"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_fix_changes_nothing(fault: str) -> None:
    drive = Drive(1, latency=0.0)
    last = 0.0
    for _ in range(60):
        last = drive.time if drive.go_on() else last
    before, covariance = drive.filter.state, drive.filter.covariance
    delay, ex, ey, wanted = FAULTS[fault]
    x, y = drive.state[[X, Y]] + [ex, ey]
    assert drive.filter.take_fix(last + delay, x, y) == wanted
    np.testing.assert_array_equal(drive.filter.state, before)
    np.testing.assert_array_equal(drive.filter.covariance, covariance)


@pytest.mark.parametrize("reading", ["heading", "yaw_rate", "speed"])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e9, -40.0])
def test_a_faulty_reading_is_left_out(reading: str, value: float) -> None:
    """As if it had not come; what is finite is counted as gated."""
    one, other = Drive(4), Drive(4)
    for _ in range(100):
        one.go_on()
        other.go_on()
    one.go_on(**{reading: value})
    other.go_on(**{reading: math.nan})
    np.testing.assert_array_equal(one.filter.state, other.filter.state)
    gated = one.filter.counts[f"{reading}s_gated"]
    # A heading is an angle: 1e9 rad and -40 rad are some directions or other.
    assert gated == int(math.isfinite(value))


def test_a_step_of_the_gyro_bias_is_survived() -> None:
    """0.2 rad/s: gated at first, then believed; state finite, heading right again at the end."""
    drive = Drive(6, latency=0.0)
    for _ in range(100):
        drive.go_on()
    drive.biases[0] += 0.2
    for _ in range(200):
        drive.go_on()
        assert np.isfinite(drive.filter.state).all()
    assert drive.filter.counts["yaw_rates_gated"] >= SETTINGS.most_rejected
    assert abs(drive.error[6]) < 0.02
    assert abs(drive.error[PSI]) < 0.02
    assert np.hypot(*drive.error[[X, Y]]) < 0.5


def test_covariance_stays_symmetric_and_positive() -> None:
    drive = Drive(9)
    for _ in range(600):
        drive.go_on()
    covariance = drive.filter.covariance
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_standstill_and_reverse_stay_finite() -> None:
    estimator = Estimator(CAR, SETTINGS, period=PERIOD)
    estimator.begin(0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(1, 400):
        speed = -0.5 if k > 200 else 0.0
        estimator.advance(k * PERIOD, 0.0, 0.3, heading=0.0, yaw_rate=0.0, speed=speed)
        if k % 2 == 0:
            estimator.take_fix(k * PERIOD, 0.0, 0.0)
    assert np.isfinite(estimator.state).all()
    assert np.linalg.eigvalsh(estimator.covariance).min() > 0.0


BAD: dict[str, tuple[Any, str]] = {
    "before begin": (lambda e: e.advance(1.0, 0.0, 0.0), "call begin"),
    "fix before begin": (lambda e: e.take_fix(1.0, 0.0, 0.0), "call begin"),
    "begin": (lambda e: e.begin(0.0, math.nan, 0.0, 0.0, 1.0), "finite"),
    "backwards": (
        lambda e: (e.begin(1.0, 0.0, 0.0, 0.0, 1.0), e.advance(0.5, 0.0, 0.0)), "goes back",
    ),
    "input": (
        lambda e: (e.begin(1.0, 0.0, 0.0, 0.0, 1.0), e.advance(2.0, math.nan, 0.0)), "finite",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_errors(case: str) -> None:
    call, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        call(Estimator(CAR))


def test_bad_settings() -> None:
    with pytest.raises(ValueError, match="speed_noise must be >= 0"):
        EstimatorSettings(speed_noise=-1.0)
    with pytest.raises(ValueError, match="position_deviation must be in"):
        EstimatorSettings(position_deviation=0.0)
    with pytest.raises(ValueError, match="period and memory"):
        Estimator(CAR, period=0.5, memory=0.3)
