"""Learning curves: drives that did not finish are no small errors."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from experiments.jobs.console import TrainingDisplay
from experiments.jobs.curves import TRAINING, TUNING, draw, median_of, of_finished, values_of

NOTHING = {"loss": 4.65, "finished": 0.0}
HALF = {"loss": 0.5, "finished": 0.5, "mean_ale": 0.25, "mean_steering_variation": 2.0}
EARLIER = {"loss": 4.65, "finished": 0.0, "mean_ale": 0.0, "mean_steering_variation": 0.0}
"""As earlier versions wrote it: the vehicle left the road at once."""


def line(validation: dict[str, float], steps: int = 1000, *, best: bool = False) -> dict[str, Any]:
    return {
        "steps": steps, "seconds": 3.0, "solves": 0, "best": best, "validation": validation,
        "score": 1.5,
    }  # fmt: skip


@pytest.mark.parametrize("validation", [NOTHING, EARLIER])
def test_where_no_drive_finished_there_is_no_error(validation: dict[str, float]) -> None:
    lines = [line(validation), line(HALF)]
    finished, ale, steering = (values_of(lines, curve) for curve in TRAINING)
    np.testing.assert_array_equal(finished, [0.0, 50.0])
    np.testing.assert_array_equal(ale, [np.nan, 0.25])
    np.testing.assert_array_equal(steering, [np.nan, 2.0])
    assert of_finished(line(validation), "mean_ale") is None


@pytest.mark.parametrize(
    ("validation", "words"), [(NOTHING, "ALE –"), (EARLIER, "ALE –"), (HALF, "ALE 0.2500 m")]
)
def test_the_line_of_a_validation_says_so(validation: dict[str, float], words: str) -> None:
    written = io.StringIO()
    TrainingDisplay(Console(file=written, width=120), "ppo", 2000, None, "seed 3: ").line(
        line(validation)
    )
    text = written.getvalue()
    assert text.startswith("seed 3: ")
    assert text.rstrip().endswith(words)


def test_a_missing_figure_is_the_worst_of_the_median() -> None:
    values = np.array([[np.nan, np.nan, 0.1], [np.nan, 0.2, 0.2], [0.3, 0.3, 0.6]])
    np.testing.assert_array_equal(median_of(values), [np.nan, 0.3, 0.2])


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Figures that a test draws, which are not saved."""
    drawn: list[Any] = []
    monkeypatch.setattr(
        "experiments.figures.save_figure", lambda figure, _file: drawn.append(figure)
    )
    return drawn


def test_curves_of_one_and_of_several_seeds_are_drawn(tmp_path: Path, figures: list[Any]) -> None:
    early, late = line(NOTHING, best=True), line(HALF, 2000, best=True)
    draw({5: [early, late]}, TRAINING, "steps", tmp_path / "one.png")
    draw({0: [early, late], 1: [early], 2: [early, late]}, TRAINING, "steps", tmp_path / "all.png")
    draw({0: [early, late], 2: [late]}, TUNING, "solves", tmp_path / "tuning.png")
    one, many, tuning = figures
    assert [len(axes.lines) for axes in one.axes] == [2, 2, 2]
    np.testing.assert_array_equal(one.axes[1].lines[0].get_ydata(), [np.nan, 0.25])
    # Three trainings, what each kept, and the median as far as all of them go.
    assert [len(axes.lines) for axes in many.axes] == [7, 7, 7]
    np.testing.assert_array_equal(many.axes[0].lines[-1].get_xdata(), [1000])
    assert many.axes[0].get_xlim() == many.axes[1].get_xlim()
    assert len(tuning.axes) == 1


def test_nothing_finished_is_said_in_the_picture(tmp_path: Path, figures: list[Any]) -> None:
    draw({0: [line(EARLIER, best=True)]}, TRAINING, "steps", tmp_path / "none.png")
    finished, ale, _ = figures[0].axes
    assert [text.get_text() for text in ale.texts] == ["no drive finished"]
    assert not list(finished.texts)
    np.testing.assert_array_equal(finished.lines[0].get_ydata(), [0.0])
