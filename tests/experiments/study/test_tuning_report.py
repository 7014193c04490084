"""The tuning study's page: what its tables say is what was measured; a folder is one study's."""

import json
import math
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from agents.weights import TrackingWeights, WeightSchedule
from experiments.jobs.job import PROGRESS
from experiments.run.store import write_arrays
from experiments.study.evaluation import FIGURES, IN_BANDS, EvaluationSet
from experiments.study.oracle import Headroom
from experiments.study.report import write_report
from experiments.study.study import BASELINE, Study
from experiments.study.tables import rung_result
from experiments.tuning.loop import WEIGHTS
from trajectories import CurvatureBands

SETS = (
    EvaluationSet("held-out", ("u-turn", "sine"), "simulation", 2),
    EvaluationSet("six, realtime", ("u-turn",), "simulation", 2),
)
SCORES = {"default": 4.0, BASELINE: 2.0, "bands": 1.5}


@pytest.fixture(name="made")
def fixture_made(tmp_path: Path) -> Study:
    """A study of made figures: every drive of a rung has the same score, all of it lateral."""
    made = Study(tmp_path, tuple(SCORES), (0, 1), 1000, SETS)
    bands = CurvatureBands()
    schedule = WeightSchedule(bands, (TrackingWeights(),) * len(bands))
    for one, seed in made.trainings():
        folder = made.training(one.label, seed)
        folder.mkdir(parents=True)
        schedule.write(folder / WEIGHTS)
        if one.method != "fixed":
            line = {"step": 0, "solves": 900, "seconds": 2.0, "score": 3.0, "best": 1.0}
            (folder / PROGRESS).write_text(json.dumps(line) + "\n")
        for given in SETS:
            zero = np.zeros((len(given.trajectories), given.seeds))
            score = zero + SCORES[one.label]
            figures = {
                **dict.fromkeys(FIGURES, zero), **dict.fromkeys(IN_BANDS, np.nan * zero),
                "score": score, "lateral": score, "in_straight": score,
            }  # fmt: skip
            write_arrays(made.evaluation(given.name, one.label, seed), figures)
    return made


def test_results_of_a_rung_are_its_figures(made: Study) -> None:
    bands = rung_result(made, "held-out", "bands")
    assert (bands.score.value, bands.score.low, bands.score.high) == (1.5, 1.5, 1.5)
    assert (bands.tracking, bands.comfort, bands.solves, bands.seconds) == (1.5, 0.0, 900, 2.0)
    assert bands.gain is not None
    assert bands.gain.value == pytest.approx(0.25)
    assert (bands.failures, bands.drives) == (0, 8)
    default, baseline = (rung_result(made, "held-out", label) for label in ("default", BASELINE))
    assert default.gain is not None
    assert default.gain.value == pytest.approx(-1.0)
    assert default.solves == 0.0
    assert baseline.gain is None


class Balance(HTMLParser):
    """Tags that are open, and all text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, _: list[tuple[str, str | None]]) -> None:
        if tag not in {"meta", "path", "use", "rect"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in {"path", "use", "rect"}:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_says_what_was_measured(made: Study, tmp_path: Path) -> None:
    headroom = [Headroom("nothing", 2.0, 2.0), Headroom("the path", 1.0, 1.5)]
    summary = write_report(made, headroom, 1.0, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    parsed = Balance()
    parsed.feed(page)
    assert parsed.open == []
    for words in ("+25.0%", "-100.0%", "+50.0%", "0 of 8", "The ladder on held-out", "u-turn"):
        assert words in parsed.text, words
    # In the one band that there is, as everywhere.
    assert "+25.0% (+25.0% to +25.0%)" in parsed.text
    assert page.count('<figure class="plate"') == 4
    # A quarter is half of the half that the greedy oracle finds.
    line = next(line for line in summary["ladder"] if line[0] == "bands")
    assert line[8:11] == ["+25.0%", "+25.0% to +25.0%", "50%"]
    assert "://" not in page
    assert json.loads((tmp_path / "summary.json").read_text())["greedy"] == 1.0
    assert not math.isnan(summary["headroom"][0]["hindsight"])


def test_a_folder_is_one_studys(tmp_path: Path) -> None:
    first = Study(tmp_path, ("default",), (0,), 1000, SETS[:1])
    # More rungs, seeds or sets may be added.
    for one in (first, replace(first, labels=tuple(SCORES), seeds=(0, 1), sets=SETS), first):
        with one.claimed():
            pass
    others = (
        replace(first, solves=2000),
        replace(first, sets=(replace(SETS[0], seeds=3),)),
        replace(first, sets=(*SETS[:1], replace(SETS[1], trajectories=("sine",)))),
    )
    for other in others:
        match = "holds a study of another budget or other drives"
        with pytest.raises(ValueError, match=match), other.claimed():
            pass
