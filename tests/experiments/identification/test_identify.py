"""Identification: exact logs, noisy logs, other plants, poor and hostile logs, the commands."""

import json
import math
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from experiments.cli import main
from experiments.identification import model
from experiments.identification.excitation import record
from experiments.identification.identify import Identification, identify
from experiments.identification.log import Log, read
from experiments.identification.model import COUNT, SCALED, Predictor, nominal_parameters
from lpv_track_env import PATH_TRACKING, vehicle
from lpv_track_env.vehicle import BMW_320I, M2_MINIBUS, VehicleParameters
from trajectories.path import ReferencePath

WRONG = BMW_320I.replace(
    name="wrong",
    front_cornering_stiffness=1.4 * BMW_320I.front_cornering_stiffness,
    rear_cornering_stiffness=0.6 * BMW_320I.rear_cornering_stiffness,
    yaw_inertia=1.4 * BMW_320I.yaw_inertia,
)
"""The nominal car: wrong by 40 % in what is identified."""
ACTUATORS = {
    "steering_lag": 0.1, "steering_dead_time": 0.03, "drive_lag": 0.2, "drive_dead_time": 0.06,
    "steering_offset": 0.005,
}  # fmt: skip


def driven(folder: Path, car: VehicleParameters = BMW_320I, **settings) -> Log:
    """The log of an excitation; 60 s at 20 Hz unless told otherwise."""
    file = folder / "log.csv"
    record(file, car, **{"seconds": 60.0, "period": 0.05, **settings})
    return read(file)


def truth(car: VehicleParameters = BMW_320I, **actuators: float) -> np.ndarray:
    values = nominal_parameters(car)
    for name, value in actuators.items():
        values[model.PARAMETERS.index(name)] = value
    return values


def errors(found: Identification, true: np.ndarray) -> np.ndarray:
    """Errors of the parameters; relative where their deviations are."""
    return np.array(
        [
            math.log(value / right) if place in SCALED else value - right
            for place, (value, right) in enumerate(zip(found.fit.parameters, true, strict=True))
        ]
    )


def relative(found: Identification, car: VehicleParameters) -> np.ndarray:
    """Errors of front and rear stiffness and yaw inertia, relative."""
    names = ("front_cornering_stiffness", "rear_cornering_stiffness", "yaw_inertia")
    return np.array([getattr(found.vehicle, name) / getattr(car, name) - 1.0 for name in names])


def test_exact_logs_give_the_vehicle_back(tmp_path: Path) -> None:
    """To 1e-5: of the shortest lag, 1 us. The bicycle's integrator takes the same 5 ms steps."""
    log = driven(tmp_path, noise=0.0)
    found = identify([log], WRONG, name="found", longest_step=0.005)
    assert np.abs(relative(found, BMW_320I)).max() < 5e-5
    assert not found.conditions
    assert found.remarks == []
    assert found.checks["identified"].rms["yaw_rate"] < 1e-5 < found.checks["nominal"].rms["vy"]
    assert found.vehicle.mass == WRONG.mass
    assert found.vehicle.name == "found"


def test_exact_logs_give_rolling_resistance_and_actuators_back(tmp_path: Path) -> None:
    log = driven(tmp_path, M2_MINIBUS, noise=0.0, conditions={**ACTUATORS, "estimator": "truth"})
    nominal = M2_MINIBUS.replace(front_cornering_stiffness=6e4, rolling_resistance=0.0)
    found = identify([log], nominal, name="found", longest_step=0.005)
    assert np.abs(relative(found, M2_MINIBUS)).max() < 1e-3
    assert found.vehicle.rolling_resistance == pytest.approx(0.02, rel=1e-3)
    assert set(found.conditions) == set(ACTUATORS)
    for name, value in ACTUATORS.items():
        assert found.conditions[name] == pytest.approx(value, abs=5e-4), name


def test_noisy_logs_cover_the_truth(tmp_path: Path) -> None:
    """Over four seeds: every parameter within 3 sigma or so, and by 1 sigma on average."""
    true = truth(**ACTUATORS)
    scores = []
    for seed in range(4):
        conditions = {**ACTUATORS, "estimator": "truth"}
        log = driven(tmp_path, seed=seed, conditions=conditions)
        found = identify([log], WRONG, name="found")
        assert set(found.free) == set(range(COUNT))
        scores.append(errors(found, true) / found.fit.deviations)
        assert found.fit.noise["yaw_rate"] == pytest.approx(0.005, rel=0.1)
        assert found.fit.noise["vy"] == pytest.approx(0.05, rel=0.1)
    assert np.abs(scores).max() < 3.5
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.3


def test_deviations_are_those_of_repeated_drives(tmp_path: Path) -> None:
    """Ten draws of the noise on one drive: their spread is the deviation that each reports."""
    true = record(tmp_path / "log.csv", BMW_320I, seconds=40.0, period=0.05, noise=0.0)
    stiffness, reported = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        noise = {"vx": 0.03, "vy": 0.05, "yaw_rate": 0.005}
        readings = {
            name: (true["time"], true[name] + sigma * rng.standard_normal(len(true["time"])))
            for name, sigma in noise.items()
        }
        commands = np.column_stack([true["acceleration_command"], true["steering_command"]])
        found = identify([Log("log", (true["time"], commands), readings)], WRONG, name="found")
        stiffness.append(math.log(found.fit.parameters[model.FRONT]))
        reported.append(found.fit.deviations[model.FRONT])
    # The spread of ten has a standard deviation of a quarter of itself.
    assert 0.5 < np.std(stiffness, ddof=1) / np.median(reported) < 1.6


def test_sensitivities_are_difference_quotients(tmp_path: Path) -> None:
    from experiments.identification.identify import _cut

    log = driven(tmp_path, seconds=40.0)
    parts, _, _, _ = _cut([log], 3.0, 0.01, linear=False)
    predictor = Predictor(WRONG, parts, math.inf)
    initial = np.tile([9.0, 0.1, 0.2, 0.05, 1.0, 2.0], (len(predictor.windows), 1))
    at = truth(WRONG, **{**ACTUATORS, "steering_dead_time": 0.031, "drive_dead_time": 0.063})
    states, slopes = predictor.predict(initial, at)
    for place in range(COUNT):
        step = 1e-6
        high, low = at.copy(), at.copy()
        high[place] += step
        low[place] -= step
        ends = [predictor.predict(initial, one)[0] for one in (high, low)]
        quotient = (ends[0] - ends[1]) / (2.0 * step)
        ours = slopes[:, :, 6 + place]
        assert np.abs(ours - quotient).max() <= 1e-4 * max(np.abs(quotient).max(), 1e-3), place
    shifted = initial.copy()
    shifted[:, 3] += 1e-6
    quotient = (predictor.predict(shifted, at)[0] - states) / 1e-6
    np.testing.assert_allclose(slopes[:, :, 3], quotient, atol=1e-4)


def steady_slips(plant: str, speed: float, angle: float) -> np.ndarray:
    """Slip angles and lateral forces by mass of both axles in a steady turn of a plant, (2, 2)."""
    car = BMW_320I
    line, flat = np.linspace(0.0, 4000.0, 200), np.zeros(200)
    env = gymnasium.make(
        PATH_TRACKING, trajectory=ReferencePath(line, line, flat, flat, flat, flat + speed),
        vehicle=car, plant=plant, max_lateral_error=1e4, time_limit=30.0, control_period=0.02,
    )  # fmt: skip
    _, info = env.reset(options={"speed": speed})
    states, behind = [], 0.0
    for k in range(175):
        slower = speed - info["state"][0]
        behind += 0.02 * slower
        delta = min(angle, 0.9 * car.max_steering_rate * 0.02 * (k + 1))
        *_, info = env.step(np.array([2.0 * slower + 0.5 * behind, delta], np.float32))
        states.append(info["state"])
    vx, vy, _, r = np.mean(states[-25:], axis=0)[:4]
    lf, lr = car.front_axle_distance, car.rear_axle_distance
    slips = angle - (vy + lf * r) / vx, (lr * r - vy) / vx
    return np.array([slips, (vx * r * lr / car.wheelbase, vx * r * lf / car.wheelbase)])


def effective_stiffness(plant: str, lateral: np.ndarray) -> np.ndarray:
    """Stiffnesses by mass, (2,): least squares through the forces of steady turns.

    An independent experiment: steady turns to a grid of lateral accelerations, weighted as the
    drive's were. The multi-body's tyres push sideways by their camber, which follows the roll's
    sign: at 1 m/s^2 its axles are a third stiffer than the tyre's slope at zero slip.
    """
    turns = np.array([steady_slips(plant, 10.0, angle) for angle in (0.01, 0.02, 0.04, 0.07)])
    lateral = np.abs(lateral)[::20]
    found = []
    for axle in range(2):
        slips = np.concatenate([[0.0], turns[:, 0, axle]])
        forces = np.concatenate([[0.0], turns[:, 1, axle]])
        lateral_by_force = turns[0, 1].sum() / turns[0, 1, axle]
        force = lateral / lateral_by_force
        slip = np.interp(force, forces, slips)
        found.append(float(force @ slip / (slip @ slip)))
    return np.array(found)


@pytest.mark.parametrize("plant", ["single-track", "multi-body"])
def test_other_peoples_cars_are_identified(plant: str, tmp_path: Path) -> None:
    """Within 10 %, from a car that is wrong by 40 %."""
    pytest.importorskip("vehiclemodels", reason="needs the extra plants")
    log = driven(tmp_path, seconds=90.0, plant=plant)
    found = identify([log], WRONG, name="found")
    lateral = log.readings["vx"][1] * log.readings["yaw_rate"][1]
    true = effective_stiffness(plant, lateral)
    ours = found.fit.parameters[[model.FRONT, model.REAR]]
    np.testing.assert_allclose(ours, true, rtol=0.1)
    if plant == "single-track":  # linear tyres
        np.testing.assert_allclose(relative(found, BMW_320I)[:2], 0.0, atol=0.05)
    rms = {label: check.rms["yaw_rate"] for label, check in found.checks.items()}
    assert rms["identified"] < 1.3 * 0.005 < rms["nominal"]


@pytest.mark.parametrize(
    ("channels", "told"),
    [
        ({"vx": (0.7, 0.03), "vy": (0.5, 0.05), "yaw_rate": (0.9, 0.005)}, True),
        ({"x": (0.9, 0.02), "y": (0.9, 0.02), "yaw_rate": (0.9, 0.005)}, True),
        ({"vx": (0.7, 0.03), "yaw_rate": (0.9, 0.005)}, False),
    ],
)
def test_uneven_sparse_channels_are_used_for_what_they_tell(
    channels: dict[str, tuple[float, float]], told: bool, tmp_path: Path
) -> None:
    """Readings at their own times, some of them missing; a yaw rate alone tells no stiffness.

    The response of the yaw rate to the steering hardly changes if both stiffnesses and the inertia
    grow alike.
    """
    true = record(tmp_path / "log.csv", BMW_320I, seconds=90.0, period=0.05, noise=0.0)
    rng, count = np.random.default_rng(1), len(true["time"])
    readings = {}
    for name, (share, noise) in channels.items():
        kept = np.sort(rng.choice(count, int(share * count), replace=False))
        values = true[name][kept] + noise * rng.standard_normal(len(kept))
        readings[name] = (true["time"][kept], values)
    commands = np.column_stack([true["acceleration_command"], true["steering_command"]])
    found = identify([Log("log", (true["time"], commands), readings)], WRONG, name="found")
    tyres = [model.FRONT, model.REAR, model.RATIO]
    assert np.abs(errors(found, truth())[tyres] / found.fit.deviations[tyres]).max() < 3.0
    assert (found.fit.deviations[tyres].max() < 0.1) == told
    assert found.vehicle.understeer_gradient == pytest.approx(0.0, abs=3e-4)


def test_a_misaligned_sensor_is_seen_through(tmp_path: Path) -> None:
    """A sensor whose axis points 2 degrees to the right reads a lateral speed straight ahead."""
    log = driven(tmp_path)
    angle = math.radians(2.0)
    readings = dict(log.readings)
    times, lateral = readings["vy"]
    readings["vy"] = times, lateral + angle * np.interp(times, *readings["vx"])
    readings["heading"] = readings["heading"][0], readings["heading"][1] - angle
    readings["yaw_rate"] = readings["yaw_rate"][0], readings["yaw_rate"][1] + 0.01
    found = identify([Log("log", log.commands, readings)], WRONG, name="found")
    assert found.fit.parameters[model.SIDESLIP] == pytest.approx(angle, abs=1e-3)
    assert found.fit.parameters[model.BIAS] == pytest.approx(0.01, abs=1e-3)
    score = errors(found, truth()) / found.fit.deviations
    assert np.abs(score[[model.FRONT, model.REAR, model.RATIO]]).max() < 3.0


def test_what_a_log_cannot_tell_is_said(tmp_path: Path) -> None:
    """Straight ahead nothing tells the tyres; a slow steady drive does not tell the inertia."""
    log = driven(tmp_path, lateral_acceleration=1e-3, seconds=40.0)
    found = identify([log], WRONG, name="found")
    told = "\n".join(found.remarks)
    assert "front cornering stiffness: not determined by these logs (1 sigma" in told
    assert "leans on the nominal value; steer in bends" in told
    assert "rear cornering stiffness: not determined" in told
    assert "yaw inertia: not determined" in told
    assert all(len(line) < 300 for line in found.remarks)
    assert np.abs(relative(found, WRONG)).max() < 0.5
    assert found.fit.deviations[model.FRONT] > 0.25


def test_a_known_friction_takes_what_slides(tmp_path: Path) -> None:
    """Linear tyres leave windows beyond 3 m/s^2 out; those of a known friction do not."""
    log = driven(
        tmp_path, lateral_acceleration=5.0, conditions={"friction": 0.9, "estimator": "truth"}
    )
    found = identify([log], WRONG, name="found", friction=0.9)
    score = errors(found, truth()) / found.fit.deviations
    assert np.abs(score[[model.FRONT, model.REAR, model.RATIO]]).max() < 3.5
    assert found.windows["sliding"] == 0
    with pytest.raises(ValueError, match=r"turn with more than 3 m/s\^2; --friction MU takes"):
        identify([log], WRONG, name="found")


HEADER = "time,vx,yaw_rate,acceleration_command,steering_command"


def rows(count: int = 700, period: float = 0.05) -> list[str]:
    return [f"{period * k},8,{0.1 * math.sin(k)},0,{0.01 * math.sin(k)}" for k in range(count)]


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "no rows"),
        ([HEADER], "no rows"),
        (["time,vx,yaw_rate,acceleration_command", "0,1,2,3"], "no column steering_command or"),
        ([HEADER, *rows(300)[:5], "0.1,8,0,0,0"], "time 0.1 is not after 0.2"),
        ([HEADER, *rows(100)], "5.0 s of drive; at least 30 are needed"),
        ([HEADER, *rows(80_000)], "4000 s of drive; cut it"),
        ([HEADER, *rows(300), "15,fast,0,0,0"], "line 302, column vx: 'fast' is not a number"),
        ([HEADER, *rows(300), "15,inf,0,0,0"], "'inf' is not finite"),
        ([HEADER, *rows(300), "15,8,0"], "line 302 has 3 columns, not 5"),
        ([HEADER, *rows(300), ",8,0,0,0"], "line 302: has no time"),
        ([HEADER.replace("vx", "other"), *rows()], "neither a speed .vx. nor positions"),
        ([HEADER.replace("yaw_rate", "other"), *rows()], "neither a yaw rate, nor a heading"),
        ([HEADER.replace("vx", "x"), *rows()], "has x or y alone"),
        ([HEADER, *[row.replace(",8,", ",0.1,") for row in rows()]], "are slower than 1 m/s"),
    ],
)
def test_hostile_logs_are_refused_in_one_line(
    tmp_path: Path, lines: list[str], message: str
) -> None:
    file = tmp_path / "log.csv"
    file.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=message) as caught:
        identify([read(file)], M2_MINIBUS, name="found")
    assert "log.csv" in str(caught.value)
    assert len(str(caught.value)) < 300
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("columns", "factor", "message"),
    [
        (["steering_command"], 57.3, "steering up to [0-9.]+ rad; is it in degrees"),
        (["steering_command"], -1.0, "turns right where the steering is positive"),
        (
            ["yaw_rate"],
            57.3,
            "heading changes 0.01[78].* as fast as yaw_rate says: are both in rad",
        ),
        (["heading"], 57.3, "heading changes 5[789].* times as fast"),
        (["heading"], -1.0, "heading changes -1.* times as fast"),
        (["vx"], 3.6, "positions move 0.278 times as fast as vx says: are they in m and m/s"),
        (["yaw_rate", "heading"], -1.0, "turns right where the steering is positive"),
    ],
)
def test_other_units_and_signs_are_refused(
    columns: list[str], factor: float, message: str, tmp_path: Path
) -> None:
    log = driven(tmp_path, seconds=30.0)
    readings = {
        name: (times, factor * values if name in columns else values)
        for name, (times, values) in log.readings.items()
    }
    sent = log.commands[1] * np.array([1.0, factor if "steering_command" in columns else 1.0])
    with pytest.raises(ValueError, match=message) as caught:
        identify([Log("log", (log.commands[0], sent), readings)], WRONG, name="found")
    assert len(str(caught.value)) < 200


def test_a_start_that_diverges_is_refused(tmp_path: Path) -> None:
    """Tyres a thousand times as stiff need shorter steps than those that are taken."""
    from experiments.identification.fit import WindowFit
    from experiments.identification.identify import _cut

    parts, _, _, _ = _cut([driven(tmp_path, seconds=40.0)], 3.0, 0.01, linear=False)
    predictor = Predictor(WRONG, parts, math.inf)
    initial = np.tile([9.0, 0.1, 0.2, 0.05, 1.0, 2.0], (len(predictor.windows), 1))
    start = truth(WRONG, front_stiffness=1e5, rear_stiffness=1e5)
    with pytest.raises(ValueError, match="does not stay finite over a window"):
        WindowFit(predictor, initial, start).fit(start, ())


def test_dense_readings_are_averaged(tmp_path: Path) -> None:
    from experiments.identification.log import averaged

    times = 0.001 * np.arange(5000)
    at, values = averaged(times, 3.0 * times)
    assert len(at) == 500
    np.testing.assert_allclose(values, 3.0 * at, atol=1e-12)
    sparse = 0.05 * np.arange(10)
    assert averaged(sparse, sparse)[0] is sparse


def test_commands_record_identify_and_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("wrong.json").write_text(json.dumps(WRONG.as_dict()))
    excite = ["excite", "--vehicle", "bmw-320i", "--seconds", "40", "--control-period", "0.05"]
    actuators = ["--conditions", "ideal", "--conditions-set", "steering_lag=0.1"]
    assert main([*excite, *actuators, "--seed", "3", "--out", "drive.csv"]) == 0
    assert main(["identify", "drive.csv", "--vehicle", "wrong.json", "--out", "my.json"]) == 0
    printed = capsys.readouterr().out
    assert "--vehicles my.json --conditions ideal --conditions-set steering_lag=" in printed
    car = vehicle.load("my.json")
    assert car.name == "my"
    assert "identified from drive.csv; all else as wrong" in car.source
    assert car.front_cornering_stiffness == pytest.approx(
        BMW_320I.front_cornering_stiffness, rel=0.15
    )
    details = json.loads(Path("my.identification.json").read_text())
    assert details["conditions"]["steering_lag"] == pytest.approx(0.1, abs=0.02)
    assert details["parameters"]["front_stiffness"]["deviation"] > 0.0
    assert {"revision", "versions"} <= set(details)
    assert Path("my.png").read_bytes()[:4] == b"\x89PNG"
    gymnasium.make(PATH_TRACKING, vehicle="my.json", conditions=details["conditions"]).reset(seed=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["identify", "none.csv", "--out", "my.json"], "none.csv: cannot be read"),
        (["identify", "none.csv", "--out", "my.txt"], "a vehicle is written as NAME.json"),
        (["identify", "none.csv", "--vehicle", "bmw", "--out", "my.json"], "unknown vehicle 'bmw'"),
        (["identify", "--out", "my.json"], "LOG"),
        (["excite", "--out", "log.txt"], "a log is written as NAME.csv"),
        (["excite", "--speeds", "9", "3", "--out", "log.csv"], "the lower one first"),
        (["excite", "--env", "plants=3", "--out", "log.csv"], "plants"),
    ],
)
def test_wrong_arguments_are_one_line(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert printed.out == ""


def test_bags_are_logs(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra bags")
    from experiments.ros.topics import SECOND, Commands, Odometry
    from experiments.ros.write import write

    true = record(tmp_path / "log.csv", BMW_320I, seconds=30.0, period=0.05, noise=0.0)
    stamp = SECOND + np.rint(true["time"] * SECOND).astype(np.int64)
    odometry = Odometry(
        stamp, true["x"], true["y"], true["heading"], true["vx"], true["vy"], true["yaw_rate"]
    )
    sent = Commands(
        stamp, true["acceleration_command"], true["steering_command"], np.zeros(len(stamp))
    )
    write(tmp_path / "drive.bag", {"/odom": odometry, "/command": sent})
    bag, table = read(tmp_path / "drive.bag"), read(tmp_path / "log.csv")
    assert set(bag.readings) == set(table.readings)
    for name, (times, values) in table.readings.items():
        np.testing.assert_allclose(bag.readings[name][0], times, atol=1e-6)
        np.testing.assert_allclose(bag.readings[name][1], values, atol=1e-6)
    # ackermann_msgs holds single precision.
    np.testing.assert_allclose(bag.commands[1], table.commands[1], atol=1e-6)
