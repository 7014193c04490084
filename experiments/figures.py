"""Colours and style of all figures, and saving of those drawn with Matplotlib."""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trajectories.fileio import write_atomically

if TYPE_CHECKING:
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5195")
"""Okabe and Ito's colour-blind-safe set (jfly.uni-koeln.de/color) without black and yellow, plus a
violet; reports use the same hues as `c0` to `c6`, with one shade for light and one for dark."""
STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "text.parse_math": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.formatter.useoffset": False,
    "lines.linewidth": 1.1,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}
DPI = 110.0


def save_figure(figure: "Figure", file: Path) -> None:
    """Write a figure atomically, in the format of the file's suffix (.png, .svg, .pdf).

    Raises
    ------
    ValueError
        If Matplotlib does not know the format.
    OSError
        If the file cannot be written.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DPI, format=file.suffix.removeprefix(".") or "png")
    write_atomically(file, buffer.getvalue())


def plain_ticks(axis: "Axis", multiples: tuple[float, ...] = (1.0, 2.0, 5.0)) -> None:
    """Label a logarithmic axis with plain numbers at `multiples` of every power of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=multiples))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())
