"""Options that commands share: settings of one agent or all, names in both numbers."""

import json
from pathlib import Path

import pytest

from agents.weights import TrackingWeights, WeightSchedule
from experiments.cli import main, parser
from experiments.commands.options import agent_settings, speed_modes_of
from experiments.run import tables
from experiments.run.case import Case
from experiments.run.settings import setting_of
from experiments.run.store import ResultStore
from experiments.run.suites import grid
from trajectories import CurvatureBands

WEIGHTS = {"Q": [1, 1, 20, 20], "S": [5, 5, 100, 100], "R": [0.01, 1]}


def test_a_plain_setting_is_every_agents() -> None:
    found = agent_settings(["curvature_window=2"], ["stanley", "pid", "stanley"])
    assert found == {"stanley": {"curvature_window": 2}, "pid": {"curvature_window": 2}}


def test_a_setting_with_a_name_is_that_agents_alone() -> None:
    pairs = [f"lpv-nmpc:weights={json.dumps(WEIGHTS)}", "max_failures=3", "stanley:gain=2"]
    with pytest.raises(ValueError, match=r"'stanley' has no setting 'max_failures'.*NAME:KEY="):
        agent_settings(pairs, ["lpv-nmpc", "lpv-nmpc-tuned", "stanley"])
    pairs[1] = "lpv-nmpc-tuned:max_failures=3"
    assert agent_settings(pairs, ["lpv-nmpc", "lpv-nmpc-tuned", "stanley"]) == {
        "lpv-nmpc": {"weights": WEIGHTS},
        "lpv-nmpc-tuned": {"max_failures": 3},
        "stanley": {"gain": 2},
    }


def test_a_setting_with_a_name_goes_before_a_plain_one() -> None:
    found = agent_settings(["pid:curvature_window=3", "curvature_window=2"], ["stanley", "pid"])
    assert found == {"stanley": {"curvature_window": 2}, "pid": {"curvature_window": 3}}


def test_a_name_may_be_a_class_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("from agents.classical.geometric import Stanley as Mine\n")
    name = f"{file}:Mine"
    assert agent_settings([f"{name}:gain=2"], [name, "pid"]) == {name: {"gain": 2}, "pid": {}}


def test_an_unknown_name_is_told_with_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"unknown agent .*'stanly'.*nearest: stanley"):
        agent_settings(["stanly:gain=2"], ["lpv-nmpc", "stanley"])


@pytest.mark.parametrize(
    ("setting", "agents"),
    [("weights", ["lpv-nmpc", "lpv-nmpc-tuned"]), ("policy", ["ppo", "sac", "lpv-nmpc"])],
)
def test_what_tells_two_agents_apart_is_not_set_for_both(setting: str, agents: list[str]) -> None:
    """Such as the weights of lpv-nmpc and lpv-nmpc-tuned: two rows of one agent would come out."""
    both = ", ".join(agents[:2])
    with pytest.raises(
        ValueError, match=rf"'{setting}' has different defaults for {both}:"
    ) as told:
        agent_settings([f"{setting}=x.json"], agents)
    assert f"--agent-set {agents[0]}:{setting}=..." in str(told.value)
    assert agent_settings([f"{agents[0]}:{setting}=x.json"], agents)[agents[1]] == {}


def test_numbers_are_set_for_all_agents_whatever_their_defaults() -> None:
    agents = ["pure-pursuit", "pid"]
    both = {"lookahead_wheelbases": 2}
    assert agent_settings(["lookahead_wheelbases=2"], agents) == dict.fromkeys(agents, both)


@pytest.mark.parametrize("command", ["benchmark", "drive"])
@pytest.mark.parametrize(
    ("plural", "singular", "value"),
    [
        ("agents", "agent", "pid"),
        ("trajectories", "trajectory", "T4"),
        ("vehicles", "vehicle", "course-car"),
        ("speed_modes", "speed_mode", "fixed"),
    ],
)
def test_names_are_given_in_either_number(
    command: str, plural: str, singular: str, value: str
) -> None:
    for name in (plural, singular):
        options = parser([command]).parse_args([command, f"--{name.replace('_', '-')}", value])
        assert getattr(options, plural) == [value]


def test_weights_and_schedules_are_typed_as_they_are_written(tmp_path: Path) -> None:
    """For one agent of several, and told apart from the same agent with other weights."""
    schedule = WeightSchedule(CurvatureBands(), (TrackingWeights(**WEIGHTS),) * 4).as_dict()
    for number, weights in enumerate((WEIGHTS, schedule)):
        command = [
            "benchmark", "--agents", "lpv-nmpc", "lpv-nmpc-tuned", "--trajectory", "u-turn",
            "--env", "time_limit=2.0", "--agent-set", f"lpv-nmpc:weights={json.dumps(weights)}",
            "--resume", "--workers", "1", "--out", str(tmp_path / "out"),
        ]  # fmt: skip
        assert main(command) == 0
        assert len(ResultStore(tmp_path / "out").cases()) == 2 + number
    one, tuned, other = ResultStore(tmp_path / "out").cases()
    assert {case["status"] for case in (one, tuned, other)} == {"ok"}
    assert tuned["agent_settings"] == {}
    assert one["agent_settings"] == {"weights": WEIGHTS}
    # A schedule of equal sets is these weights.
    assert one["metrics"] == other["metrics"] != tuned["metrics"]
    labels = tables.labels([one, tuned, other])
    assert "lpv-nmpc (weights={Q=[1, 1, 20, 20], R=[0.01, 1], S=[5, 5, 100, 100]})" in labels
    assert len(labels) == 3


def test_weights_that_cannot_be_used_are_refused_before_a_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = 'weights={"Q":[1,1,20],"S":[5,5,100,100],"R":[0.01,1]}'
    out = tmp_path / "out"
    assert main(["benchmark", "--agents", "lpv-nmpc", "--agent-set", bad, "--out", str(out)]) == 2
    said = "lpv-track: weights: Q must be 4 numbers, each >= 0 and finite, not [1, 1, 20]\n"
    assert capsys.readouterr().err == said
    assert not out.exists()


def test_long_settings_are_no_names_of_files() -> None:
    long = {"weights": {"provenance": "x" * 300}}
    assert Case("lpv-nmpc", "T2", agent_settings=long).id != Case("lpv-nmpc", "T2").id


def test_rows_of_one_agent_with_other_settings_are_told_apart(tmp_path: Path) -> None:
    command = [
        "benchmark",
        "--agents",
        "pid",
        "stanley",
        "--trajectory",
        "u-turn",
        "--workers",
        "1",
    ]
    out = ["--out", str(tmp_path / "out")]
    assert main([*command, *out]) == 0
    assert main([*command, *out, "--agent-set", "stanley:gain=2.5", "--resume"]) == 0
    cases = ResultStore(tmp_path / "out").cases()
    assert tables.labels(cases) == ["stanley", "stanley (gain=2.5)", "pid"]
    rows = [row for row in tables.build_rows(cases) if not row.published]
    assert [(row.label, row.runs) for row in rows] == [
        ("stanley", 1), ("stanley (gain=2.5)", 1), ("pid", 1),
    ]  # fmt: skip
    assert rows[0].values["ale"] != rows[1].values["ale"]


@pytest.mark.parametrize(
    ("given", "name", "values"),
    [
        (["drive", "--traj", "T1"], "trajectories", ["T1"]),
        (["benchmark", "--traj", "T1", "T2"], "trajectories", ["T1", "T2"]),
        (["benchmark", "--traj=T1"], "trajectories", ["T1"]),
        (["benchmark", "--speed", "fixed"], "speed_modes", ["fixed"]),
        (["highway", "--env", "--agent-set"], "agent_set", []),
        (["benchmark", "--grip", "0.5", "0.9"], "grip", [0.5, 0.9]),
    ],
)
def test_short_forms_of_options(given: list[str], name: str, values: list[str]) -> None:
    assert getattr(parser(given[:1]).parse_args(given), name) == values


def test_shares_of_grip_are_driven_in_the_mode_of_that_name() -> None:
    def modes(*given: str) -> list[str]:
        return speed_modes_of(parser(["benchmark"]).parse_args(["benchmark", *given]))

    assert modes() == []
    assert modes("--grip", "0.5") == ["grip"]
    assert modes("--speed-modes", "fixed", "grip", "--grip", "0.5") == ["fixed", "grip"]
    for alone in (["--speed-modes", "grip"], ["--speed-modes", "fixed", "--grip", "0.5"]):
        with pytest.raises(ValueError, match="belong together"):
            modes(*alone)
    specs = grid(["pid"], ["T1"], speed_modes=("variable", "grip"), grips=(0.5, 0.9))
    assert [(spec["speed_mode"], spec.get("grip")) for spec in specs] == [
        ("variable", None), ("grip", 0.5), ("grip", 0.9),
    ]  # fmt: skip
    titles = [str(setting_of(Case(**spec).as_dict())) for spec in specs]
    assert titles == [
        "m2-minibus · variable speed", "m2-minibus · 0.5 of grip", "m2-minibus · 0.9 of grip",
    ]  # fmt: skip
