"""The paper's table from results: the rows, which `console_tables` and `html_tables` draw.

Cases are grouped by setting (vehicle, speed mode and whatever else of a case is not the default)
and trajectory. A group's first row is the published one (kumar2025lpv, simulation), then one row
per agent; several seeds become a mean and a 95 % interval of it by the t-distribution.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from scipy.stats import t as student

import agents
import trajectories
from experiments.run import published
from experiments.run.case import Case
from experiments.run.learning_words import words

Result = Mapping[str, Any]

CONFIDENCE = 0.95
KEPT = 1e-3
"""A constraint broken by no more than this, in its own unit, counts as kept (as in `metrics`)."""
UNITS = {
    "speed": "m/s",
    "lateral_velocity": "m/s",
    "longitudinal_acceleration": "m/s²",
    "steering_angle": "rad",
    "steering_rate": "rad/s",
    "jerk": "m/s³",
}
SYMBOLS = {
    "speed": "vx range",
    "lateral_velocity": "|vy|/vx",
    "longitudinal_acceleration": "dvx/dt range",
    "steering_angle": "|δ|",
    "steering_rate": "|dδ/dt|",
    "jerk": "|da/dt|",
}
PUBLISHED_LABEL = "published"
PUBLISHED_DECIMALS = 2
PUBLISHED_NOTE = (
    "Published rows: kumar2025lpv; simulation, and beside other conditions its runs with the "
    "vehicle. Its vehicle, weights and paths are not public: they stand there for orientation."
)


@dataclass(frozen=True)
class Estimate:
    """A mean over runs, and the half width of its 95 % interval where there are several."""

    mean: float
    half_width: float | None = None


@dataclass(frozen=True)
class Column:
    """A numeric column: key in `Row.values`, heading, unit, decimals, factor on what is stored."""

    key: str
    heading: str
    unit: str
    decimals: int
    factor: float = 1.0
    source: str = "metrics"

    def text(self, row: "Row", separator: str = " ") -> str:
        """Cell of a row: the mean, and ± half width after `separator`; published as printed."""
        found = row.values.get(self.key)
        if found is None:
            return "–"
        decimals = PUBLISHED_DECIMALS if row.published else self.decimals
        mean = f"{self.factor * found.mean:.{decimals}f}"
        if found.half_width is None:
            return mean
        return f"{mean}{separator}±{self.factor * found.half_width:.{decimals}f}"


TRACKING = tuple(
    Column(key, published.LABELS[key].rsplit(" ", 1)[0], published.LABELS[key].rsplit(" ", 1)[1], 3)
    for key in published.COLUMNS
)
"""The paper's columns: in metres, and for the heading in radians."""
EFFORT = (
    Column("median", "predict median", "ms", 2, 1e3, "solver"),
    Column("p99", "predict p99", "ms", 2, 1e3, "solver"),
    Column("steering_variation", "steering variation", "rad", 2),
    Column("acceleration_variation", "accel. variation", "m/s²", 1),
)
FURTHER = (
    Column("mean_abs_lateral_error", "mean |e_d|", "m", 3),
    Column("mean_time_indexed_distance", "mean by the clock", "m", 3),
    Column("max_time_indexed_distance", "max by the clock", "m", 3),
    Column("rms_speed_error", "rms speed error", "m/s", 3),
    Column("max_speed_error", "max speed error", "m/s", 3),
    Column("steering_rate_rms", "rms steering rate", "rad/s", 3),
    Column("jerk_rms", "rms jerk", "m/s³", 3),
    Column("rms_estimate_error", "rms error of the estimate", "m", 3),
    Column("deadline_misses", "deadline misses", "", 1),
    Column("stopping_share", "share braking by itself", "", 3),
    Column("duration", "duration", "s", 1),
)
"""What the paper's table leaves out; "by the clock" is the distance to where the reference is."""


@dataclass(frozen=True)
class Row:
    """One line of the tables: a published row or an agent's runs of one setting and trajectory."""

    setting: str
    trajectory: str
    label: str
    values: Mapping[str, Estimate] = field(default_factory=dict)
    published: bool = False
    end: str = ""
    failures: str = ""
    violations: str = ""
    learning: str = ""
    runs: int = 0


def estimate(values: Sequence[float]) -> Estimate:
    """Mean of one or more values; from two on with its interval, t_(0.975, n - 1) s / sqrt(n)."""
    mean = float(np.mean(values))
    n = len(values)
    if n < 2:
        return Estimate(mean)
    quantile = float(student.ppf(0.5 + CONFIDENCE / 2.0, n - 1))
    return Estimate(mean, quantile * float(np.std(values, ddof=1)) / n**0.5)


def _raw(case: Result) -> bool:
    return str(case.get("trajectory")).endswith("-raw")


def _departures(case: Result) -> int:
    """In how many respects a case's setting is not the default one."""
    names = ("vehicle", "speed_mode", "fixed_speed", "conditions", "control_period")
    changed = [case.get(name, getattr(Case, name)) != getattr(Case, name) for name in names]
    extra = (
        _raw(case), case.get("vehicle_changes"), case.get("env_settings"), case.get("computing"),
    )  # fmt: skip
    return sum(map(bool, (*changed, *extra)))


def _changes(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}={values[key]}" for key in sorted(values))


def setting_of(case: Result) -> str:
    """Words for all that two cases share if they may stand in one table: all but path and agent.

    Raw waypoints are a setting: averaged with drivable paths they would tell nothing of either.
    """
    parts = [str(case.get("vehicle", "?"))]
    if changed := case.get("vehicle_changes"):
        parts.append(f"with {_changes(changed)}")
    speed = f"{case.get('speed_mode', '?')} speed"
    if case.get("fixed_speed") is not None:
        speed += f" {case['fixed_speed']} m/s"
    parts.append(speed)
    if _raw(case):
        parts.append("raw waypoints")
    if (given := case.get("conditions", "simulation")) != "simulation":
        parts.append(f"conditions {conditions_words(given)}")
    if given := case.get("computing"):
        parts.append(f"computing {given['arrangement']} x {given.get('load', 1):g}")
    if case.get("control_period", Case.control_period) != Case.control_period:
        parts.append(f"control period {case['control_period']} s")
    if changed := case.get("env_settings"):
        parts.append(f"env {_changes(changed)}")
    return " · ".join(parts)


def conditions_words(given: str | Mapping[str, Any]) -> str:
    """Name of conditions, and what departs from them."""
    if isinstance(given, str):
        return given
    rest = {key: value for key, value in given.items() if key != "name"}
    name = str(given.get("name", "ideal"))
    return f"{name} with {_changes(rest)}" if rest else name


def label_of(case: Result) -> str:
    """The agent and, where it has any, its settings."""
    settings = case.get("agent_settings")
    return f"{case.get('agent', '?')}" + (f" ({_changes(settings)})" if settings else "")


def labels(cases: Iterable[Result]) -> list[str]:
    """Labels of agents in the order of the registry, each once."""
    rank = _rank(agents.names())
    found = {label_of(case): str(case.get("agent")) for case in cases}
    return sorted(found, key=lambda label: (rank(found[label]), label))


def current(cases: Iterable[Result]) -> list[Result]:
    """Cases without those that a later one repeats: same case, run from other sources.

    A case's id changes with the project's sources, so a folder that was resumed after a change
    holds both; averaged, they would pass for two seeds.
    """
    names = [item.name for item in fields(Case)]
    latest = {repr([(name, case.get(name)) for name in names]): case for case in cases}
    return list(latest.values())


def _rank(known: Sequence[str]) -> Callable[[str], tuple[int, str]]:
    places = {name: place for place, name in enumerate(known)}
    return lambda name: (places.get(name, len(places)), name)


def ordered(cases: Iterable[Result]) -> list[Result]:
    """Cases by setting, trajectory, agent and seed, independent of the order they were run in."""
    path, agent = _rank(trajectories.names()), _rank(agents.names())
    return sorted(
        cases,
        key=lambda case: (
            _departures(case),
            setting_of(case),
            path(str(case.get("trajectory"))),
            agent(str(case.get("agent"))),
            label_of(case),
            case.get("seed", 0),
        ),
    )


def violated(metrics: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Constraints that an episode broke: name -> (largest excess, share of control periods)."""
    names = [key.removeprefix("excess_") for key in metrics if key.startswith("excess_")]
    return {
        name: (float(metrics[f"excess_{name}"]), float(metrics.get(f"violated_{name}", 0.0)))
        for name in names
        if metrics[f"excess_{name}"] > KEPT
    }


def _violation_words(episodes: Sequence[Mapping[str, float]]) -> str:
    """Per constraint the largest excess over episodes and the mean share; "none" if all is kept."""
    broken = [violated(metrics) for metrics in episodes]
    words = []
    for name in dict.fromkeys(name for one in broken for name in one):
        excess = max(one[name][0] for one in broken if name in one)
        share = sum(one[name][1] for one in broken if name in one) / len(broken)
        percent = f"{100 * share:.1f}" if share >= 5e-4 else "<0.1"
        words.append(
            f"{SYMBOLS.get(name, name)}: {excess:.3g} {UNITS.get(name, '')}".rstrip()
            + f", {percent} %"
        )
    return "; ".join(words) or "none"


def _failure_words(cases: Sequence[Result]) -> str:
    """Failed of all solves; "–" for agents that solve nothing."""
    solves = sum(case["solver"].get("solves") or 0 for case in cases)
    failures = sum(case["solver"].get("failures") or 0 for case in cases)
    return f"{failures} of {solves}" if solves else "–"


def _end_words(cases: Sequence[Result]) -> str:
    """How episodes ended: the word alone if all did alike, counts otherwise."""
    ends = Counter(
        str(case.get("end") or "?").replace("_", " ") if case.get("status") == "ok" else "failed"
        for case in cases
    )
    if len(ends) == 1 and len(cases) == 1:
        return next(iter(ends))
    return ", ".join(f"{count} {end}" for end, count in ends.items())


def _learning_words(cases: Iterable[Result]) -> str:
    """What learning cost; "" for agents designed by hand, and where results do not tell."""
    told = [words(case["training"]) for case in cases if case.get("training")]
    return "; ".join(dict.fromkeys(told))


def _agent_row(setting: str, trajectory: str, label: str, cases: Sequence[Result]) -> Row:
    done = [case for case in cases if case.get("status") == "ok"]
    values = {}
    for column in (*TRACKING, *EFFORT, *FURTHER):
        found = [case.get(column.source, {}).get(column.key) for case in done]
        numbers = [float(value) for value in found if value is not None]
        if numbers:
            values[column.key] = estimate(numbers)
    return Row(
        setting=setting,
        trajectory=trajectory,
        label=label,
        values=values,
        end=_end_words(cases),
        failures=_failure_words(done) if done else "–",
        violations=_violation_words([case["metrics"] for case in done]) if done else "–",
        learning=_learning_words(cases),
        runs=len(done),
    )


def build_rows(cases: Iterable[Result]) -> list[Row]:
    """All rows in order: per setting and trajectory the published one, then the agents'."""
    groups: dict[tuple[str, str], dict[str, list[Result]]] = {}
    for case in ordered(current(cases)):
        key = setting_of(case), str(case.get("trajectory"))
        groups.setdefault(key, {}).setdefault(label_of(case), []).append(case)
    rows = []
    for (setting, trajectory), by_label in groups.items():
        conditions = next(iter(by_label.values()))[0].get("conditions", "simulation")
        reference = published.row(trajectory, conditions)
        if reference is not None:
            values = {key: Estimate(value) for key, value in reference.items()}
            rows.append(Row(setting, trajectory, PUBLISHED_LABEL, values, published=True))
        rows += [_agent_row(setting, trajectory, label, group) for label, group in by_label.items()]
    return rows


def by_setting(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Rows by their setting, in order."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.setting, []).append(row)
    return groups


def cases_by_setting(cases: Iterable[Result]) -> dict[str, list[Result]]:
    """Cases by their setting, in order."""
    groups: dict[str, list[Result]] = {}
    for case in cases:
        groups.setdefault(setting_of(case), []).append(case)
    return groups
