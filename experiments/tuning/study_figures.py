"""Pictures of the tuning study: learning curves, regret, weights and gains by band."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import EngFormatter, NullFormatter
from numpy.typing import NDArray

from agents.weight_tuning.files import load
from agents.weights import TrackingWeights
from experiments.band_metrics import BANDS
from experiments.figures import COLOURS, render
from experiments.tuning.evaluation import EvaluationSet, loop_with
from experiments.tuning.loop import WEIGHTS
from experiments.tuning.statistics import Interval
from experiments.tuning.study import Study
from experiments.tuning.study_tables import Judged
from experiments.tuning.tuner import Result
from lpv_track_env.vector_env import PathTrackingVectorEnv
from trajectories import CurvatureBands

Array = NDArray[Any]

GROUPS = {"speed": (0, 4), "heading": (1, 5), "position": (2, 3, 6, 7)}
"""Indices of Q and S by what they weigh."""
WINDOWS = 40


def _style(k: int) -> tuple[str, str, str]:
    """Colour, marker and line of the k-th rung: more of them than colours."""
    again = k // len(COLOURS)
    return COLOURS[k % len(COLOURS)], "osD^"[again % 4], ("-", "--", ":", "-.")[again % 4]


def learning_curves(study: Study, labels: Sequence[str]) -> str:
    """SVG: scores of what was tried over solves, mean over trainings."""

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for k, label in enumerate(labels):
            runs = [lines for seed in study.seeds if (lines := study.progress(label, seed))]
            if not runs:
                continue
            length = min(len(lines) for lines in runs)
            solves = [line["solves"] for line in runs[0][:length]]
            scores = np.mean([[line["score"] for line in lines[:length]] for lines in runs], axis=0)
            colour, _, line = _style(k)
            axes.plot(solves, scores, color=colour, ls=line, label=label, lw=1.0, marker=".", ms=3)
        axes.set(xlabel="NMPC solves", ylabel="score of what was tried", xscale="log")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)

    return render(draw, 3.0, "learning")


def regret(rows: Sequence[Judged], greedy: float) -> str:
    """SVG: score above the greedy oracle's against the solves that it took."""

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for k, row in enumerate(rows):
            colour, marker, line = _style(k)
            value = row.score.value - greedy
            if row.solves == 0.0:
                axes.axhline(value, color=colour, ls=line, lw=1.0, label=row.rung.label)
                continue
            # Side by side, where budgets are the same.
            axes.errorbar(
                row.solves * 1.08 ** (k - 0.5 * len(rows)), value,
                yerr=[[row.score.value - row.score.low], [row.score.high - row.score.value]],
                color=colour, marker=marker, ms=5, lw=0, elinewidth=1.0, capsize=3,
                label=row.rung.label,
            )  # fmt: skip
        axes.set(xlabel="NMPC solves", ylabel="regret to the greedy oracle", xscale="log")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)

    return render(draw, 3.0, "regret")


def gains_in_bands(every: Mapping[str, Mapping[str, Interval]]) -> str:
    """SVG: gains over the best fixed set in each band of curvature, 95 % intervals."""

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        for k, (label, gains) in enumerate(every.items()):
            places = [BANDS.names.index(band) + 0.12 * (k - 0.5 * len(every)) for band in gains]
            values = np.array([[gain.low, gain.value, gain.high] for gain in gains.values()]) * 100
            low, value, high = values.T
            axes.errorbar(
                places, value, yerr=[value - low, high - value], color=COLOURS[k % len(COLOURS)],
                marker="o", ms=3, capsize=2, lw=0, elinewidth=1.0, label=label,
            )  # fmt: skip
        axes.axhline(0.0, color="0.5", lw=0.8)
        axes.set_xticks(range(len(BANDS.names)), BANDS.names)
        axes.set(ylabel="gain over the best fixed set, %")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)

    return render(draw, 3.0, "bands")


def weights_in_use(result: Result, given: EvaluationSet) -> tuple[Array, Array]:
    """Weights (m, 10) and bands (m,) of the windows of some drives."""
    settings: dict[str, Any] = {"autoreset_mode": "Disabled", **given.env_settings}
    used, bands = [], []
    for path in given.trajectories[:6]:
        envs = PathTrackingVectorEnv(
            given.seeds, path, given.vehicle, conditions=given.conditions, **settings
        )
        loop = loop_with(result, envs)
        loop.reset(seed=0)
        for _ in range(WINDOWS):
            loop.drive(8)
            running = loop.running
            used.append(loop.memory.nmpc.weights[running].copy())
            bands.append(loop.memory.nmpc.bands[running].copy())
    return np.concatenate(used), np.concatenate(bands)


def weights_over_curvature(study: Study, labels: Sequence[str], given: EvaluationSet) -> str:
    """SVG: factors on the default weights in each band, medians and quartiles over drives."""
    names = CurvatureBands().names
    base = TrackingWeights().as_array()

    def draw(figure: Any) -> None:
        every = figure.subplots(1, len(GROUPS), sharey=True)
        for axes, (group, indices) in zip(every, GROUPS.items(), strict=True):
            for k, label in enumerate(labels):
                result = load(study.training(label, study.seeds[0]) / WEIGHTS)
                used, bands = weights_in_use(result, given)
                used = np.where(used > 0.0, used, base)
                factors = np.log10(used[:, list(indices)] / base[list(indices)]).mean(axis=1)
                places, middles, lows, highs = [], [], [], []
                for band in range(len(names)):
                    own = factors[bands == band]
                    if own.size:
                        low, middle, high = np.quantile(own, [0.25, 0.5, 0.75])
                        places.append(band + 0.12 * (k - 0.5 * len(labels)))
                        middles.append(middle)
                        lows.append(middle - low)
                        highs.append(high - middle)
                axes.errorbar(
                    places, middles, yerr=[lows, highs], color=COLOURS[k % len(COLOURS)],
                    marker="o", ms=3, capsize=2, lw=0.8, label=label,
                )  # fmt: skip
            axes.set_title(group, fontsize=9)
            axes.set_xticks(range(len(names)), names, rotation=45, fontsize=7)
            axes.grid(alpha=0.3)
        every[0].set_ylabel("lg factor on default Q, S")
        every[-1].legend(fontsize=7)

    return render(draw, 2.6, "weights")
