"""`report.html` from a results folder alone: nothing is driven again, nothing is fetched."""

import html
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments import figures, published, tables
from experiments.curvature_table import curvature_section
from experiments.figures import Drive, Panel, Styles
from experiments.html_tables import html_table, html_tables
from experiments.learning_table import TRAINED_NOTE, learning_section
from experiments.report_page import ERRATA, PAGE
from experiments.results import ResultStore
from trajectories.atomic import write_atomically

Result = Mapping[str, Any]

FIGURES: tuple[tuple[str, str, Callable[[Sequence[Drive], Styles, str], list[Panel]]], ...] = (
    ("Paths", "Reference broad and grey, start ●, an end before the path's ×.", figures.paths),
    ("Lateral error", "Left of the path is positive. Scales differ between panels.",
     figures.lateral_error),
    ("Heading error", "Less the path's heading, in (−π, π]; on a bend sideslip keeps it from zero.",
     figures.heading_error),
    ("Speed", "Over arc length; the path's reference speed broad and grey.", figures.speed),
    ("Inputs", "Steering angle and acceleration in force, after the actuators.", figures.inputs),
    ("Time of predict", "Whole calls: line over all, bar 5 to 95 %, tick the median, circle 99 %.",
     figures.solve_times),
)  # fmt: skip
"""Heading, caption and function of every figure that is drawn for each setting."""


def write_report(folder: Path) -> Path:
    """Build `report.html` in a results folder from what the folder holds, and return its path.

    Raises
    ------
    ValueError
        If the folder holds no cases, or a damaged line other than the last.
    """
    none = f"no results in {folder}: run lpv-track benchmark --out {folder} first"
    if not (folder / "cases.jsonl").is_file():
        raise ValueError(none)
    store = ResultStore(folder)
    cases = store.cases()
    if not cases:
        raise ValueError(none)
    file = folder / "report.html"
    write_atomically(file, build(cases, store).encode())
    return file


def build(cases: Sequence[Result], store: ResultStore) -> str:
    """The page as text."""
    kept = tables.ordered(tables.current(cases))
    manifest = store.manifest()
    drives, missing = drives_of(kept, store)
    styles = figures.line_styles(tables.labels(kept))
    failed = [case for case in kept if case.get("status") != "ok"]
    sections = {
        "Summary": summary(kept, len(cases) - len(kept)),
        "Against the published table": comparison(kept),
        "By curvature": curvature_section(kept),
        "What learning cost": learning_section(kept),
        "Figures": figure_section(drives, styles, missing),
        "Where the sideslip limit forbids the path": constraint_section(kept, drives, styles),
        **({"Failed cases": failure_section(failed)} if failed else {}),
        "Warnings": warning_section(kept),
        "Errata of the paper": errata_section(),
        "Settings and provenance": manifest_section(manifest, kept),
    }
    present = {title: content for title, content in sections.items() if content}
    contents = "".join(
        f'<a href="#s{number}">{html.escape(title)}</a>'
        for number, title in enumerate(present, start=1)
    )
    body = "\n".join(
        f'<section id="s{number}"><h2>{html.escape(title)}</h2>\n{content}\n</section>'
        for number, (title, content) in enumerate(present.items(), start=1)
    )
    return PAGE.substitute(
        title="Path tracking benchmark",
        subtitle=html.escape(subtitle(manifest)),
        contents=contents,
        body=body,
    )


def subtitle(manifest: Mapping[str, Any]) -> str:
    """When and from which revision, as far as the manifest tells."""
    parts = ["LPV-NMPC after kumar2025lpv and other agents on lpv-track-env"]
    if written := manifest.get("written"):
        parts.append(str(written))
    revision = manifest.get("revision")
    if isinstance(revision, Mapping) and revision.get("commit"):
        modified = ", with changes" if revision.get("modified") else ""
        parts.append(f"revision {str(revision['commit'])[:12]}{modified}")
    return " · ".join(parts)


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of escaped text."""
    return f'<p class="{kind}">{html.escape(text)}</p>' if kind else f"<p>{html.escape(text)}</p>"


def drives_of(cases: Iterable[Result], store: ResultStore) -> tuple[list[Drive], list[Result]]:
    """What can be drawn: of each agent, setting and trajectory the first seed; and what lacks."""
    drives: dict[tuple[str, str, str], Drive] = {}
    missing: list[Result] = []
    for case in cases:
        label, path = tables.label_of(case), str(case.get("trajectory"))
        key = tables.setting_of(case), path, label
        if case.get("status") != "ok" or key in drives:
            continue
        trace = store.trace(str(case["id"]))
        if trace is None or not figures.usable(trace):
            missing.append(case)
            continue
        drives[key] = Drive(label, path, case, trace)
    return list(drives.values()), missing


def _settings(drives: Iterable[Drive]) -> dict[str, list[Drive]]:
    groups: dict[str, list[Drive]] = {}
    for drive in drives:
        groups.setdefault(tables.setting_of(drive.case), []).append(drive)
    return groups


# Summary


def summary(cases: Sequence[Result], superseded: int) -> str:
    """What was run, and key figures of each agent."""
    done = [case for case in cases if case.get("status") == "ok"]
    finished = sum(case.get("end") == "finished" for case in done)
    late = [case for case in done if _too_slow(case)]
    tiles = {
        "cases": f"{len(cases)}",
        "drove the whole path": f"{finished} of {len(cases)}",
        "failed": f"{len(cases) - len(done)}",
        "agents": f"{len({tables.label_of(case) for case in cases})}",
        "trajectories": f"{len({str(case.get('trajectory')) for case in cases})}",
        "seeds": f"{len({case.get('seed') for case in cases})}",
        "p99 of predict over the control period": f"{len(late)} of {len(done)}",
        "time driven": f"{sum(case['metrics'].get('duration', 0.0) for case in done) / 60:.0f} min",
        "computing time": f"{sum(case.get('seconds') or 0.0 for case in cases) / 60:.1f} min",
    }
    parts = [
        '<dl class="tiles">'
        + "".join(
            f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>"
            for name, value in tiles.items()
        )
        + "</dl>"
    ]
    if superseded:
        parts.append(
            paragraph(
                f"Left out: {superseded} older result{'s' * (superseded > 1)} of cases that were "
                "run again from other sources."
            )
        )
    for setting, group in tables.cases_by_setting(cases).items():
        parts.append(f"<h3>{html.escape(setting)}</h3>")
        parts.append(key_figures(group))
    parts.append(
        paragraph(
            "ALE and MLE over the trajectories of the setting, of all runs that did not fail; an "
            "episode that ended early counts for the part it drove. “ALE against published” "
            "is the mean over T1 to T6 of ours divided by the published value of the same kind.",
            "soft",
        )
    )
    return "\n".join(parts)


def _too_slow(case: Result) -> bool:
    return bool(case["solver"].get("p99", 0.0) > case.get("control_period", np.inf))


def key_figures(cases: Sequence[Result]) -> str:
    """Table of one setting: an agent a line, over all its trajectories and seeds."""
    lines = []
    for label in tables.labels(cases):
        group = [case for case in cases if tables.label_of(case) == label]
        done = [case for case in group if case.get("status") == "ok"]
        finished = sum(case.get("end") == "finished" for case in group)
        line = [label, f"{finished} of {len(group)}"]
        if not done:
            lines.append([*line, *["–"] * 7])
            continue
        metrics = [case["metrics"] for case in done]
        worst = max(done, key=lambda case: case["metrics"]["mle"])
        kept = sum(not tables.violated(one) for one in metrics)
        medians = [case["solver"]["median"] for case in done]
        lines.append(
            [
                *line,
                f"{np.mean([one['ale'] for one in metrics]):.3f}",
                f"{worst['metrics']['mle']:.3f} ({worst.get('trajectory')})",
                f"{np.mean([one['aoe'] for one in metrics]):.3f}",
                _against_published(done),
                f"{1e3 * np.median(medians):.2f}",
                f"{1e3 * max(case['solver']['p99'] for case in done):.2f}",
                f"{kept} of {len(done)}",
            ]
        )
    headings = (
        "agent", "whole path", "mean ALE, m", "worst MLE, m (path)", "mean AOE, rad",
        "ALE against published", "median predict, ms", "worst p99, ms", "all constraints kept",
    )  # fmt: skip
    return html_table(headings, lines, range(1, 9))


def _against_published(cases: Iterable[Result]) -> str:
    shares = [
        case["metrics"]["ale"] / row["ale"]
        for case in cases
        if case.get("trajectory") in published.SIMULATION
        and (row := published.row(str(case["trajectory"]), case.get("conditions", "simulation")))
        is not None
    ]
    return f"{100 * np.mean(shares):.0f} %" if shares else "–"


# Tables and figures


def comparison(cases: Sequence[Result]) -> str:
    """The tables of every setting."""
    parts = [
        paragraph(
            f"{tables.PUBLISHED_NOTE} Max CTE and MLE, by formula the same, use the foot point on "
            "the path. Several seeds (×n): mean ± 95 % interval by the t-distribution."
        )
    ]
    if any(case.get("training") for case in cases):
        parts.append(paragraph(TRAINED_NOTE))
    for setting, text in html_tables(cases).items():
        parts.append(f"<h3>{html.escape(setting)}</h3>\n{text}")
    return "\n".join(parts)


def legend(styles: Styles, labels: Iterable[str]) -> str:
    """Agents with their lines."""
    dashes = {"solid": "", "dashed": "6 3", "dotted": "1.5 2.5", "dashdot": "6 2.5 1.5 2.5"}
    return (
        '<ul class="legend">'
        + "".join(
            f'<li><svg viewBox="0 0 30 10" aria-hidden="true"><line x1="1" y1="5" x2="29" y2="5" '
            f'stroke="{styles[label].colour}" stroke-width="2.5" '
            f'stroke-dasharray="{dashes[styles[label].dashes]}"/></svg>{html.escape(label)}</li>'
            for label in styles
            if label in set(labels)
        )
        + "</ul>"
    )


def panel_grid(panels: Iterable[Panel], what: str) -> str:
    """Panels beside each other as the page's width allows."""
    return (
        '<div class="panels">\n'
        + "\n".join(
            f'<figure role="img" aria-label="{html.escape(f"{what}: {panel.title}")}">'
            f"<figcaption>{html.escape(panel.title)}</figcaption>{panel.svg}</figure>"
            for panel in panels
        )
        + "\n</div>"
    )


def figure_section(drives: Sequence[Drive], styles: Styles, missing: Sequence[Result]) -> str:
    """All figures, setting by setting."""
    parts = []
    if any(drive.case.get("seed") for drive in drives):
        parts.append(paragraph("Of several seeds the first is drawn."))
    if missing:
        names = ", ".join(
            f"{tables.label_of(case)} on {case.get('trajectory')} (seed {case.get('seed')})"
            for case in missing
        )
        parts.append(paragraph(f"Not drawn, for want of a readable trace: {names}.", "bad"))
    for number, (setting, group) in enumerate(_settings(drives).items()):
        parts.append(f"<h3>{html.escape(setting)}</h3>")
        shown = legend(styles, {drive.label for drive in group})
        if len({drive.trajectory for drive in group}) == 1:
            parts.append(shown + _one_grid(group, styles, f"f{number}"))
            continue
        for heading, caption, draw in FIGURES:
            parts.append(f"<h4>{html.escape(heading)}</h4>")
            parts.append(paragraph(caption, "soft") + shown)
            parts.append(panel_grid(draw(group, styles, f"f{number}"), heading))
    return "\n".join(parts)


def _one_grid(group: Sequence[Drive], styles: Styles, salt: str) -> str:
    """All figures of a setting with a single trajectory beside each other."""
    panels = [
        Panel(f"{heading}, {panel.title}", panel.svg)
        for heading, _, draw in FIGURES
        for panel in draw(group, styles, salt)
    ]
    captions = " ".join(f"{heading}: {caption}" for heading, caption, _ in FIGURES)
    return panel_grid(panels, "Figure") + paragraph(captions, "soft")


def constraint_section(cases: Sequence[Result], drives: Sequence[Drive], styles: Styles) -> str:
    """Where |vy| <= 0.17 vx stops a vehicle from following the path, and what that costs."""
    parts = [
        paragraph(
            "The paper bounds |vy| by 0.17 vx at the centre of gravity. In a steady turn vy/vx is "
            "κ (lr − m lf v² / (L Car)), at low speed about lr κ: the bound is a limit on the "
            "curvature that may be driven, whatever the speed. On sharper bends a controller that "
            "keeps it must leave the path, and one that follows the path must break it. The "
            "published errors (MLE 0.7 to 1.6 m, MOE 0.3 to 0.6 rad) look like that limit at work."
        )
    ]
    lines = [
        [str(name), f"{limit:.2f}", f"{limit / lever:.3f}"] for name, limit, lever in _limits(cases)
    ]
    if lines:
        parts.append(
            html_table(
                ("vehicle", "limit on |vy|/vx", "curvature limit at low speed, 1/m"), lines, (1, 2)
            )
        )
    reached = [case for case in cases if figures.reaches_sideslip_limit(case)]
    if not reached:
        parts.append(paragraph("No case broke the limit or needed slack on it."))
        return "\n".join(parts)
    parts.append(
        paragraph(
            "Cases that broke it, or whose plans needed slack on it. “Needed” is the share "
            "of the path's length whose curvature asks for more than the limit at the path's own "
            "speed; “at the limit” is the length driven at 99 % of it or more."
        )
    )
    by_id = {drive.case["id"]: drive for drive in drives}
    parts.append(_limit_table(reached, by_id))
    drawn = [by_id[case["id"]] for case in reached if case["id"] in by_id]
    for number, (setting, group) in enumerate(_settings(drawn).items()):
        parts.append(f"<h3>{html.escape(setting)}</h3>")
        parts.append(
            paragraph(
                "Above: |vy|/vx driven, its limit (dashed), what the path needs (grey), and where "
                "that is over the limit (shaded). Below: the path, red where the limit is reached.",
                "soft",
            )
        )
        parts.append(legend(styles, {drive.label for drive in group}))
        panels = figures.sideslip_limit(group, styles, f"c{number}")
        parts.append(panel_grid(panels, "Sideslip limit"))
    return "\n".join(parts)


def _limits(cases: Iterable[Result]) -> list[tuple[str, float, float]]:
    """Name, limit on |vy|/vx and lr of every vehicle that still loads."""
    found: dict[tuple[str, float, float], None] = {}
    for case in cases:
        car = figures.plant(case)
        if car is not None:
            key = str(case.get("vehicle")), car.max_lateral_velocity_ratio, car.rear_axle_distance
            found[key] = None
    return sorted(found)


def _limit_table(cases: Iterable[Result], drives: Mapping[Any, Drive]) -> str:
    lines = []
    for case in cases:
        metrics, slack = case["metrics"], case["solver"].get("slack")
        drive = drives.get(case["id"])
        lines.append(
            [
                tables.setting_of(case),
                str(case.get("trajectory")),
                tables.label_of(case),
                str(case.get("seed")),
                f"{metrics.get('excess_lateral_velocity', 0.0):.3f}",
                f"{100 * metrics.get('violated_lateral_velocity', 0.0):.1f}",
                f"{slack[1]:.3f}" if slack else "–",
                *(_limit_lengths(drive) if drive else ("–", "–")),
                f"{metrics['mle']:.3f}",
            ]
        )
    headings = (
        "setting", "path", "agent", "seed", "largest excess, m/s", "periods over, %",
        "largest slack, m/s", "needed, %", "at the limit, m", "MLE, m",
    )  # fmt: skip
    return html_table(headings, lines, range(3, 10))


def _limit_lengths(drive: Drive) -> tuple[str, str]:
    car, needed = figures.plant(drive.case), figures.required_sideslip(drive)
    if car is None:
        return "–", "–"
    limit = car.max_lateral_velocity_ratio
    share = "–" if needed is None else f"{100 * np.mean(needed[1] > limit):.1f}"
    steps = np.hypot(*np.diff(drive.trace["state"][:, 4:6], axis=0).T)
    at_limit = figures.sideslip(drive.trace)[1:] >= figures.AT_LIMIT * limit
    return share, f"{steps[at_limit].sum():.1f}"


# What went wrong, errata, provenance


def failure_section(cases: Iterable[Result]) -> str:
    """Cases that ended in an error instead of an episode."""
    lines = [
        [
            str(case["id"]), tables.label_of(case), str(case.get("trajectory")),
            tables.setting_of(case), str(case.get("seed")), str(case.get("error", "no message")),
        ]
        for case in cases
    ]  # fmt: skip
    return html_table(("id", "agent", "path", "setting", "seed", "error"), lines)


def warning_section(cases: Iterable[Result]) -> str:
    """Each different warning once, with the number of cases that gave it."""
    counts = Counter(text for case in cases for text in case.get("warnings") or [])
    if not counts:
        return ""
    lines = [[text, str(count)] for text, count in sorted(counts.items())]
    return html_table(("warning", "cases"), lines, (1,))


def errata_section() -> str:
    """Readings that matter when our numbers are held against the paper's."""
    items = "".join(f"<li>{html.escape(text)}</li>" for text in ERRATA)
    return f"<ol>{items}</ol>"


def manifest_section(manifest: Mapping[str, Any], cases: Sequence[Result]) -> str:
    """Command, settings, revision, versions, hardware, seeds."""
    parts = []
    command = manifest.get("command")
    if isinstance(command, list):
        parts.append(f"<pre>{html.escape(' '.join(map(str, command)))}</pre>")
    seeds = sorted({case.get("seed", 0) for case in cases})
    lines = [["seeds", ", ".join(map(str, seeds))]]
    if manifest:
        lines += [
            [key, value] for key, value in _flat({**manifest, "command": None}) if value != "None"
        ]
    else:
        parts.append(paragraph("The folder has no readable manifest.json.", "bad"))
    parts.append(html_table(("entry", "value"), lines))
    return "\n".join(parts)


def _flat(value: Any, name: str = "") -> list[tuple[str, str]]:
    """Leaves of nested mappings with their dotted names; lists in one line."""
    if isinstance(value, Mapping):
        return [
            leaf
            for key in sorted(value, key=str)
            for leaf in _flat(value[key], f"{name}.{key}" if name else str(key))
        ]
    if isinstance(value, list):
        return [(name, ", ".join(map(str, value)))]
    return [(name, str(value))]
