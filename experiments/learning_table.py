"""What learning cost, agent by agent: a section of the report, lines for a terminal."""

import html
from collections.abc import Iterable
from typing import Any

from rich.text import Text

from experiments.html_tables import html_table
from experiments.learning_words import UNKNOWN, duration, words
from experiments.tables import Result, label_of, labels

NOTE = (
    "Environment steps, wall time with validation on the machine that trained, and NMPC solves for "
    "demonstrations or for the base of a residual: of the whole training, though what drives is "
    "its checkpoint that was best on the validation paths, and of the one that it started from "
    "(--from), if any. Agents that are not listed were designed by hand; what that took was not "
    "recorded."
)
TRAINED_NOTE = (
    "Trained: environment steps, wall time and NMPC solves that learning took; “–” for agents "
    "designed by hand, whose cost nobody recorded."
)


def trainings(cases: Iterable[Result]) -> list[tuple[str, dict[str, Any]]]:
    """Label and training of every learned policy, each different one once, in the tables' order."""
    cases = list(cases)
    found: dict[str, list[dict[str, Any]]] = {}
    for case in cases:
        told = found.setdefault(label_of(case), [])
        if (training := case.get("training")) and training not in told:
            told.append(dict(training))
    return [(label, training) for label in labels(cases) for training in found[label]]


def learning_section(cases: Iterable[Result]) -> str:
    """HTML: what each learned policy cost, and the command that makes it; "" without any."""
    found = trainings(cases)
    if not found:
        return ""
    lines = [
        [
            label,
            str(training.get("algorithm", UNKNOWN)),
            f"{training['steps']:,}" if "steps" in training else UNKNOWN,
            duration(training["seconds"]) if "seconds" in training else UNKNOWN,
            f"{training['solves']:,}" if "solves" in training else UNKNOWN,
        ]
        for label, training in found
    ]
    headings = ("agent", "algorithm", "steps", "wall time", "NMPC solves")
    commands = "\n".join(
        f"# {label}\n{training.get('command', f'# {UNKNOWN}')}" for label, training in found
    )
    return (
        f"<p>{html.escape(NOTE)}</p>\n{html_table(headings, lines, range(2, 5))}\n"
        f"<pre>{html.escape(commands)}</pre>"
    )


def console_learning(cases: Iterable[Result]) -> list[Text]:
    """One line for each learned policy."""
    return [
        Text(f"trained: {label}: {training.get('algorithm', '?')}, {words(training)}")
        for label, training in trainings(cases)
    ]
