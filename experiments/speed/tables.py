"""What was measured as tables for a terminal, from the contents of `speed.json` alone."""

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from experiments.speed.measure import PREDICT, WINDOW_MEDIAN

Result = Mapping[str, Any]
OVER = ("n", "horizon")
"""Settings that make the rows of a table, where a section varies one of them."""
SCALES = ((1.0, "s"), (1e-3, "ms"), (1e-6, "us"), (1e-9, "ns"))
BUSY = 0.5
"""Load per core from which on the machine is said to be busy."""


def quantity(value: float, unit: str) -> str:
    """A value in three digits: of seconds in a fitting multiple, of bytes in MiB or B."""
    if unit.startswith("bytes"):
        return f"{value / 2**20:.1f} MiB" if value >= 2**20 else f"{value:.0f} B"
    if unit.startswith("share"):
        return f"{100.0 * value:.1f} %"
    scale, name = next((pair for pair in SCALES if value >= pair[0]), SCALES[-1])
    digits = ".3g" if value < 999.5 * scale else ".0f"
    return f"{value / scale:{digits}} {name}"


def rate(value: float) -> str:
    """Times a second, of the seconds that one takes."""
    times = 1.0 / value
    for scale, name in ((1e6, " M"), (1e3, " k")):
        if times >= scale:
            return f"{times / scale:.3g}{name}/s"
    return f"{times:.3g}/s"


def ratio(found: Result | None) -> str:
    """Median and range of a ratio: how many times as long as ours."""
    if found is None:
        return ""
    return f"x {found['median']:.3g} ({found['min']:.3g}..{found['max']:.3g})"


def ratio_of(section: Result, series: Result) -> Result | None:
    """The section's ratio of a series to ours, or None."""
    for found in section["ratios"]:
        same = found["other"] == series["name"]
        if same and found["settings"]["other"] == series["settings"]:
            of_medians = found["unit"] == WINDOW_MEDIAN and series["unit"] == PREDICT
            if found["unit"] == series["unit"] or of_medians:
                return dict(found)
    return None


def differing(section: Result) -> set[str]:
    """Settings that are not the same in all series of a section."""
    settings = [series["settings"] for series in section["series"]]
    return {
        key for one in settings for key in one
        if any(other.get(key) != one[key] for other in settings)
    }  # fmt: skip


def label(series: Result, keys: set[str]) -> str:
    """Name of a series with some of its settings."""
    told = {key: value for key, value in series["settings"].items() if key in keys}
    if told.get("threads") == 1:
        del told["threads"]
    words = [
        f"{value} threads" if key == "threads" else f"{key} {value}" for key, value in told.items()
    ]
    return ", ".join([series["name"], *words])


def section_table(section: Result) -> Table:
    """A table of one section that has series."""
    everywhere = set.intersection(*(set(series["settings"]) for series in section["series"]))
    key = next((key for key in OVER if key in differing(section) & everywhere), None)
    return _list(section) if key is None else _grid(section, key)


def leading(section: Result) -> list[Result]:
    """The series in the unit of the section's first one, which is what it is about."""
    return [one for one in section["series"] if one["unit"] == section["series"][0]["unit"]]


def _list(section: Result) -> Table:
    """A row per series; columns that would be empty are left out."""
    rows, keys = [], differing(section)
    for series in section["series"]:
        unit = series["unit"]
        if unit == WINDOW_MEDIAN:
            continue
        low, high = quantity(series["min"], unit), quantity(series["max"], unit)
        rows.append(
            {
                "": label(series, keys),
                "in": unit,
                "median": quantity(series["median"], unit),
                "a second": rate(series["median"]) if unit.startswith("s/") else "",
                "rounds": f"{low} .. {high}" if len(series["rounds"]) > 1 else "",
                "99th percentile": quantity(series["p99"], unit) if "p99" in series else "",
                "ratio to ours": ratio(ratio_of(section, series)),
            }
        )
    table = Table(box=box.SIMPLE_HEAD)
    headings = [heading for heading in rows[0] if any(row[heading] for row in rows)]
    for heading in headings:
        table.add_column(heading, justify="left" if heading in {"", "in"} else "right")
    for row in rows:
        table.add_row(*(Text(row[heading]) for heading in headings))
    return table


def _grid(section: Result, key: str) -> Table:
    """A row per value of a setting, a column per series; ratios to ours below the medians."""
    series, keys = leading(section), differing(section) - {key}
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column(key, justify="right")
    columns = list(dict.fromkeys(label(one, keys) for one in series))
    for column in columns:
        table.add_column(column, justify="right")
    for value in dict.fromkeys(one["settings"][key] for one in series):
        row = {label(one, keys): one for one in series if one["settings"][key] == value}
        cells = []
        for column in columns:
            one = row.get(column)
            if one is None:
                cells.append("")
                continue
            # In a narrow column the range goes below.
            against = ratio(ratio_of(section, one)).replace(" (", "\n(")
            cells.append(f"{quantity(one['median'], one['unit'])}\n{against}".rstrip())
        table.add_row(str(value), *cells)
    return table


def show(result: Result, console: Console) -> None:
    """Print every section, what was left out and why, and how busy the machine was."""
    for section in result["sections"].values():
        console.print(section["title"], style="bold", highlight=False)
        if section["series"]:
            console.print(section_table(section))
        if section["ratios"]:
            console.print("x: times as long as ours, median (min..max) of the rounds", style="dim")
        for note in section["notes"]:
            console.print(note, style="dim", highlight=False, markup=False)
        for missing in section["unavailable"]:
            console.print(
                f"left out: {missing['name']}: {missing['reason']}", style="yellow",
                markup=False, highlight=False,
            )  # fmt: skip
        console.print()
    console.print(load(result), highlight=False)


def load(result: Result) -> str:
    """How busy the machine was, in a sentence or two."""
    machine = result["machine"]
    before, after = machine["load_average_before"], machine["load_average_after"]
    if before is None or after is None:
        return "This system tells no load average."
    cores = machine["cores"] or 1
    text = (
        f"{machine['processor']}, {cores} cores; load average over a minute {before[0]:.2f} before,"
        f" {after[0]:.2f} after (this command itself counts for about 1)."
    )
    if before[0] > BUSY * cores:
        text += " The machine was busy before: read the ratios and their ranges, not the times."
    return text
