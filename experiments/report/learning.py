"""Section on what learned policies cost, and the commands that make them."""

import html
from collections.abc import Iterable

from experiments.report.document import Document, joined, paragraph
from experiments.report.html_tables import html_table
from experiments.run.learning_table import trainings
from experiments.run.learning_words import UNKNOWN, duration
from experiments.run.tables import Result

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


def learning_section(document: Document, cases: Iterable[Result]) -> str:
    """What each learned policy cost, and the command that makes it; "" without any."""
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
    return joined(
        [
            paragraph(NOTE),
            document.table("What learning cost.", html_table(headings, lines, range(2, 5))),
            f'<pre tabindex="0">{html.escape(commands)}</pre>',
        ]
    )
