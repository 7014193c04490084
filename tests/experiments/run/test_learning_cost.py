"""Cost of learning in the results of learned policies, in report and table."""

import json

import numpy as np
import pytest

from agents.learned.policy import Policy, write
from experiments.run import learning_cost, metrics, tables
from experiments.run.case import run_case
from experiments.run.learning_cost import count, duration, words
from experiments.run.store import ResultStore
from lpv_track_env.observation import ObservationLayout
from tests.helpers.made_results import (
    HOSTILE,
    Outline,
    case,
    folder_of,
    own_scripts_alone,
    page,
    printed,
)

COST = {
    "algorithm": "ppo", "steps": 18_400_000, "seconds": 372.5, "solves": 0,
    "command": "lpv-track train ppo --steps 18400000 --seed 3",
}  # fmt: skip
TRAINING = {**COST, "seed": 3, "versions": {"numpy": "2"}}
SHORT = {"trajectory": "straight", "env_settings": {"time_limit": 2.0}}


def policy(training=TRAINING, algorithm="ppo"):
    """A policy of random weights."""
    layout = ObservationLayout()
    rng = np.random.default_rng(0)
    return Policy(
        algorithm=algorithm,
        layout=layout,
        control_period=0.05,
        feature_weight=rng.normal(size=(8, layout.size)) / layout.bound,
        feature_bias=np.zeros(8),
        feature_limit=10.0,
        layers=((0.1 * rng.normal(size=(2, 8)), np.zeros(2)),),
        activation="tanh",
        squash="tanh",
        origin="zero",
        centre=np.zeros(2),
        half=np.array([1.0, 0.1]),
        training={key: value for key, value in training.items() if key != "algorithm"},
    )


# Results


@pytest.mark.parametrize("conditions", ["simulation", "realtime"])
def test_a_case_driven_by_a_policy_file_tells_what_learning_cost(tmp_path, conditions):
    """Under realtime conditions delay compensation stands between the case and the agent."""
    file = tmp_path / "policy.json"
    write(policy(), file)
    result = run_case({**SHORT, "agent": str(file), "conditions": conditions})
    assert result["status"] == "ok", result
    assert result["training"] == COST
    store = ResultStore(tmp_path / "results")
    store.append(result)
    text = page(store.folder)
    assert "What learning cost" in text
    assert "18.4\u00a0M\u00a0steps, 6\u00a0min, 0\u00a0solves" in text
    assert "By curvature" in text


def test_agents_designed_by_hand_have_no_such_entry():
    result = run_case({**SHORT, "agent": "stanley"})
    assert result["status"] == "ok"
    assert "training" not in result


def test_a_case_that_fails_while_driving_still_tells_it(tmp_path, monkeypatch):
    monkeypatch.setattr(metrics, "METRICS", (lambda *_: {"mine": float("nan")},))
    write(policy(), tmp_path / "policy.json")
    result = run_case({**SHORT, "agent": str(tmp_path / "policy.json")})
    assert result["status"] == "failed"
    assert result["training"] == COST
    json.dumps(result, allow_nan=False)


class Holds:
    """An agent with something as its `policy`."""

    def __init__(self, policy):
        self.policy = policy


@pytest.mark.parametrize(
    ("training", "told"),
    [
        # As `lpv-track import-policy` writes it.
        ({"command": "lpv-track import-policy", "steps": 7000, "seed": None, "model": {}},
         {"command": "lpv-track import-policy", "steps": 7000}),
        ({}, {}),
        ({"steps": "many", "seconds": None, "solves": True, "command": ["lpv-track"]}, {}),
        ({"steps": 1.5, "seconds": 60}, {"seconds": 60}),
    ],
)  # fmt: skip
def test_of_a_policy_that_does_not_know_all_what_it_knows_is_told(training, told):
    found = learning_cost.of_agent(Holds(policy(training, "sac")))
    assert found == {"training": {"algorithm": "sac", **told}}


class Module:
    training = True  # as every network of torch has it


@pytest.mark.parametrize("other", [None, "policy.json", Module(), {"training": TRAINING}])
def test_what_is_no_policy_of_this_project_tells_nothing(other):
    assert learning_cost.of_agent(Holds(other)) == {}


# Words


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0"), (999, "999"), (1000, "1.00 k"), (12_345, "12.3 k"), (999_499, "999 k"),
     (999_500, "1.00 M"), (1_212_416, "1.21 M"), (18_400_000, "18.4 M"), (2 * 10**9, "2000 M")],
)  # fmt: skip
def test_counts_to_three_digits(number, text):
    assert count(number) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s"), (51.6, "52 s"), (120.0, "2 min"), (372.5, "6 min"), (9000.0, "2.5 h")],
)
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_what_is_not_known_is_not_said():
    assert words(COST) == "18.4 M steps, 6 min, 0 solves"
    assert words({"algorithm": "ppo", "steps": 7000}) == "7.00 k steps"
    assert words({"algorithm": "ppo"}) == "not recorded"


# Report and table


def learned(number, agent="mine.json", cost=COST, **more):
    return case(number, agent, training=cost, **more)


def test_it_stands_in_the_rows_of_the_agents_that_learned():
    rows = tables.build_rows([case(1), learned(2), learned(3, seed=1)])
    assert [(row.label, row.learning) for row in rows] == [
        ("published", ""), ("stanley", ""), ("mine.json", "18.4 M steps, 6 min, 0 solves"),
    ]  # fmt: skip


def test_runs_of_two_trainings_under_one_name_show_both():
    again = {**COST, "solves": 12_800}
    rows = tables.build_rows([learned(1), learned(2, seed=1, cost=again)])
    assert rows[1].learning == "18.4 M steps, 6 min, 0 solves; 18.4 M steps, 6 min, 12.8 k solves"


def test_the_report_has_the_cost_beside_the_result_and_in_full(tmp_path):
    imported = {"algorithm": "sac", "steps": 7000}
    folder_of(tmp_path, [
        case(1), learned(2), learned(3, trajectory="T4"),
        learned(4, "other.json", imported, seed=1, vehicle="course-car"),
        case(5, vehicle="ford-escort"),
    ], traces=False)  # fmt: skip
    text = page(tmp_path)
    outline = Outline(text)
    main = text[
        text.index("Against the published table</h2>") : text.index("What learning cost</h2>")
    ]
    assert main.count(">trained<") == 2  # not where nobody learned
    assert main.count("18.4\u00a0M\u00a0steps, 6\u00a0min, 0\u00a0solves") == 2
    assert '<td class="t">–</td>' in main
    section = text[text.index("What learning cost</h2>") :].partition("</section>")[0]
    for told in ("18,400,000", "6 min", f"# mine.json\n{COST['command']}",
                 "<td>sac</td>", "7,000", "# other.json\n# not recorded"):  # fmt: skip
        assert told in section, told
    assert section.count(">mine.json</th>") == 1
    assert "stanley" not in section
    assert any("designed by hand" in told for told in outline.words)


def test_a_report_without_learned_policies_says_nothing_of_it(tmp_path):
    folder_of(tmp_path, [case(1), case(2, "pid")], traces=False)
    text = page(tmp_path)
    assert "learning" not in text
    assert ">trained<" not in text
    assert "trained:" not in printed([case(1)])


def test_foreign_words_are_escaped(tmp_path):
    cost = {"algorithm": HOSTILE, "steps": 1, "command": HOSTILE}
    folder_of(tmp_path, [learned(1, HOSTILE, cost)], traces=False)
    assert own_scripts_alone(page(tmp_path))


def test_the_console_has_a_line_for_each_learned_policy():
    results = [case(1), learned(2), learned(3, trajectory="T4"), learned(4, "[bold]x[/bold]")]
    lines = [line.rstrip() for line in printed(results).splitlines() if "trained:" in line]
    assert lines == [
        "trained: [bold]x[/bold]: ppo, 18.4 M steps, 6 min, 0 solves",
        "trained: mine.json: ppo, 18.4 M steps, 6 min, 0 solves",
    ]
