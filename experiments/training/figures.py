"""The picture of a training: what validation said as it went on."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.ticker import EngFormatter

from experiments.figures import COLOURS, save_figure


def draw(lines: Sequence[dict[str, Any]], file: Path) -> None:
    """Draw ALE and steering of the validation drives over steps and seconds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = [line["steps"] for line in lines]
    for axes, key, label in (
        (left, "mean_ale", "ALE m, mean of validation drives"),
        (right, "mean_steering_variation", "steering variation rad, mean"),
    ):
        values = [line["validation"][key] for line in lines]
        axes.plot(steps, values, color=COLOURS[0], marker=".")
        best = [k for k, line in enumerate(lines) if line["best"]][-1]
        axes.plot(steps[best], values[best], "o", color=COLOURS[1], label="kept")
        axes.set(xlabel="steps", ylabel=label)
        axes.grid(alpha=0.3)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    # The first policies leave the road: where the last ones are is what matters.
    left.set_ylim(
        0.0, 1.3 * max(line["validation"]["mean_ale"] for line in lines[len(lines) // 2 :])
    )
    left.legend()
    figure.suptitle(f"{lines[-1]['seconds']:.0f} s, {lines[-1]['solves']:,} NMPC solves")
    save_figure(figure, file)
