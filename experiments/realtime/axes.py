"""Ticks of logarithmic axes."""

from typing import Any

from matplotlib.ticker import LogLocator, NullFormatter


def plain_ticks(ax: Any) -> None:
    """Label a logarithmic x axis with plain numbers: powers of ten would want fonts of formulas."""
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())
