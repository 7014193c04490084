"""What an action of `WeightTuning-v0` means: multipliers, bands, catalogue, slew, bad ones."""

import copy
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agents.weight_tuning.choice import WeightChoice, weights_for
from agents.weight_tuning.env import WeightTuningEnv
from agents.weights import HIGHEST, LOWEST, TrackingWeights, WeightSchedule
from tests.helpers.tuned_drives import CALM, CATALOGUE, CHOICES, SCHEDULE, meant
from trajectories import CurvatureBands

Array = NDArray[Any]

BASE = TrackingWeights().as_array()
# Of a straight line: one band, so that windows are whole.
STRAIGHT: dict[str, Any] = {"trajectory": "straight", "conditions": "simulation"}


def chosen(choice: WeightChoice, action: Any, band: int = 0) -> Array | None:
    """Set (12,) that is made of an action's numbers; None if it is refused."""
    row = np.full(12, -1.0)
    taken = weights_for(
        np.asarray(action, dtype=np.float64),
        band,
        choice.sets,
        choice.matrix,
        choice.log_span,
        choice.catalogue_sets,
        row,
    )
    if not taken:
        np.testing.assert_array_equal(row, np.full(12, -1.0))
    return row if taken else None


def begun(choice: WeightChoice | None = None, **changes: Any) -> WeightTuningEnv:
    env = WeightTuningEnv(choice=choice, **{**STRAIGHT, **changes})
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    ("directions", "action", "factors"),
    [
        ("joint", [1, 0, 0], [10, 1, 1, 1, 10, 1, 1, 1]),
        ("joint", [0, -1, 0.5], [1, 0.1, 10**0.5, 10**0.5, 1, 0.1, 10**0.5, 10**0.5]),
        ("stages", [1, 0, 0, 0, 0, -1], [10, 1, 1, 1, 1, 1, 0.1, 0.1]),
        ("stages", [0, 0, 1, 0, 1, 0], [1, 1, 10, 10, 1, 10, 1, 1]),
        ("all", [1, 0, 0, -1, 0, 1, 0, 0], [10, 1, 1, 0.1, 1, 10, 1, 1]),
        ("all", [9, -9, 0, 0, 0, 0, 0, 0], [10, 0.1, 1, 1, 1, 1, 1, 1]),
    ],
)
def test_entries_multiply_the_base(
    directions: str, action: list[float], factors: list[float]
) -> None:
    """On Q's and S's [vx, psi, X, Y]; R and R_rate stay; beyond 1 they are clipped."""
    found = chosen(WeightChoice(directions=directions), action)
    np.testing.assert_allclose(found, BASE * [*factors, 1, 1, 1, 1], rtol=1e-14)


def test_every_band_has_a_base_of_its_own() -> None:
    choice = CHOICES["schedule"]
    for band, base in enumerate(SCHEDULE.weights):
        np.testing.assert_array_equal(chosen(choice, np.zeros(3), band), base.as_array())
        action = np.array([0.3, -0.7, 1.0])
        np.testing.assert_allclose(
            chosen(choice, action, band), meant(choice, action, band), rtol=1e-14
        )
    # Before any band is known it is the straightest.
    np.testing.assert_array_equal(chosen(choice, np.zeros(3), -1), SCHEDULE.weights[0].as_array())


def test_a_catalogue_is_chosen_from_by_the_largest() -> None:
    choice = CHOICES["catalogue"]
    for index, one in enumerate(CATALOGUE):
        np.testing.assert_array_equal(chosen(choice, np.eye(3)[index], 2), one.as_array())
    np.testing.assert_array_equal(chosen(choice, [-5.0, 80.0, 3.0]), CATALOGUE[1].as_array())


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(list(CHOICES)), st.lists(st.floats(width=64), min_size=8, max_size=8),
    st.integers(-1, 2), st.floats(1.01, 1e4),
)  # fmt: skip
def test_whatever_is_asked_for_stays_within_bounds(
    name: str, numbers: list[float], band: int, span: float
) -> None:
    choice = WeightChoice(
        CHOICES[name].base, CHOICES[name].directions, span, CHOICES[name].catalogue
    )
    action = numbers[: choice.entries]
    found = chosen(choice, action, band)
    assert (found is None) == (not np.isfinite(action).all())
    if found is not None:
        assert (found >= LOWEST).all()
        assert (found <= HIGHEST).all()


# In a drive ----------------------------------------------------------------------------------


def test_the_first_set_is_taken_at_once_and_others_at_the_slew_limit() -> None:
    env = begun()
    up, down = np.ones(3, dtype=np.float32), -np.ones(3, dtype=np.float32)
    target = BASE * [*[10.0] * 8, 1, 1, 1, 1]
    np.testing.assert_allclose(env.step(up)[4]["weights"], target, rtol=1e-12)
    # 6 nepers a second over 0.4 s of the 2 ln(10) that lie between.
    weights = env.step(down)[4]["weights"]
    np.testing.assert_allclose(weights[:8], target[:8] * math.exp(-2.4), rtol=1e-12)
    np.testing.assert_array_equal(weights[8:], BASE[8:])
    np.testing.assert_allclose(env.step(down)[4]["weights"][:8], 0.1 * BASE[:8], rtol=1e-12)


@pytest.mark.parametrize(("slew", "share"), [(None, 1.0), (1.0, 0.4 / math.log(10.0))])
def test_the_slew_limit_is_the_bases(slew: float | None, share: float) -> None:
    base = WeightSchedule(CurvatureBands(), (TrackingWeights(),) * 4, slew=slew)
    env = begun(WeightChoice(base))
    env.step(np.zeros(3))
    weights = env.step(np.ones(3))[4]["weights"]
    np.testing.assert_allclose(weights[:8], BASE[:8] * 10.0**share, rtol=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_an_action_that_is_not_finite_is_rejected(bad: float) -> None:
    """At first the base stays; then what the band was last given."""
    env = begun()
    info = env.step(np.array([0.5, bad, 2.0]))[4]
    np.testing.assert_array_equal(info["weights"], BASE)
    assert (info["rejected"], info["clipped"], info["steps"]) == (1, 0, 8)
    set_on = env.step(np.array([0.3, 0.0, 0.0]))[4]["weights"]
    info = env.step(np.full(3, bad))[4]
    np.testing.assert_array_equal(info["weights"], set_on)
    assert (info["rejected"], info["clipped"]) == (2, 0)
    env.reset()
    assert env.step(np.zeros(3))[4]["rejected"] == 0


def test_a_rejected_action_is_the_bands_own_last_one() -> None:
    """In another band, which was given nothing yet, it is the base's."""
    choice = WeightChoice(WeightSchedule(SCHEDULE.bands, SCHEDULE.weights))
    env = WeightTuningEnv(choice=choice, **{**CALM, "conditions": "simulation"})
    _, info = env.reset(seed=1)
    last = {band: one.as_array() for band, one in enumerate(SCHEDULE.weights)}
    rng, met = np.random.default_rng(0), set()
    for _ in range(40):
        band, action = info["band"], rng.uniform(-1.0, 1.0, 3)
        if rng.random() < 0.5:
            action[1] = math.nan
        else:
            last[band] = meant(choice, action, band)
        *_, info = env.step(action)
        np.testing.assert_allclose(info["weights"], last[band], rtol=1e-12)
        met.add(band)
    assert len(met) > 1


@pytest.mark.parametrize("size", [1e300, 1.0000001, -7.0])
def test_large_actions_are_clipped_and_counted(size: float) -> None:
    one, other = begun(), begun()
    first, second = one.step(np.array([size, 0.0, 0.0])), other.step([np.sign(size), 0.0, 0.0])
    np.testing.assert_array_equal(first[0], second[0])
    assert (first[4]["clipped"], second[4]["clipped"]) == (1, 0)
    assert first[4]["rejected"] == 0
    one.step(np.full(3, size))
    assert one.step(np.zeros(3))[4]["clipped"] == 2


@pytest.mark.parametrize("size", [5e-324, -1e-300, -0.0])
def test_tiny_actions_are_none(size: float) -> None:
    np.testing.assert_array_equal(begun().step(np.full(3, size))[4]["weights"], BASE)


WRONG: dict[str, tuple[str, Any]] = {
    "short": ("joint", np.zeros(2)), "long": ("joint", np.zeros(4)), "scalar": ("joint", 0.5),
    "row": ("joint", np.zeros((1, 3))), "none": ("joint", None), "text": ("joint", ["a"] * 3),
    "bool": ("joint", np.zeros(3, bool)), "complex": ("joint", np.zeros(3, complex)),
    "ragged": ("joint", [[0.0], 0.0, 0.0]), "other": ("all", np.zeros(3)),
    "high": ("catalogue", 3), "low": ("catalogue", -1), "float": ("catalogue", 1.0),
    "nan": ("catalogue", math.nan), "array": ("catalogue", np.array([1])),
    "truth": ("catalogue", True), "nothing": ("catalogue", None),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_action_is_one_line_and_moves_nothing(case: str) -> None:
    name, action = WRONG[case]
    env = begun(CHOICES[name], **{**CALM, "conditions": "realtime"})
    untouched = copy.deepcopy(env)
    with pytest.raises(ValueError, match=r"actions must be|catalogue has sets 0 to 2, not") as told:
        env.step(action)
    assert "\n" not in str(told.value)
    right = 1 if CHOICES[name].catalogue else np.zeros(CHOICES[name].entries)
    for one, other in zip(env.step(right), untouched.step(right), strict=True):
        if isinstance(one, dict):
            np.testing.assert_equal(one, other)
        else:
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"directions": "both"}, "unknown directions 'both'"),
        ({"span": 1.0}, "span must be above 1"),
        ({"span": math.nan}, "span must be a finite number"),
        ({"window": 0.0}, r"window must be in \(0, 1e\+09\] s, not 0.0"),
        ({"window": math.inf}, "window must be a finite number"),
    ],
)
def test_wrong_choices(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WeightChoice(**wrong)
