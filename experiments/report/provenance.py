"""Sections on the paper's errata, and on settings, revision, versions and hardware."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

from experiments.report.document import Document, joined, paragraph
from experiments.report.errata import ERRATA
from experiments.report.html_tables import html_table
from experiments.run.tables import Result

LONG = 24
"""Most entries of a list that are told."""


def errata_section() -> str:
    """Readings that matter when our numbers are held against the paper's."""
    items = "".join(f"<li>{html.escape(text)}</li>" for text in ERRATA)
    return f"<ol>{items}</ol>"


def manifest_section(
    document: Document, manifest: Mapping[str, Any], cases: Sequence[Result]
) -> str:
    """Command, settings, revision, versions, hardware, seeds."""
    parts = []
    command = manifest.get("command")
    if isinstance(command, list):
        parts.append(f'<pre tabindex="0">{html.escape(" ".join(map(str, command)))}</pre>')
    seeds = sorted({case.get("seed", 0) for case in cases})
    lines = [["seeds", ", ".join(map(str, seeds))]]
    if manifest:
        lines += [
            [key, value] for key, value in _flat({**manifest, "command": None}) if value != "None"
        ]
    else:
        parts.append(paragraph("The folder has no readable manifest.json.", "bad"))
    parts.append(
        document.table("The manifest.", html_table(("entry", "value"), lines, wrapped=(1,)))
    )
    return joined(parts)


def _flat(value: Any, name: str = "") -> list[tuple[str, str]]:
    """Leaves of nested mappings with their dotted names; lists in one line."""
    if isinstance(value, Mapping):
        return [
            leaf
            for key in sorted(value, key=str)
            for leaf in _flat(value[key], f"{name}.{key}" if name else str(key))
        ]
    if isinstance(value, list):
        words = ", ".join(map(str, value[:LONG]))
        more = f" … ({len(value)} in manifest.json)" if len(value) > LONG else ""
        return [(name, words + more)]
    return [(name, str(value))]
