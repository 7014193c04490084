"""Tables of the tuning study: rows of plain text cells, for the page and the terminal."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.weight_tuning.score import COMFORT, PARTS, TRACKING
from experiments.run.metrics import BANDS
from experiments.run.statistics import (
    Interval,
    interquartile_mean,
    mean_interval,
    paired_gain,
    rate_bound,
)
from experiments.study.evaluation import IN_BANDS
from experiments.study.oracle import Headroom
from experiments.study.study import Rung, Study, rung_of

Array = NDArray[Any]
Lines = list[list[str]]


@dataclass(frozen=True)
class RungResult:
    """Results of a rung on an evaluation set: means, interquartile where there are trainings."""

    rung: Rung
    solves: float
    seconds: float
    score: Interval
    tracking: float
    comfort: float
    gain: Interval | None
    """Gain over the best fixed set; None for that set itself."""
    failures: int
    drives: int
    violated: float


def rung_result(study: Study, name: str, label: str) -> RungResult:
    """Return the results of a rung on one of the study's sets."""
    figures, rung = study.read(name, label), rung_of(label)
    parts = np.stack([figures[part] for part in PARTS], axis=-1).mean(axis=(1, 2))
    ends = [lines[-1] for seed in study.seeds if (lines := study.progress(label, seed))]
    gain = None
    if label != rung.baseline and rung.baseline in study.labels:
        base = study.read(name, rung.baseline)["score"]
        # The default weights are one training, compared with each of the baseline's.
        gain = paired_gain(np.broadcast_to(figures["score"], base.shape), base)
    return RungResult(
        rung=rung,
        solves=float(np.mean([end["solves"] for end in ends])) if ends else 0.0,
        seconds=float(np.mean([end["seconds"] for end in ends])) if ends else 0.0,
        score=mean_interval(figures["score"]),
        tracking=float(interquartile_mean(parts[:, TRACKING].sum(axis=1))),
        comfort=float(interquartile_mean(parts[:, COMFORT].sum(axis=1))),
        gain=gain,
        failures=int(figures["failed"].sum()),
        drives=int(figures["failed"].size),
        violated=float(figures["violated"].mean()),
    )


RUNG_HEADINGS = (
    "rung", "what it is", "solves", "s", "score", "95 %", "tracking", "comfort",
    "gain", "95 %", "of the headroom", "failed", "at most", "violations",
)  # fmt: skip


def rung_lines(rows: Sequence[RungResult], headroom: float | None) -> Lines:
    """Return a line for each rung; `headroom` is the greedy oracle's gain over the baseline."""
    lines = []
    for row in rows:
        gain = row.gain
        share = "–"
        if gain is not None and headroom is not None and headroom > 0.0:
            share = f"{gain.value / headroom:.0%}"
        lines.append(
            [
                row.rung.label,
                row.rung.words,
                f"{row.solves:,.0f}",
                f"{row.seconds:.0f}",
                f"{row.score.value:.3f}",
                f"{row.score.low:.3f} to {row.score.high:.3f}",
                f"{row.tracking:.3f}",
                f"{row.comfort:.3f}",
                "–" if gain is None else f"{gain.value:+.1%}",
                "–" if gain is None else f"{gain.low:+.1%} to {gain.high:+.1%}",
                share,
                f"{row.failures} of {row.drives}",
                f"{rate_bound(row.failures, row.drives):.2%}",
                f"{row.violated:.2%}",
            ]
        )
    return lines


HEADROOM_HEADINGS = (
    "known to the choice", "score in hindsight", "gain", "score by foresight", "gain by foresight",
)  # fmt: skip


def headroom_lines(rows: Sequence[Headroom], greedy: float | None) -> Lines:
    """Return a line for each kind of knowledge; the first is the best fixed set of the pool."""
    fixed, ahead = rows[0].hindsight, rows[0].foresight
    lines = []
    for row in rows:
        foresight = ["–", "–"]
        if row.foresight is not None and ahead is not None:
            foresight = [f"{row.foresight:.3f}", f"{1.0 - row.foresight / ahead:+.1%}"]
        lines.append([row.knows, f"{row.hindsight:.3f}", f"{row.gain(fixed):+.1%}", *foresight])
    if greedy is not None:
        lines.append(
            ["every window's next second (greedy)", f"{greedy:.3f}", f"{1.0 - greedy / fixed:+.1%}",
             "–", "–"]
        )  # fmt: skip
    return lines


def sets_lines(study: Study, labels: Sequence[str]) -> tuple[list[str], Lines]:
    """Return headings, and a line for each rung with its score on every set."""
    headings = ["rung", *(given.name for given in study.sets)]
    lines = []
    for label in labels:
        cells = [label]
        for given in study.sets:
            found = study.read(given.name, label)
            score = interquartile_mean(found["score"].mean(axis=(1, 2)))
            failures = int(found["failed"].sum())
            cells.append(f"{score:.3f}" + (f" ({failures} failed)" if failures else ""))
        lines.append(cells)
    return headings, lines


def band_gains(study: Study, name: str, label: str) -> dict[str, Interval]:
    """Return the gains over the best fixed set in each band that the paths of a set have."""
    ours, base = study.read(name, label), study.read(name, rung_of(label).baseline)
    gains = {}
    for entry, band in zip(IN_BANDS, BANDS.names, strict=True):
        reference = base[entry]
        given = np.broadcast_to(ours[entry], reference.shape)
        # A path counts in a band if every drive on it has periods there.
        whole = (np.isfinite(given) & np.isfinite(reference)).all(axis=(0, 2))
        if whole.any():
            gains[band] = paired_gain(given[:, whole], reference[:, whole])
    return gains


def band_lines(every: Mapping[str, Mapping[str, Interval]]) -> Lines:
    """Return a line for each rung with its gains in each band."""
    lines = []
    for label, gains in every.items():
        cells = [
            f"{gain.value:+.1%} ({gain.low:+.1%} to {gain.high:+.1%})"
            if (gain := gains.get(band)) is not None
            else "–"
            for band in BANDS.names
        ]
        lines.append([label, *cells])
    return lines


PAPER_HEADINGS = ("path", "rung", "Max CTE m", "ALE m", "AOE rad", "score", "steering rate rad/s")


def paper_lines(study: Study, name: str, labels: Sequence[str]) -> Lines:
    """Return the paper's metrics on a set: means over trainings and drives, by path and rung."""
    given = next(one for one in study.sets if one.name == name)
    found: Mapping[str, dict[str, Array]] = {label: study.read(name, label) for label in labels}
    lines = []
    for k, path in enumerate(given.labels):
        for label in labels:
            row = {key: values[:, k].mean() for key, values in found[label].items()}
            lines.append(
                [
                    path if label == labels[0] else "",
                    label,
                    f"{row['max_cte']:.3f}",
                    f"{row['ale']:.4f}",
                    f"{row['aoe']:.4f}",
                    f"{row['score']:.3f}",
                    f"{0.2 * row['steering_rate']:.3f}",
                ]
            )
    return lines


def labels_under(study: Study, *, disturbed: bool) -> list[str]:
    """Return the labels of the rungs tuned with disturbances, or of those tuned without."""
    return [
        label for label in study.labels if (rung_of(label).conditions != "simulation") == disturbed
    ]
