"""Figures of the tuning study: learning curves, regret, weights and gains by band."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.policy import load
from agents.weights import TrackingWeights
from experiments.report.page import Panel, Styles
from experiments.report.svg_charts import Chart, Scale, around, decades
from experiments.run.metrics import BANDS
from experiments.run.statistics import Interval
from experiments.study.evaluation import EvaluationSet, loop_with
from experiments.study.study import Study
from experiments.study.tables import RungResult
from experiments.tuning.loop import WEIGHTS
from experiments.tuning.tuner import Result
from trajectories import CurvatureBands

Array = NDArray[Any]

GROUPS = {"speed": (0, 4), "heading": (1, 5), "position": (2, 3, 6, 7)}
"""Indices of the weights in Q and S of each quantity."""
WINDOWS = 40
"""Windows of a drive whose weights are drawn, each of 8 periods."""
HEIGHT = 230.0


def learning_curves(study: Study, styles: Styles) -> list[Panel]:
    """Draw the scores of the candidates over the solves, mean over trainings."""
    curves = {}
    for label in styles:
        runs = [lines for seed in study.seeds if (lines := study.progress(label, seed))]
        if not runs:
            continue
        length = min(len(lines) for lines in runs)
        solves = np.array([line["solves"] for line in runs[0][:length]], dtype=float)
        scores = np.mean([[line["score"] for line in lines[:length]] for lines in runs], axis=0)
        curves[label] = solves, scores
    if not curves:
        return []
    chart = Chart(
        decades([solves for solves, _ in curves.values()], 1.0),
        around([scores for _, scores in curves.values()]),
        x_label="NMPC solves", y_label="score of the candidates", height=HEIGHT,
    )  # fmt: skip
    for label, (solves, scores) in curves.items():
        style = styles[label]
        chart.line(solves, scores, style.kind, style.width)
        for x, y in zip(solves, scores, strict=True):
            chart.dot(float(x), float(y), f"f{style.colour}", 1.4)
    return [Panel("mean over trainings", chart.svg())]


def regret(rows: Sequence[RungResult], greedy: float, styles: Styles) -> list[Panel]:
    """Draw the score above the greedy oracle's over the solves, with 95 % intervals."""
    ends = [[row.score.low - greedy, row.score.high - greedy] for row in rows]
    solves = [row.solves for row in rows if row.solves > 0.0]
    chart = Chart(
        decades([[0.6 * min(solves), 1.7 * max(solves)]] if solves else [[1.0, 10.0]], 1.0),
        around(ends, zero=True),
        x_label="NMPC solves", y_label="regret to the greedy oracle", height=HEIGHT,
    )  # fmt: skip
    for k, row in enumerate(rows):
        style = styles[row.rung.label]
        value = row.score.value - greedy
        if row.solves == 0.0:
            chart.rule(y=value, kind=style.kind)
            continue
        # Rungs of one budget stand side by side.
        place = row.solves * 1.08 ** (k - 0.5 * len(rows))
        chart.interval(place, (row.score.low - greedy, value, row.score.high - greedy), style)
    return [Panel("95 % intervals", chart.svg())]


def gains_in_bands(every: Mapping[str, Mapping[str, Interval]], styles: Styles) -> list[Panel]:
    """Draw the gains over the best fixed set in each band of curvature, with 95 % intervals."""
    ends = [
        [100 * gain.low, 100 * gain.high] for gains in every.values() for gain in gains.values()
    ]
    chart = _bands_chart(around([[0.0], *ends]), "gain over the best fixed set (%)")
    chart.rule(y=0.0, kind="zero")
    for k, (label, gains) in enumerate(every.items()):
        for band, gain in gains.items():
            interval = 100 * gain.low, 100 * gain.value, 100 * gain.high
            place = BANDS.names.index(band) + _offset(k, len(every))
            chart.interval(place, interval, styles[label])
    return [Panel("95 % intervals", chart.svg())]


def _bands_chart(y: Scale, words: str) -> Chart:
    names = BANDS.names
    return Chart(
        Scale(-0.5, len(names) - 0.5), y, x_names=names, y_label=words, height=HEIGHT,
        x_label="|curvature| of the path",
    )  # fmt: skip


def _offset(k: int, count: int) -> float:
    return 0.7 * ((k + 0.5) / count - 0.5)


def weights_in_use(result: Result, given: EvaluationSet) -> tuple[Array, Array]:
    """Return the weights (m, 12) and bands (m,) of the windows of some drives."""
    used, bands = [], []
    for path in given.trajectories[:6]:
        loop = loop_with(result, given.environments(path))
        loop.reset(seed=0)
        for _ in range(WINDOWS):
            loop.drive(8)
            running = loop.running
            used.append(loop.memory.nmpc.weights[running].copy())
            bands.append(loop.memory.nmpc.bands[running].copy())
    return np.concatenate(used), np.concatenate(bands)


def weights_over_curvature(
    study: Study, labels: Sequence[str], given: EvaluationSet, styles: Styles
) -> list[Panel]:
    """Draw the factors on the default weights in each band: medians, quartiles, a panel a group."""
    base = TrackingWeights().as_array()
    found = {
        label: weights_in_use(load(study.training(label, study.seeds[0]) / WEIGHTS), given)
        for label in labels
    }
    panels = []
    for group, indices in GROUPS.items():
        marks = []
        for k, (label, (used, bands)) in enumerate(found.items()):
            in_use = np.where(used > 0.0, used, base)[:, list(indices)]
            factors = np.log10(in_use / base[list(indices)]).mean(axis=1)
            for band in range(len(CurvatureBands().names)):
                own = factors[bands == band]
                if own.size:
                    low, middle, high = (float(one) for one in np.quantile(own, [0.25, 0.5, 0.75]))
                    place = band + _offset(k, len(found))
                    marks.append((place, (low, middle, high), styles[label]))
        chart = _bands_chart(
            around([[0.0], *(interval for _, interval, _ in marks)], least=0.1),
            "lg factor on default Q, S",
        )
        chart.rule(y=0.0, kind="zero")
        for place, interval, style in marks:
            chart.interval(place, interval, style)
        panels.append(Panel(group, chart.svg()))
    return panels
