"""Policies from pairs of drives: the quadratic is found, pairs are alike but for their weights."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import trajectories
from agents.weight_tuning.features import names
from agents.weight_tuning.score import USUAL, USUAL_WINDOWS, rms_so_far
from experiments.tuning.paired import BIAS, PairedLearning, PairedQuadratic, Prior
from experiments.tuning.settings import usual

Array = NDArray[Any]
ENTRIES, FEATURES = 4, 3
PRIOR = Prior(curvature=0.5, response=0.5)


class Truth:
    """A cost that is quadratic, and pairs that tell of it."""

    def __init__(self, seed: int) -> None:
        self.random = random = np.random.default_rng(seed)
        root = random.standard_normal((ENTRIES, ENTRIES))
        self.p = root @ root.T / ENTRIES + 0.3 * np.eye(ENTRIES)
        self.m = 0.3 * random.standard_normal((ENTRIES, FEATURES))
        self.c = 0.1 * random.standard_normal(ENTRIES)

    def cost(self, u: Array, x: Array) -> Array:
        quadratic = 0.5 * np.einsum("ni,ij,nj->n", u, self.p, u)
        cost: Array = quadratic - np.einsum("ni,ij,nj->n", u, self.m, x)
        return cost

    def tell(self, model: PairedQuadratic, count: int, noise: float) -> None:
        u, v, before = self.random.standard_normal((3, count, ENTRIES))
        x = np.c_[np.ones(count), self.random.standard_normal((count, FEATURES - 1))]
        # What does not depend on the weights, however large, is in both.
        common = 1e3 * self.random.standard_normal(count)
        difference = (common + self.cost(u, x)) - (common + self.cost(v, x)) + before @ self.c
        model.add(u, v, x, before, difference + noise * self.random.standard_normal(count))


def fitted(truth: Truth, count: int, noise: float, fits: int = 5) -> PairedQuadratic:
    model = PairedQuadratic(ENTRIES, FEATURES, PRIOR)
    truth.tell(model, count, noise)
    for _ in range(fits):
        model.fit()
    return model


def test_the_quadratic_and_its_noise_are_found() -> None:
    truth = Truth(0)
    model = fitted(truth, 20_000, 0.3)
    p, m, c = model.fit()
    # Five standard errors of an ordinary least squares with regressors of about one.
    error = 5.0 * 0.3 / np.sqrt(20_000)
    np.testing.assert_allclose(p, truth.p, atol=2.0 * error)
    np.testing.assert_allclose(m, truth.m, atol=error)
    np.testing.assert_allclose(c, truth.c, atol=error)
    assert model.noise == pytest.approx(0.3, rel=0.03)
    least = np.linalg.solve(truth.p, truth.m - np.outer(truth.c, [1.0, 0.0, 0.0]))
    np.testing.assert_allclose(model.best(1e-3), least, atol=0.1)


def test_the_best_action_is_no_costlier_than_any_other() -> None:
    truth = Truth(1)
    model = fitted(truth, 20_000, 0.05)
    x = np.c_[np.ones(50), np.random.default_rng(2).standard_normal((50, FEATURES - 1))]
    best = x @ model.best(1e-3).T
    others = best + 0.5 * np.random.default_rng(3).standard_normal(best.shape)
    lasting = truth.cost(others, x) + others @ truth.c - truth.cost(best, x) - best @ truth.c
    assert (lasting > 0.0).all()


def test_it_is_the_posterior_of_normal_equations_solved_otherwise() -> None:
    """Ridge regression as least squares with a row a prior, by an independent solver."""
    truth, model = Truth(4), PairedQuadratic(ENTRIES, FEATURES, PRIOR)
    rows: list[Array] = []
    u, v, before = truth.random.standard_normal((3, 12, ENTRIES))
    x = np.c_[np.ones(12), truth.random.standard_normal((12, FEATURES - 1))]
    difference = truth.random.standard_normal(12)
    model.add(u, v, x, before, difference)
    upper = [(i, j) for i in range(ENTRIES) for j in range(i, ENTRIES)]
    for k in range(12):
        share = [0.5 if i == j else 1.0 for i, j in upper]
        square = [
            s * (u[k, i] * u[k, j] - v[k, i] * v[k, j])
            for s, (i, j) in zip(share, upper, strict=True)
        ]
        linear = [-(u[k, i] - v[k, i]) * x[k, j] for i in range(ENTRIES) for j in range(FEATURES)]
        rows.append(np.array([*square, *linear, *before[k]]))
    spread = [0.5] * len(upper) + [0.5] * (ENTRIES * FEATURES) + [0.1] * ENTRIES
    mean = [0.5 * (i == j) for i, j in upper] + [0.0] * (ENTRIES * FEATURES + ENTRIES)
    noise = model.noise
    system = np.vstack([np.array(rows) / noise, np.diag(1.0 / np.array(spread))])
    right = np.concatenate([difference / noise, np.array(mean) / spread])
    wanted = np.linalg.lstsq(system, right, rcond=None)[0]
    p, m, c = model.fit()
    np.testing.assert_allclose([p[i, j] for i, j in upper], wanted[: len(upper)], atol=1e-9)
    np.testing.assert_allclose(m.ravel(), wanted[len(upper) : -ENTRIES], atol=1e-9)
    np.testing.assert_allclose(c, wanted[-ENTRIES:], atol=1e-9)


def test_before_any_pair_the_best_action_is_none() -> None:
    model = PairedQuadratic(ENTRIES, FEATURES, PRIOR)
    p, _, _ = model.fit()
    np.testing.assert_allclose(p, 0.5 * np.eye(ENTRIES))
    np.testing.assert_array_equal(model.best(0.2), np.zeros((ENTRIES, FEATURES)))


def test_what_is_forgotten_counts_less() -> None:
    old, new = Truth(5), Truth(6)
    model = fitted(old, 5000, 0.1)
    model.forget(1e-3)
    new.tell(model, 5000, 0.1)
    for _ in range(5):
        p, m, _ = model.fit()
    np.testing.assert_allclose(p, new.p, atol=0.03)
    np.testing.assert_allclose(m, new.m, atol=0.03)


def test_directions_without_curvature_are_held_back() -> None:
    model = fitted(Truth(7), 20_000, 0.05)
    p, m, c = model.fit()
    m[:, 0] -= c
    steep = 2.0 * np.linalg.eigvalsh(p).max()
    # All eigenvalues raised to one number: P is a multiple of the identity.
    np.testing.assert_allclose(model.best(steep), m / steep, atol=1e-9)


# Drives in pairs ------------------------------------------------------------------------------


def learning(**changes: Any) -> PairedLearning:
    given: dict[str, Any] = {"trajectories": ("sine",), "drives": 8, "time_limit": 4.0, **changes}
    return PairedLearning(usual("paired", **given), [trajectories.load("sine")])


def test_without_offsets_the_two_of_a_pair_are_one_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    tuner, seen = learning(), []

    def add(_: Any, plus: Array, minus: Array, __: Array, ___: Array, difference: Array) -> None:
        np.testing.assert_array_equal(plus, minus)
        seen.append(difference)

    monkeypatch.setattr(PairedQuadratic, "add", add)
    still = np.random.default_rng(0)
    monkeypatch.setattr(np.random, "default_rng", lambda _: Still(still))
    scores = tuner.step()
    assert scores["score"] == pytest.approx(scores["best"], rel=1e-12)  # means of the same drives
    assert np.concatenate(seen).size == 2 * 4
    np.testing.assert_array_equal(np.concatenate(seen), 0.0)


class Still:
    """A generator whose normal numbers are zeros."""

    def __init__(self, _: np.random.Generator) -> None:
        pass

    def standard_normal(self, shape: tuple[int, ...]) -> Array:
        return np.zeros(shape)


def test_offsets_make_a_difference_and_pairs_are_different_drives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tuner, seen = learning(), []
    monkeypatch.setattr(PairedQuadratic, "add", lambda _, *given: seen.append(given))
    tuner.step()
    plus, minus, x, before, difference = (np.concatenate(part) for part in zip(*seen, strict=True))
    assert np.abs(plus - minus).min(axis=1).max() > 1e-3
    assert len(set(difference.tolist())) == 8
    np.testing.assert_array_equal(x[:, 0], 1.0)
    # The first stretch has none before it; the second has the first.
    np.testing.assert_array_equal(before[:4], 0.0)
    np.testing.assert_array_equal(before[4:], (plus - minus)[:4])
    # Of an action's deviation: two of them, held.
    deviation = tuner.settings.hyperparameters["deviation"]
    assert (plus - minus).std() == pytest.approx(np.sqrt(2.0) * deviation, rel=0.3)
    # The weights in use are hidden.
    own = [k for k, name in enumerate(names(tuner.choice.bands.names)) if name.startswith("weight")]
    np.testing.assert_array_equal(x[:, [1 + k for k in own]], 0.0)
    assert tuner.solves == 8 * 80


def test_a_round_moves_the_policy_within_its_bounds() -> None:
    tuner = learning()
    np.testing.assert_array_equal(tuner.policy, 0.0)
    while not tuner.done and tuner.solves < 6000:
        tuner.step()
    assert np.abs(tuner.policy).max() > 0.0
    assert np.abs(tuner.policy[:, 0]).max() <= BIAS
    ((weight, bias),) = tuner.result({}).layers
    np.testing.assert_array_equal(bias, tuner.policy[:, 0].astype(np.float32))
    np.testing.assert_array_equal(weight, (tuner.policy[:, 1:] * tuner.seen).astype(np.float32))


def test_root_mean_squares_begin_at_usual_ones_and_end_at_the_drive_s() -> None:
    own = np.array([[0.2, 0.1, 1.0, 0.5, 2.0]])
    np.testing.assert_allclose(rms_so_far(0.0 * own, np.zeros(1), 8)[0], USUAL)
    steps = np.array([1e9])
    np.testing.assert_allclose(rms_so_far(steps * own**2, steps, 8), own, rtol=1e-6)
    half = rms_so_far(USUAL_WINDOWS * 8 * own**2, np.array([USUAL_WINDOWS * 8.0]), 8)
    np.testing.assert_allclose(half, np.sqrt(0.5 * (USUAL**2 + own**2)))


def test_an_odd_number_of_drives_is_refused() -> None:
    with pytest.raises(ValueError, match="even number of drives, not 7"):
        learning(drives=7)
