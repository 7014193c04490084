"""Colours of all figures, and the style of those that commands draw with Matplotlib."""

from typing import Any

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5195")
"""Okabe and Ito's colour-blind-safe set (jfly.uni-koeln.de/color) less black and yellow, a violet
added; reports have the same hues as `c0` to `c6`, each in a shade for light and one for dark."""
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
