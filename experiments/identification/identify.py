"""Identification of a vehicle from its logs: windows, fit, what the logs cannot tell, check."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from experiments.identification import motion
from experiments.identification.fit import GUESSED, Fit, WindowFit
from experiments.identification.log import CHANNELS, Log
from experiments.identification.model import (
    BIAS,
    COUNT,
    DRIVE_DEAD,
    DRIVE_LAG,
    FRONT,
    GAIN,
    OFFSET,
    PARAMETERS,
    RATIO,
    REAR,
    ROLLING,
    SCALED,
    SHORTEST_LAG,
    SIDESLIP,
    STEERING_DEAD,
    STEERING_LAG,
    UNITS,
    Predictor,
    Windows,
    nominal_parameters,
    windows_of,
)
from lpv_track_env.bicycle import LOW_SPEED, fastest_pole
from lpv_track_env.plausibility import GRAVITY
from lpv_track_env.vehicle import VehicleParameters

Array = NDArray[np.float64]

WINDOW = 3.0
"""Length of a window, s."""
STEP, RESOLVED = 0.01, 0.75
"""Longest integration step, s, and the largest product of step and fastest pole."""
SETTLING = 1.0
"""Time at a log's start that is left out, s: what was commanded before is unknown."""
LINEAR = 3.0
"""Largest lateral acceleration, m/s^2, at which tyres count as linear."""
FEWEST, FEWEST_CHECKED = 5, 2
"""Fewest windows that are fitted, and that are checked."""
TRAINED = 2.0 / 3.0
"""Share of a log's windows that is fitted; the others check the result."""
FIRST_TIME = 0.05
"""Lags and dead times from which the fit starts, s."""
WORST: Mapping[int, float] = {
    FRONT: 0.25, REAR: 0.25, RATIO: 0.25, GAIN: 0.25, ROLLING: 0.2, OFFSET: 0.02, BIAS: 0.02,
    SIDESLIP: 0.02,
    DRIVE_LAG: 0.1, DRIVE_DEAD: 0.1, STEERING_LAG: 0.05, STEERING_DEAD: 0.05,
}  # fmt: skip
"""Largest deviation of each parameter that is identified: relative, then m/s^2, rad, rad/s, s."""
DISTINCT = 2.0
"""Standard deviations from 0 at which lag and dead time of the same actuator count as distinct."""
WORDS: Mapping[int, tuple[str, str]] = {
    FRONT: ("front cornering stiffness", "steer in bends and quickly"),
    REAR: ("rear cornering stiffness", "steer in bends and quickly"),
    RATIO: ("yaw inertia", "steer to and fro at 0.5 to 2 Hz"),
    GAIN: ("gain of the drive", "accelerate and brake"),
    ROLLING: ("rolling resistance", "drive at steady speed, too"),
    OFFSET: ("steering offset", "drive straight, too"),
    BIAS: ("bias of the yaw rate", "drive straight, too"),
    SIDESLIP: ("angle of the sensors' axis", "drive straight, too"),
    DRIVE_LAG: ("lag of the drive", "change the acceleration quickly"),
    DRIVE_DEAD: ("dead time of the drive", "change the acceleration quickly"),
    STEERING_LAG: ("lag of the steering", "steer quickly"),
    STEERING_DEAD: ("dead time of the steering", "steer quickly"),
}
"""Each parameter in words, and the way to drive for a log that tells it."""


@dataclass(frozen=True)
class Check:
    """Predictions of the windows that were not fitted.

    Parameters
    ----------
    rms
        Root mean square errors by channel: m/s, m/s, rad, rad/s, m, m.
    share
        Fit by channel, 1 - |error| / |reading - mean|.
    traces
        For each window: channel to (times, readings, predictions).
    """

    rms: dict[str, float]
    share: dict[str, float]
    traces: list[dict[str, tuple[Array, Array, Array]]]


@dataclass(frozen=True)
class Identification:
    """Outcome of an identification.

    Parameters
    ----------
    nominal, vehicle
        The vehicle that was given, and the identified one.
    fit
        Parameters with deviations; those that were not fitted have the deviation NaN.
    free
        Places of the identified parameters in `PARAMETERS`.
    remarks
        What the logs cannot tell, and other notes, a line each.
    excitation
        Ranges that were driven, by name.
    windows
        Numbers of windows: fitted, checked, too slow, beyond the tyres' linear range.
    checks
        Predictions of the nominal and of the identified vehicle.
    conditions
        Fields of `lpv_track_env.conditions` for the identified actuators.
    """

    nominal: VehicleParameters
    vehicle: VehicleParameters
    fit: Fit
    free: tuple[int, ...]
    remarks: list[str]
    excitation: dict[str, float]
    windows: dict[str, int]
    checks: dict[str, Check]
    conditions: dict[str, float]


Progress = Callable[[str], None]


def identify(
    logs: Sequence[Log],
    nominal: VehicleParameters,
    *,
    name: str,
    friction: float = math.inf,
    window: float = WINDOW,
    longest_step: float = STEP,
    progress: Progress = lambda _: None,
) -> Identification:
    """Identify a vehicle.

    Parameters
    ----------
    logs
        Drives of the same vehicle.
    nominal
        Start of the fit. Its mass and its axles' places are kept: motion alone tells ratios to the
        mass.
    name
        Name of the identified vehicle.
    friction
        Known coefficient of friction: tyres are those of `lpv_track_env.tyres`, and all windows
        are fitted. Without it tyres are linear, and windows beyond `LINEAR` are left out.
    window, longest_step
        Lengths of windows and integration steps, s.
    progress
        Called with a line on what is done; may raise to end the work.

    Raises
    ------
    ValueError
        If too little can be fitted, or the identified vehicle is not plausible.
    """
    for log in logs:
        motion.check(log)
    fitted, checked, counts, excitation = _cut(
        logs, window, _step(logs, nominal, longest_step), math.isinf(friction)
    )
    if counts["fitted"] < FEWEST or counts["checked"] < FEWEST_CHECKED:
        raise ValueError(
            f"{logs[0].name}: {counts['fitted']} + {counts['checked']} windows of {window:g} s can "
            f"be used, {FEWEST} + {FEWEST_CHECKED} are needed: {counts['slow']} are slower than "
            f"{LOW_SPEED:g} m/s, {counts['sliding']} turn with more than {LINEAR:g} m/s^2"
            + ("; --friction MU takes the latter, too" if counts["sliding"] else "")
        )
    predictor = Predictor(nominal, fitted, friction)
    start = nominal_parameters(nominal)
    solver = WindowFit(predictor, _first_states(fitted, nominal), start)
    start = start.copy()
    free = _possible(logs)
    timed = [k for k in (DRIVE_LAG, DRIVE_DEAD, STEERING_LAG, STEERING_DEAD) if k in free]
    start[timed] = FIRST_TIME
    fit, free, remarks = _fit(solver, start, free, nominal, progress)
    vehicle, notes = _vehicle(fit, nominal, name, logs)
    progress("check")
    checks = {}
    predictor = Predictor(nominal, checked, friction)
    first = _first_states(checked, nominal)
    for label, parameters in (
        ("nominal", nominal_parameters(nominal)), ("identified", fit.parameters),
    ):  # fmt: skip
        checks[label] = _check(WindowFit(predictor, first, parameters), parameters, checked)
    return Identification(
        nominal, vehicle, fit, tuple(sorted(free)), remarks + notes, excitation, counts, checks,
        _conditions(fit, free),
    )  # fmt: skip


Part = tuple[Log, Windows]


def _step(logs: Sequence[Log], nominal: VehicleParameters, longest: float) -> float:
    """Return the step that resolves the lateral poles where the logs are slowest, s."""
    speeds = np.concatenate([motion.speed(log, np.arange(*log.span, longest)) for log in logs])
    driven = speeds[speeds >= LOW_SPEED]
    slowest = float(driven.min()) if driven.size else LOW_SPEED
    return min(longest, RESOLVED / fastest_pole(slowest, nominal))


def _cut(
    logs: Sequence[Log], window: float, longest_step: float, linear: bool
) -> tuple[list[Part], list[Part], dict[str, int], dict[str, float]]:
    """Return windows to fit and to check, their counts, and the ranges that were driven."""
    fitted: list[Part] = []
    checked: list[Part] = []
    counts = dict.fromkeys(("fitted", "checked", "slow", "sliding"), 0)
    driven: dict[str, list[float]] = {"speed": [], "lateral": [], "yaw": []}
    for log in logs:
        first, last = log.span
        whole = windows_of(log, first + SETTLING, last, window, longest_step)
        kept = []
        for k, (a, n) in enumerate(zip(whole.first.tolist(), whole.steps.tolist(), strict=True)):
            times = whole.nodes[a : a + n + 1]
            speed, turning = motion.speed(log, times), motion.turning(log, times)
            lateral = float(np.percentile(np.abs(speed * turning), 95.0))
            if speed.min() < LOW_SPEED:
                counts["slow"] += 1
            elif linear and lateral > LINEAR:
                counts["sliding"] += 1
            else:
                kept.append(k)
                driven["speed"] += [float(speed.min()), float(speed.max())]
                driven["lateral"].append(lateral)
                driven["yaw"].append(float(np.std(np.gradient(turning, times))))
        border = round(TRAINED * len(whole.first))
        for part, chosen, label in (
            (fitted, [k for k in kept if k < border], "fitted"),
            (checked, [k for k in kept if k >= border], "checked"),
        ):
            counts[label] += len(chosen)
            if chosen:
                part.append((log, _chosen(whole, chosen)))
    excitation = {}
    if driven["lateral"]:
        excitation = {
            "lowest_speed": min(driven["speed"]), "highest_speed": max(driven["speed"]),
            "lateral_acceleration": max(driven["lateral"]),
            "yaw_acceleration_rms": float(np.sqrt(np.mean(np.square(driven["yaw"])))),
        }  # fmt: skip
    return fitted, checked, counts, excitation


def _chosen(whole: Windows, chosen: list[int]) -> Windows:
    return Windows(
        whole.nodes, whole.first[chosen], whole.steps[chosen],
        tuple(whole.readings[k] for k in chosen),
    )  # fmt: skip


def _first_states(parts: Sequence[Part], nominal: VehicleParameters) -> Array:
    """Guess the states (W, 6) at the windows' starts from what was read there."""
    rows = []
    for log, windows in parts:
        at = windows.nodes[windows.first]
        speed, turning = motion.speed(log, at), motion.turning(log, at)
        rows.append(
            np.column_stack(
                [
                    speed,
                    np.interp(at, *log.readings["vy"])
                    if "vy" in log.readings
                    else nominal.rear_axle_distance * turning,
                    motion.heading(log, at),
                    turning,
                    *(
                        np.interp(at, *log.readings[name])
                        if name in log.readings
                        else np.zeros_like(at)
                        for name in ("x", "y")
                    ),
                ]
            )
        )
    return np.concatenate(rows)


def _possible(logs: Sequence[Log]) -> set[int]:
    """Return the parameters that the logs' channels can tell."""
    free = set(range(COUNT))
    absolute = all({"heading", "x"} & set(log.readings) for log in logs)
    if not (absolute and all("yaw_rate" in log.readings for log in logs)):
        free.discard(BIAS)
    if not all("vy" in log.readings or {"heading", "x"} <= set(log.readings) for log in logs):
        free.discard(SIDESLIP)
    return free


def _fit(
    solver: WindowFit,
    start: Array,
    free: set[int],
    nominal: VehicleParameters,
    progress: Progress,
) -> tuple[Fit, set[int], list[str]]:
    """Fit; hold what is too uncertain at its nominal value, the worst first, and fit anew.

    What is `GUESSED` is not held: it stays near its nominal value by itself.
    """
    none = nominal_parameters(nominal)
    remarks: list[str] = []
    solver.fit(start, ())
    place: int | None = -1
    while place is not None:
        words = f"fit of {len(free)} parameters"
        fit = solver.fit(start, free, _steps(progress, words))
        start, place = fit.parameters.copy(), _indistinct(fit, free)
        if place is None:
            excess = {k: float(fit.deviations[k]) / WORST[k] for k in free if k not in GUESSED}
            place = max(excess, key=lambda one: excess[one], default=None)
            if place is None or excess[place] <= 1.0:
                break
            remarks.append(_not_told(place, float(fit.deviations[place])))
        free = free - {place}
        start[place] = none[place]
    remarks += [
        _not_told(k, float(fit.deviations[k]))
        for k in sorted(GUESSED)
        if fit.deviations[k] > WORST[k]
    ]
    if not fit.settled:
        remarks.append("the fit had not settled after its last step: do not rely on it")
    return fit, free, remarks


def _steps(progress: Progress, words: str) -> Callable[[int], None]:
    return lambda step: progress(f"{words}, step {step + 1}")


def _indistinct(fit: Fit, free: set[int]) -> int | None:
    """Return of an actuator's lag and dead time the one nearer to 0, if they are not told apart."""
    for pair in ((DRIVE_LAG, DRIVE_DEAD), (STEERING_LAG, STEERING_DEAD)):
        if free.issuperset(pair):
            sigmas = [float(fit.parameters[k] / max(fit.deviations[k], 1e-12)) for k in pair]
            if min(sigmas) < DISTINCT:
                return pair[int(np.argmin(sigmas))]
    return None


def _not_told(place: int, deviation: float) -> str:
    """Return the remark on a parameter that is too uncertain."""
    word, advice = WORDS[place]
    size = f"{min(deviation, 99.0):.2g} {UNITS[place]}"
    if place in SCALED:
        size = f"{100.0 * min(deviation, 9.99):.0f} %"
    kept = "leans on the nominal value" if place in GUESSED else "the nominal value is kept"
    return f"{word}: not determined by these logs (1 sigma {size}), {kept}; {advice}"


def _vehicle(
    fit: Fit, nominal: VehicleParameters, name: str, logs: Sequence[Log]
) -> tuple[VehicleParameters, list[str]]:
    """Return the identified vehicle, and notes on results that a vehicle's file cannot hold."""
    p, notes = fit.parameters, []
    rolling = float(p[ROLLING]) / GRAVITY
    if rolling < 0.0:
        if rolling * GRAVITY < -2.0 * np.nan_to_num(fit.deviations[ROLLING]):
            notes.append(
                f"the vehicle gains {-rolling * GRAVITY:.3f} m/s^2 over its command: taken as no "
                "rolling resistance"
            )
        rolling = 0.0
    gain, deviation = float(p[GAIN]), float(fit.deviations[GAIN])
    if abs(gain - 1.0) > max(2.0 * deviation, 0.02):
        notes.append(
            f"the drive gives {gain:.3f} (1 sigma {deviation:.3f}) of the commanded acceleration, "
            "which a vehicle's file cannot hold"
        )
    arms = nominal.front_axle_distance * nominal.rear_axle_distance
    sources = ", ".join(log.name for log in logs)
    return nominal.replace(
        name=name,
        source=f"identified from {sources}; all else as {nominal.name}: {nominal.source}",
        yaw_inertia=float(p[RATIO]) * nominal.mass * arms,
        front_cornering_stiffness=float(p[FRONT]) * nominal.mass,
        rear_cornering_stiffness=float(p[REAR]) * nominal.mass,
        rolling_resistance=rolling,
    ), notes


def _conditions(fit: Fit, free: set[int]) -> dict[str, float]:
    """Return the fields of conditions for actuators that differ from perfect ones by 2 sigma."""
    found = {}
    for place in (DRIVE_LAG, DRIVE_DEAD, STEERING_LAG, STEERING_DEAD, OFFSET):
        value = float(fit.parameters[place])
        if place in free and abs(value) > max(2.0 * float(fit.deviations[place]), SHORTEST_LAG):
            found[PARAMETERS[place]] = value
    return found


def _check(solver: WindowFit, parameters: Array, parts: Sequence[Part]) -> Check:
    """Predict windows that were not fitted; their initial states are fitted."""
    predictions = solver.predicted(parameters)
    traces = []
    logs = [(log, windows, k) for log, windows in parts for k in range(len(windows.first))]
    for (_, windows, k), predicted in zip(logs, predictions, strict=True):
        times = windows.nodes[windows.first[k] :]
        traces.append(
            {
                name: (times[at], values, predicted[name])
                for name, (at, values) in windows.readings[k].items()
            }
        )
    rms, share = {}, {}
    for name in CHANNELS:
        rows = [one[name] for one in traces if name in one]
        if rows:
            read = np.concatenate([values for _, values, _ in rows])
            errors = read - np.concatenate([values for _, _, values in rows])
            rms[name] = float(np.sqrt(np.mean(errors**2)))
            spread = float(np.std(read))
            share[name] = 1.0 - rms[name] / spread if spread > 0.0 else 0.0
    return Check(rms, share, traces)
