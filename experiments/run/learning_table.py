"""What learning cost, agent by agent: the list, and lines for a terminal."""

from collections.abc import Iterable
from typing import Any

from rich.text import Text

from experiments.run.learning_words import words
from experiments.run.tables import Result, label_of, labels


def trainings(cases: Iterable[Result]) -> list[tuple[str, dict[str, Any]]]:
    """Label and training of every learned policy, each different one once, in the tables' order."""
    cases = list(cases)
    found: dict[str, list[dict[str, Any]]] = {}
    for case in cases:
        told = found.setdefault(label_of(case), [])
        if (training := case.get("training")) and training not in told:
            told.append(dict(training))
    return [(label, training) for label in labels(cases) for training in found[label]]


def console_learning(cases: Iterable[Result]) -> list[Text]:
    """One line for each learned policy."""
    return [
        Text(f"trained: {label}: {training.get('algorithm', '?')}, {words(training)}")
        for label, training in trainings(cases)
    ]
