"""Hand-made results, result folders, and the report and table of them."""

from html.parser import HTMLParser

import html5lib
import numpy as np
from rich.console import Console

from experiments.report.build import write_report
from experiments.report.page import asset
from experiments.run.console_tables import all_tables
from experiments.run.store import ResultStore

METRICS = {
    "max_cte": 0.2, "mean_cte": 0.05, "mle": 0.2, "ale": 0.08, "moe": 0.1, "aoe": 0.03,
    "mean_abs_lateral_error": 0.05, "steering_variation": 3.0, "acceleration_variation": 40.0,
    "excess_speed": 0.0, "violated_speed": 0.0, "excess_jerk": 3e-7, "violated_jerk": 0.0,
    "excess_lateral_velocity": 0.0, "violated_lateral_velocity": 0.0, "duration": 60.0,
}  # fmt: skip
SOLVER = {"median": 0.002, "p99": 0.004, "max": 0.01, "failures": 0, "solves": 0, "slack": None}
HOSTILE = "<script>alert('x')</script> & $10^{-1}$"


def case(number, agent="stanley", trajectory="T2", metrics=(), solver=(), **more):
    ok = more.get("status", "ok") == "ok"
    return {
        "id": f"{number:016x}", "agent": agent, "trajectory": trajectory, "vehicle": "m2-minibus",
        "conditions": "simulation", "seed": 0, "speed_mode": "variable", "fixed_speed": None,
        "control_period": 0.05, "vehicle_changes": {}, "agent_settings": {}, "env_settings": {},
        "status": "ok", "end": "finished", "metrics": {**METRICS, **dict(metrics)} if ok else {},
        "solver": {**SOLVER, **dict(solver)} if ok else {}, "warnings": [], "seconds": 1.5, **more,
    }  # fmt: skip


def trace(n=1200, seed=0, noise=0.0, slip=0.05):
    """Return the trace of a drive that weaves along X, with noise if wanted."""
    rng = np.random.default_rng(seed)
    time = 0.05 * np.arange(n)
    rough = noise * rng.normal(size=(4, n))
    lateral = 0.1 * np.sin(time) + rough[0]
    heading = 0.05 * np.cos(time) + rough[1]
    x = 5.0 * time
    state = np.column_stack([np.full(n, 5.0), np.full(n, 5.0 * slip), heading, 0 * x, x, lateral])
    return {
        "time": time, "state": state, "arc_length": x, "lateral_error": lateral,
        "heading_error": heading, "reference_speed": np.full(n, 5.0),
        "acceleration": 0.2 + rough[2], "steering_angle": 0.1 * np.sin(time) + rough[3],
        "solve_time": np.abs(0.002 + 0.001 * rng.normal(size=n)), "reward": np.zeros(n),
        "clipped": np.zeros(n),
    }  # fmt: skip


def folder_of(folder, results, traces=True):
    store = ResultStore(folder)
    for number, result in enumerate(results):
        drawn = traces and result["status"] == "ok"
        store.append({**result, "trace": trace(seed=number)} if drawn else result)
    return store


def page(folder):
    return write_report(folder).read_text(encoding="utf-8")


def own_scripts_alone(text):
    """Return whether a page has no scripts but its own files and one block of data.

    The parser is strict: it raises for invalid HTML.
    """
    parser = html5lib.HTMLParser(strict=True, namespaceHTMLElements=False)
    scripts = list(parser.parse(text).iter("script"))
    codes = [one.text for one in scripts if one.get("type") != "application/json"]
    data = [one for one in scripts if one.get("type") == "application/json"]
    own = [f"\n{asset(name)}" for name in ("page.js", "replay.js")]
    return codes in (own, own[:1]) and len(data) <= 1


class Outline(HTMLParser):
    """Checks that tags are balanced and collects ids, hrefs, tags and text."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.links, self.tags, self.words = [], [], [], set(), []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        for key, value in attributes:
            if key == "id":
                self.ids.append(value)
            if key in {"href", "src", "xlink:href", "action"}:
                self.links.append(value)
            assert not key.startswith("on")
        if tag not in {"meta", "br", "link"}:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def printed(results, width=120):
    console = Console(width=width, record=True, color_system=None, file=None, quiet=False)
    with console.capture() as captured:
        console.print(all_tables(results))
    return captured.get()
