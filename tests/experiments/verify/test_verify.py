"""`lpv-track verify`: its oracles against hand calculation and each other, and its verdicts."""

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agents.nmpc.casadi_solvers import IpoptSolver, stage_models
from agents.nmpc.problem import NmpcProblem, Solution, Status
from agents.weights import TrackingWeights
from experiments.cli import main
from experiments.commands.verify import ROWS, SOLVER, shortfalls, summarise
from experiments.run.suites import PAPER_VEHICLES
from experiments.verify.bench import (
    ERRORS,
    Bench,
    Sampler,
    Situation,
    kind,
    relative,
    scaled_error,
    situation_death,
)
from experiments.verify.oracles import (
    CasadiDerivatives,
    PiqpOracle,
    PlanCost,
    plan_cost,
    rolled_out,
)
from lpv_track_env.vehicle import M2_MINIBUS
from tests.helpers import stand_in_solver
from tests.helpers.stand_in_solver import HeldInput, StandIn, WrongDerivative

Array = NDArray[np.float64]
STAND_INS = Path(stand_in_solver.__file__)
NO_COST = np.zeros(12)


@pytest.fixture(scope="module")
def samplers() -> dict[str, Sampler]:
    return {name: Sampler(name) for name in PAPER_VEHICLES}


def draws(samplers: dict[str, Sampler], count: int) -> list[tuple[NmpcProblem, Situation]]:
    """Situations of both vehicles with their problems."""
    return [
        (samplers[name].agent.problem, samplers[name].draw(index, 3))
        for index in range(count)
        for name in [kind(index)[1]]
    ]


# ---- what a plan costs


def straight(speed: float, **changes: Any) -> tuple[NmpcProblem, Array]:
    """One period of 0.1 s, straight ahead: the model is v' = a - mu g then, exactly."""
    return NmpcProblem(M2_MINIBUS, horizon=1, period=0.1, **changes), np.array(
        [speed, 0.0, 0.0, 0.0, 0.0, 0.0]
    )


def test_cost_of_one_straight_period_by_hand() -> None:
    problem, state = straight(10.0)
    a = 1.0 + M2_MINIBUS.rolling_deceleration  # so that v' = 1
    weights = np.array([2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0, 23.0, 29.0, 0.31, 0.37])
    reference = np.array([[10.5, 0.1, 0.2, 0.3], [11.0, 0.2, 1.2, 0.5]])
    last = np.array([a - 0.3, 0.02])
    price = plan_cost(problem, state, last, reference, weights, np.array([[a, 0.0]]))

    # v: 10 to 10.1 m/s; x: 0 to 1.005 m
    def across(x: float, y: float, heading: float) -> float:
        return y * np.cos(heading) - x * np.sin(heading)

    def along(x: float, y: float, heading: float) -> float:
        return x * np.cos(heading) + y * np.sin(heading)

    stage = 2 * 0.5**2 + 3 * 0.1**2
    stage += 5 * along(0.2, 0.3, 0.1) ** 2 + 7 * across(0.2, 0.3, 0.1) ** 2
    end = 11 * 0.9**2 + 13 * 0.2**2
    end += 17 * along(0.195, 0.5, 0.2) ** 2 + 19 * across(0.195, 0.5, 0.2) ** 2
    # A stage of 0.1 s counts twice; 3 m/s^3 and -0.2 rad/s last as long.
    rates = 0.31 * 3.0**2 + 0.37 * 0.2**2
    cost = 0.5 * (2.0 * (stage + 23 * a**2 + rates) + end)
    assert price.cost == pytest.approx(cost, rel=1e-12)
    np.testing.assert_array_equal(price.slack, 0.0)
    assert price.excess == 0.0


def test_cost_of_broken_soft_constraints_by_hand() -> None:
    problem, state = straight(
        30.2, linear_penalty=(2.0, 3.0, 5.0), quadratic_penalty=(7.0, 11.0, 13.0)
    )
    a = 3.0 + M2_MINIBUS.rolling_deceleration  # v' = 3, one too many; v = 30.5, 0.5 too fast
    inputs = np.array([[a, 0.0]])
    price = plan_cost(problem, state, inputs[0], np.zeros((2, 4)), NO_COST, inputs)
    np.testing.assert_allclose(price.slack, [[0.5, 0.0, 1.0]], atol=1e-12)
    penalty = 2 * 0.5 + 5 * 1.0 + 0.5 * (7 * 0.25 + 13 * 1.0)
    assert price.cost == pytest.approx(2.0 * penalty, rel=1e-12)  # 0.1 s count twice


def test_cost_of_two_unequal_stages_by_hand() -> None:
    """Inputs and their rates alone: each stage counts as it is long, each rate as it lasts."""
    problem = NmpcProblem(M2_MINIBUS, horizon=2, stages=(0.05, 0.2), first_period=0.03)
    weights = np.array([*[0.0] * 8, 3.0, 5.0, 7.0, 11.0])
    last, inputs = np.array([0.1, 0.01]), np.array([[0.2, 0.02], [0.7, -0.01]])
    state = np.array([10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    price = plan_cost(problem, state, last, np.zeros((3, 4)), weights, inputs)
    cost = 1.0 * (3 * 0.2**2 + 5 * 0.02**2) + 4.0 * (3 * 0.7**2 + 5 * 0.01**2)
    # From the middle of one input to that of the next: 0.04 s and 0.125 s.
    cost += 0.8 * (7 * (0.1 / 0.04) ** 2 + 11 * (0.01 / 0.04) ** 2)
    cost += 2.5 * (7 * (0.5 / 0.125) ** 2 + 11 * (0.03 / 0.125) ** 2)
    assert price.cost == pytest.approx(0.5 * cost, rel=1e-12)
    np.testing.assert_array_equal(price.slack, 0.0)
    # The bound on the first change allows for a control period, 0.03 s.
    assert price.excess == 0.0
    steep = plan_cost(problem, state, last - [0.1, 0.0], np.zeros((3, 4)), weights, inputs)
    assert steep.excess == pytest.approx(0.2 - 0.03 * M2_MINIBUS.max_jerk)


def test_sideslip_and_slow_speed_break_theirs() -> None:
    problem, state = NmpcProblem(M2_MINIBUS, horizon=1, period=0.01), straight(0.5)[1]
    state[1] = 3.0
    inputs = np.array([[M2_MINIBUS.rolling_deceleration, 0.0]])
    price = plan_cost(problem, state, inputs[0], np.zeros((2, 4)), NO_COST, inputs)
    after = rolled_out(problem, state, inputs)[1]
    assert price.slack[0, 0] == pytest.approx(1.0 - after[0])
    assert price.slack[0, 1] == pytest.approx(abs(after[1]) - 0.17 * after[0])
    mirrored = plan_cost(
        problem, state * [1, -1, 1, 1, 1, 1], inputs[0], np.zeros((2, 4)), NO_COST, inputs
    )
    np.testing.assert_allclose(mirrored.slack, price.slack)


@pytest.mark.parametrize(
    ("last", "inputs", "excess"),
    [
        ([0.0, 0.0], [[0.5, 0.0]], 0.0),  # 5 m/s^3 for 0.1 s
        ([0.0, 0.0], [[0.7, 0.0]], 0.2),
        ([3.4, 0.0], [[3.9, 0.0]], 0.4),  # 3.5 m/s^2
        ([0.0, 0.5], [[0.0, 0.54]], 0.54 - np.pi / 6),
        ([0.0, 0.0], [[0.0, -0.1]], 0.1 - np.pi / 60),
    ],
)
def test_excess_over_hard_bounds(
    last: list[float], inputs: list[list[float]], excess: float
) -> None:
    problem, state = straight(10.0)
    price = plan_cost(problem, state, np.array(last), np.zeros((2, 4)), NO_COST, np.array(inputs))
    assert price.excess == pytest.approx(excess, abs=1e-12)


def test_roll_out_is_casadis_stage_models(samplers: dict[str, Sampler]) -> None:
    for problem, case in draws(samplers, 4):
        states = rolled_out(problem, case.state, case.inputs)
        for k, (model, u) in enumerate(zip(stage_models(problem), case.inputs, strict=True)):
            same = np.asarray(model(states[k], u)).ravel()
            np.testing.assert_allclose(states[k + 1], same, rtol=1e-10, atol=1e-11)


def test_cost_of_ipopts_plan_is_its_objective(samplers: dict[str, Sampler]) -> None:
    # Limits that every situation breaks, or the penalties would go unchecked.
    narrow = M2_MINIBUS.replace(max_lateral_velocity_ratio=0.01, speed_range=(1.0, 5.0))
    stages = tuple(np.linspace(0.07, 0.13, 10))
    problem = NmpcProblem(narrow, horizon=10, stages=stages, first_period=0.03)
    solver = IpoptSolver(problem, tolerance=1e-9)
    broken = np.zeros(3)
    for _, case in draws(samplers, 8):
        parameters = (case.state, case.last_input, case.reference[:11], case.weights)
        solution, _ = solver.solve(*parameters)
        assert solution.status is Status.SUCCESS
        assert solution.inputs is not None
        price = plan_cost(problem, *parameters, solution.inputs)
        assert price.cost == pytest.approx(solution.cost, rel=1e-6)
        assert price.excess <= 1e-8
        broken = np.maximum(broken, price.slack.max(axis=0))
    assert (broken > 1e-2).all()


# ---- derivatives, the quadratic programme


def test_derivatives_against_finite_differences(samplers: dict[str, Sampler]) -> None:
    for problem, case in draws(samplers, 4):
        exact = CasadiDerivatives(problem).along(case.state, case.inputs)
        numeric = StandIn(problem).linearise(case.state, case.inputs)
        for name, value in exact._asdict().items():
            np.testing.assert_allclose(
                getattr(numeric, name), value, rtol=1e-9, atol=1e-9, err_msg=name
            )


def test_piqp_against_a_condensed_qp_by_another_solver(samplers: dict[str, Sampler]) -> None:
    for problem, case in draws(samplers, 6):
        state, last, reference, weights = case.parameters
        other = StandIn(problem)
        along = CasadiDerivatives(problem).along(state, case.inputs)
        oracle = PiqpOracle(problem, other.damping)
        ours = oracle.solve(last, reference, weights, case.inputs, along)
        status, theirs = other.solve_qp(state, last, reference, weights, case.inputs)
        assert status is Status.SUCCESS
        assert ours is not None
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-6)
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_iterated_qps_end_where_ipopt_does(samplers: dict[str, Sampler]) -> None:
    """A fixed point of the undamped QP satisfies the problem's own optimality conditions."""
    (problem, case), *_ = draws(samplers, 1)
    state, last, reference, weights = case.parameters
    solution, _ = samplers[case.vehicle].agent.solver.solve(*case.parameters)
    assert solution.inputs is not None
    along = CasadiDerivatives(problem).along(state, solution.inputs)
    again = PiqpOracle(problem, (0.0, 0.0)).solve(last, reference, weights, solution.inputs, along)
    assert again is not None
    np.testing.assert_allclose(again[0], solution.inputs[0], atol=1e-5)


def test_without_piqp_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "piqp", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lpv-track-env\[oracles\]'"):
        PiqpOracle(NmpcProblem(M2_MINIBUS), (0.0, 0.0))


def test_ipopt_keeps_an_optimum_and_betters_what_is_none(samplers: dict[str, Sampler]) -> None:
    problem, case = draws(samplers, 2)[1]
    solver = IpoptSolver(problem, tolerance=1e-8)
    best, _ = solver.solve(*case.parameters)
    kept = solver.solve_from(best, *case.parameters)
    assert kept.status is Status.SUCCESS
    assert kept.cost == pytest.approx(best.cost, rel=1e-7)
    assert kept.iterations < best.iterations
    held = best._replace(
        inputs=np.tile(case.last_input, (problem.horizon, 1)), slack=np.zeros((problem.horizon, 3))
    )
    bettered = solver.solve_from(held, *case.parameters)
    assert bettered.cost == pytest.approx(best.cost, rel=1e-5)
    with pytest.raises(ValueError, match="no plan to start from: status NAN"):
        solver.solve_from(Solution(Status.NAN, None, None, None, np.nan, 0, 0.0), *case.parameters)


# ---- situations


def test_situations_cover_all_pairs_and_repeat(samplers: dict[str, Sampler]) -> None:
    assert len({kind(index) for index in range(12)}) == 12
    index = 5
    sampler = samplers[kind(index)[1]]
    first = sampler.draw(index, 0)
    sampler.draw(index + 2, 0)
    again, other = sampler.draw(index, 0), sampler.draw(index, 1)
    for mine, same in zip(first.parameters, again.parameters, strict=True):
        np.testing.assert_array_equal(mine, same)
    assert not np.array_equal(first.state, other.state)


def test_situations_are_near_the_path_and_within_bounds(samplers: dict[str, Sampler]) -> None:
    cases = draws(samplers, 48)
    defaults, scaled, random_steering = TrackingWeights().as_array(), 0, 0
    for problem, case in cases:
        assert abs(case.state[5]) <= ERRORS["lateral_error"] + 1e-3
        assert abs(case.state[2]) <= ERRORS["heading_error"] + 1e-3
        assert abs(case.state[0] - case.reference[0, 0]) <= ERRORS["speed_error"] + 1e-3
        assert case.state[0] >= 1.0
        low, high = problem.input_bounds
        assert (case.inputs >= low).all()
        assert (case.inputs <= high).all()
        steps = np.diff(np.vstack([case.last_input, case.inputs]), axis=0)
        assert (np.abs(steps) <= problem.input_steps + 1e-12).all()
        ratio = case.weights / defaults
        assert (ratio >= 0.1 - 1e-9).all()
        assert (ratio <= 10.0 + 1e-9).all()
        scaled += not np.allclose(ratio, 1.0)
        random_steering += abs(case.last_input[1]) > 0.3
    assert 12 <= scaled <= 36
    assert random_steering >= 6


# ---- verdicts


def result(index: int, **measures: float | None) -> dict[str, Any]:
    right = {row.measure: 0.0 for row in ROWS}
    return {"index": index, "error": "", "measures": {**right, **measures}}


def row(summaries: list[dict[str, Any]], measure: str) -> dict[str, Any]:
    (found,) = [summary for summary in summaries if summary["measure"] == measure]
    return found


def test_distribution_of_a_measure() -> None:
    results = [result(k, cost_error=(-1) ** k * k * 1e-6) for k in range(1, 101)]
    found = row(summarise(results), "cost_error")
    assert (found["median"], found["p90"], found["p99"], found["max"]) == pytest.approx(
        (50e-6, 90e-6, 99e-6, 100e-6)
    )
    assert (found["lower"], found["higher"]) == (49, 50)  # 1e-6 itself counts as the same
    assert found["holds"] is None


def test_all_right_holds() -> None:
    results = [result(k) for k in range(10)]
    summaries = summarise(results)
    assert {summary["holds"] for summary in summaries} == {True, None}
    assert shortfalls(summaries, results) == []


def test_one_wrong_first_input_misses_and_is_named() -> None:
    results = [result(k) for k in range(99)] + [result(99, qp_first_input=2e-6)]
    summaries = summarise(results)
    assert row(summaries, "qp_first_input")["share_within"] == 0.99
    (line,) = shortfalls(summaries, results)
    assert line == (
        "QP: first input against PIQP: 99.00% within 1e-06, 100% asked for; largest 2.0e-06"
    )


def test_of_plans_one_in_a_hundred_may_be_bettered() -> None:
    good = [result(k) for k in range(98)]
    bad = [result(k, suboptimality=np.inf) for k in (98, 99)]
    assert shortfalls(summarise([*good, bad[0]]), good) != []  # one of 99
    assert shortfalls(summarise([*good, good[0], bad[0]]), good) == []
    assert "largest inf" in shortfalls(summarise([*good, *bad]), good)[0]


def test_oracles_without_answers_give_no_verdict_for_free() -> None:
    results = [result(k, A=None) for k in range(2)] + [result(k) for k in range(2, 10)]
    summaries = summarise(results)
    assert row(summaries, "A")["holds"] is False
    assert shortfalls(summaries, results) == [
        "dF/dx against CasADi: only 8 of 10 could be compared"
    ]
    nothing = summarise([result(0, A=None)])
    assert row(nothing, "A")["max"] is None


def test_a_dead_worker_is_a_shortfall() -> None:
    dead = situation_death({"index": 7}, "the worker process died, twice")
    results = [*(result(k) for k in range(99)), dead]
    (line,) = shortfalls(summarise(results), results)
    assert line == "situation 7: the worker process died, twice"


def test_errors_are_relative_above_one_and_never_hide_a_nan() -> None:
    assert scaled_error(np.array([1e3 + 1e-3, 0.5]), np.array([1e3, 0.5])) == pytest.approx(1e-6)
    assert scaled_error(np.array([0.5 + 1e-3]), np.array([0.5])) == pytest.approx(1e-3)
    assert scaled_error(np.array([np.nan]), np.array([1.0])) == np.inf
    with pytest.raises(ValueError, match="shape"):
        scaled_error(np.zeros((6, 2)), np.zeros((2, 6)))
    two, three = (PlanCost(cost, np.zeros((1, 3)), 0.0) for cost in (2.0, 3.0))
    assert relative(three, two) == pytest.approx(0.5)
    assert relative(None, two) == np.inf
    assert relative(two, None) is None


# ---- the command


def verify(folder: Path, solver: str, *more: str) -> tuple[int, dict[str, Any]]:
    code = main(["verify", "--solver", solver, "--out", str(folder), "--workers", "1", *more])
    content: dict[str, Any] = json.loads(
        (folder / "verify.json").read_text(),
        parse_constant=lambda text: pytest.fail(f"{text} is not JSON"),
    )
    return code, content


def test_a_right_solver_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, content = verify(tmp_path, f"{STAND_INS}:StandIn", "--states", "2", "--seed", "4")
    assert code == 0, content["missed"]
    assert content["holds"] is True
    assert content["settings"]["seed"] == 4
    assert content["versions"]["piqp"]
    assert {"revision", "hardware", "written"} <= set(content)
    assert [case["vehicle"] for case in content["situations"]] == list(PAPER_VEHICLES)
    assert all(summary["compared"] for summary in content["summary"])
    printed = capsys.readouterr().out
    assert "PIQP" in printed
    assert "fell short" not in printed


def test_a_solver_that_solves_nothing_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, content = verify(tmp_path, f"{STAND_INS}:Failing", "--states", "1")
    assert code == 1
    wrong = [summary["measure"] for summary in content["summary"] if summary["holds"] is False]
    assert wrong == ["qp_first_input", "excess", "suboptimality"]
    (case,) = content["situations"]
    assert case["measures"]["qp_first_input"] == "inf"
    assert case["measures"]["excess"] is None
    assert capsys.readouterr().out.count("fell short") == 3


@pytest.fixture(scope="module")
def right() -> Bench:
    return Bench("m2-minibus", f"{STAND_INS}:StandIn")


def test_a_wrong_derivative_shows_and_nothing_else_does(
    right: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    situation = right.sampler.draw(2, 0)
    before = right.measure(situation, fatrop=False)
    monkeypatch.setattr(right, "one_step", WrongDerivative(right.problem))
    after = right.measure(situation, fatrop=False)
    assert before["B"] is not None
    assert before["B"] < 1e-9
    assert after["B"] is not None
    assert after["B"] > 1e-3
    assert [before[name] for name in ("A", "rate_u")] == [after[name] for name in ("A", "rate_u")]


def test_a_plan_that_is_no_optimum_is_bettered(
    right: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    situation = right.sampler.draw(4, 0)
    monkeypatch.setattr(right, "converged", HeldInput(right.problem, iterations=2))
    measures = right.measure(situation, fatrop=True)
    for name in ("suboptimality", "cost_error", "fatrop_cost_error"):
        assert measures[name] is not None
        assert measures[name] > 1e-3
    assert measures["first_input"] is None
    assert measures["oracles_cost_error"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--states", "0"], "--states must be a whole number"),
        (["--workers", "0"], "--workers must be a whole number"),
        (["--seed", "-1"], "--seed must be a whole number from 0"),
        (["--solver", "agents.nmpc:Nothing"], "cannot be loaded"),
    ],
)
def test_bad_options_are_refused(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solver = [] if "--solver" in arguments else ["--solver", f"{STAND_INS}:StandIn"]
    assert main(["verify", *solver, "--out", str(tmp_path), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_run_ends_with_130_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("experiments.run.engines.in_process", interrupted)
    code = main(
        ["verify", "--solver", f"{STAND_INS}:StandIn", "--out", str(tmp_path), "--workers", "1"]
    )
    assert code == 130
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(
    importlib.util.find_spec(SOLVER.partition(":")[0]) is None,
    reason="the real-time solver is not there",
)
def test_the_real_time_solver_passes(tmp_path: Path) -> None:
    code, content = verify(tmp_path, SOLVER, "--states", "12")
    assert code == 0, content["missed"]
