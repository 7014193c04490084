"""Rows of the paper's table from results; `console_tables` and the report draw them.

Cases are grouped by setting (vehicle, speed mode, conditions and so on) and trajectory. A group's
first row is the published one (kumar2025lpv), then comes one row per agent; several seeds become a
mean and its 95 % interval by the t-distribution.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import agents
import trajectories
from experiments.run import suites
from experiments.run.estimates import Estimate, range_words, two_way
from experiments.run.learning_cost import average, words
from experiments.run.metrics import KEPT, PAPER_COLUMNS, published_row
from experiments.run.settings import USUAL, Setting, changes_words, setting_of
from experiments.run.training_folders import trained

Result = Mapping[str, Any]

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
SPREADS = "± over evaluation seeds ± over trainings"
"""Heading of tables in which an agent has several trainings."""
TRAININGS_NOTE = (
    "An agent with several trainings is one row: its mean over trainings and evaluation seeds, ± "
    "the 95 % interval over evaluation seeds (of each seed's mean over trainings), ± the one over "
    "trainings (of each training's mean over seeds), both by the t-distribution. The two are never "
    "pooled; where there is one evaluation seed, the first is missing (±–)."
)
PUBLISHED_LABEL = "published"
PUBLISHED_DECIMALS = 2
PUBLISHED_NOTE = (
    "Published rows are from kumar2025lpv: its simulations, and beside other conditions its runs "
    "with the vehicle. They are for orientation only, since its vehicle, weights and paths are not "
    "public."
)


@dataclass(frozen=True)
class Column:
    """Numeric column: key in `Row.values`, heading, unit, decimals, factor on stored values."""

    key: str
    heading: str
    unit: str
    decimals: int
    factor: float = 1.0
    source: str = "metrics"

    def text(self, row: "Row", separator: str = " ") -> str:
        """Return the cell of a row, see `Estimate.words`."""
        found = row.values.get(self.key)
        if found is None:
            return "–"
        decimals = PUBLISHED_DECIMALS if row.published else self.decimals
        return found.words(decimals, separator, self.factor)


TRACKING = tuple(Column(key, heading, unit, 3) for key, (heading, unit) in PAPER_COLUMNS.items())
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
    Column("lap_time", "lap time", "s", 2),
    Column("grip_used_max", "largest share of grip", "", 2),
    Column("grip_used_rms", "rms share of grip", "", 2),
)
"""Further columns; "by the clock" is the distance to the reference's position at the time."""


@dataclass(frozen=True)
class Row:
    """Row of the tables: published values, or an agent's runs of one setting and trajectory."""

    setting: Setting
    trajectory: str
    label: str
    values: Mapping[str, Estimate] = field(default_factory=dict)
    published: bool = False
    end: str = ""
    failures: str = ""
    violations: str = ""
    learning: str = ""
    runs: int = 0
    trainings: int = 0

    @property
    def name(self) -> str:
        """Label, and the number of trainings if there are several."""
        return with_trainings(self.label, self.trainings)


def path_name(trajectory: object) -> str:
    """Return the name of a trajectory; of a file, the name without its folder."""
    return Path(str(trajectory)).name


def path_names(trajectories: Iterable[str]) -> dict[str, str]:
    """Return the names of trajectories; of two files of one name, with their folders'."""
    found = {trajectory: path_name(trajectory) for trajectory in trajectories}
    count = Counter(found.values())
    return {
        trajectory: name if count[name] == 1 else "/".join(Path(trajectory).parts[-2:])
        for trajectory, name in found.items()
    }


def training_of(case: Result) -> int | None:
    """Return the training seed of a case's agent, one of several in a folder; None for others."""
    return trained(case).seed


def label_of(case: Result) -> str:
    """Return a case's agent, with its settings if any; this names its rows.

    The trainings of a folder are one agent, see `training_folders.trained`.
    """
    agent, settings, _ = trained(case)
    return f"{agent} ({changes_words(settings)})" if settings else agent


def trainings_of(cases: Iterable[Result]) -> int:
    """Return the number of training seeds among the cases of an agent."""
    return len({training_of(case) for case in cases} - {None})


def with_trainings(label: str, count: int) -> str:
    """Return an agent's label, and the number of its trainings if there are several."""
    return f"{label}, {count} trainings" if count > 1 else label


def case_name(case: Result) -> str:
    """Return the label of a case's agent, and its training seed if it has one."""
    training = training_of(case)
    return label_of(case) if training is None else f"{label_of(case)}, training {training}"


def has_trainings(cases: Iterable[Result]) -> bool:
    """Return whether an agent of the cases has several trainings."""
    found: dict[str, int] = {}
    for case in cases:
        if (training := training_of(case)) is not None and (
            found.setdefault(label_of(case), training) != training
        ):
            return True
    return False


def training_range(cases: Iterable[Result], failed: Callable[[Result], bool]) -> str:
    """Return the least and largest rate of failures among trainings; "" without several."""
    groups: dict[int | None, list[bool]] = {}
    for case in cases:
        groups.setdefault(training_of(case), []).append(failed(case))
    if len(groups) < 2:
        return ""
    return range_words([100.0 * sum(group) / len(group) for group in groups.values()])


def labels(cases: Iterable[Result]) -> list[str]:
    """Return the labels of agents in the order of the registry, each once."""
    return list(by_label(cases))


def by_label(cases: Iterable[Result]) -> dict[str, list[Result]]:
    """Group cases by the label of their agent, in the order of the registry."""
    rank = _rank(agents.names())
    found: dict[str, list[Result]] = {}
    for case in cases:
        found.setdefault(label_of(case), []).append(case)
    order = sorted(found, key=lambda label: (rank(str(found[label][-1].get("agent"))), label))
    return {label: found[label] for label in order}


def current(cases: Iterable[Result]) -> list[Result]:
    """Return the cases without those that a later one repeats with other sources.

    A case's id changes with the project's sources, so a folder that was resumed after a change
    holds both; averaged, they would count as two seeds. Entries that an old result lacks are the
    default.
    """
    latest: dict[bytes, Result] = {}
    for case in cases:
        fields = repr([case.get(name, usual) for name, usual in USUAL.items()])
        # The digest, since a hundred thousand of these texts are a hundred megabytes.
        latest[hashlib.blake2b(fields.encode(), digest_size=16).digest()] = case
    return list(latest.values())


def drive_of(case: Result) -> str:
    """Return the digest of all that determines a drive except its agent.

    Entries that an old result lacks are the default.
    """
    names = (*(name for name in USUAL if name not in ("agent", "agent_settings")), "scene")
    given = json.dumps([case.get(name) or USUAL.get(name) for name in names], sort_keys=True)
    return hashlib.blake2b(given.encode(), digest_size=16).hexdigest()


def _rank(known: Sequence[str]) -> Callable[[str], tuple[int, str]]:
    places = {name: place for place, name in enumerate(known)}
    return lambda name: (places.get(name, len(places)), name)


def ordered(cases: Iterable[Result]) -> list[Result]:
    """Sort cases by regime, setting, trajectory, agent and seed."""
    regime = _rank(("", *suites.REGIMES))
    path, agent = _rank(trajectories.names()), _rank(agents.names())
    return sorted(
        cases,
        key=lambda case: (
            regime((setting := setting_of(case)).regime),
            setting.departures,
            str(setting),
            path(str(case.get("trajectory"))),
            agent(str(case.get("agent"))),
            label_of(case),
            case.get("seed", 0),
            -1 if (training := training_of(case)) is None else training,
        ),
    )


def violated(metrics: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Return the violated constraints: name -> (largest excess, share of control periods)."""
    names = [key.removeprefix("excess_") for key in metrics if key.startswith("excess_")]
    return {
        name: (float(metrics[f"excess_{name}"]), float(metrics.get(f"violated_{name}", 0.0)))
        for name in names
        if metrics[f"excess_{name}"] > KEPT
    }


def _violation_words(episodes: Sequence[Mapping[str, float]]) -> str:
    """Return each constraint's largest excess over episodes and mean share; "none" without any."""
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
    """Return failed and all solves; "–" for agents that solve nothing."""
    solves = sum(case["solver"].get("solves") or 0 for case in cases)
    failures = sum(case["solver"].get("failures") or 0 for case in cases)
    return f"{failures} of {solves}" if solves else "–"


def _end_words(cases: Sequence[Result]) -> str:
    """Return how episodes ended: one end by name, several with their counts."""
    ends = Counter(
        str(case.get("end") or "?").replace("_", " ") if case.get("status") == "ok" else "failed"
        for case in cases
    )
    if len(ends) == 1 and len(cases) == 1:
        return next(iter(ends))
    return ", ".join(f"{count} {end}" for end, count in ends.items())


def trainings(cases: Iterable[Result]) -> list[tuple[str, dict[str, Any]]]:
    """Return name and training of every learned policy, each distinct one once."""
    found: list[tuple[str, dict[str, Any]]] = []
    for group in by_label(cases).values():
        for case in sorted(group, key=lambda case: training_of(case) or 0):
            if (training := case.get("training")) and (case_name(case), training) not in found:
                found.append((case_name(case), dict(training)))
    return found


def _agent_row(setting: Setting, trajectory: str, label: str, cases: Sequence[Result]) -> Row:
    done = [case for case in cases if case.get("status") == "ok"]
    values = {}
    count = trainings_of(cases)
    # Each case is a drive of its own unless several trainings share them.
    drives = [
        (drive_of(case) if count > 1 else place, training_of(case))
        for place, case in enumerate(done)
    ]
    for column in (*TRACKING, *EFFORT, *FURTHER):
        found = [case.get(column.source, {}).get(column.key) for case in done]
        numbers = [
            (*drive, float(value))
            for drive, value in zip(drives, found, strict=True)
            if value is not None
        ]
        if numbers:
            values[column.key] = two_way(numbers)
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
        trainings=count,
    )


def _learning_words(cases: Sequence[Result]) -> str:
    """Return what the learning of an agent cost, the mean of a training if there are several."""
    found = [training for _, training in trainings(cases)]
    if found and trainings_of(cases) > 1:
        return f"each {words(average(found))}"
    return "; ".join(dict.fromkeys(map(words, found)))


def build_rows(cases: Iterable[Result]) -> list[Row]:
    """Return all rows: per setting and trajectory the published one, then the agents'."""
    groups: dict[tuple[Setting, str], dict[str, list[Result]]] = {}
    for case in ordered(current(cases)):
        key = setting_of(case), str(case.get("trajectory"))
        groups.setdefault(key, {}).setdefault(label_of(case), []).append(case)
    rows = []
    for (setting, trajectory), by_label in groups.items():
        conditions = next(iter(by_label.values()))[0].get("conditions", "simulation")
        reference = published_row(trajectory, conditions)
        if reference is not None:
            values = {key: Estimate(value) for key, value in reference.items()}
            rows.append(Row(setting, trajectory, PUBLISHED_LABEL, values, published=True))
        rows += [_agent_row(setting, trajectory, label, group) for label, group in by_label.items()]
    return rows


def by_setting(rows: Iterable[Row]) -> dict[Setting, list[Row]]:
    """Group rows by their setting, in order."""
    groups: dict[Setting, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.setting, []).append(row)
    return groups


def cases_by_setting(cases: Iterable[Result]) -> dict[Setting, list[Result]]:
    """Group cases by their setting, in order."""
    groups: dict[Setting, list[Result]] = {}
    for case in cases:
        groups.setdefault(setting_of(case), []).append(case)
    return groups
