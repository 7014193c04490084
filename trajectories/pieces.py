"""Choose among the pieces of a file that holds several: tracks, lines, roads, lanes, lanelets.

The option `part` names one piece, or a route of several with commas between them, as in
`12,7,-9`: a minus sign drives a piece from its end to its start.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from trajectories.arguments import shortened, shown
from trajectories.raw_path import RawPath
from trajectories.text_table import MOST_ROWS

Array = NDArray[np.float64]

MEETS = 0.5
"""m: ends of pieces of a road map that are further apart do not meet."""
NAMES_SHOWN = 12


@dataclass(frozen=True)
class Piece:
    """Points of one track, road or lanelet: columns (n,) as in `RawPath`, and their places."""

    columns: Mapping[str, Array]
    places: Sequence[str]
    closed: bool | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def backwards(self) -> "Piece":
        """Return the piece from its end to its start; left is right then, times are left out."""
        swapped = {"width_left": "width_right", "width_right": "width_left"}
        columns = {
            swapped.get(key, key): values[::-1]
            for key, values in self.columns.items()
            if key != "time"
        }
        return replace(self, columns=columns, places=self.places[::-1])

    def end(self, index: int) -> Array:
        """Return x, y of the first (0) or last (-1) point, m."""
        return np.array([self.columns["x"][index], self.columns["y"][index]])


@dataclass(frozen=True)
class Pieces:
    """A file of several pieces.

    Parameters
    ----------
    file, kind
        File, and kind of its path in words, such as "OpenDRIVE road".
    noun
        A piece in a word, such as "road".
    names
        Names of the pieces, in the order of the file.
    longest
        Name or names of what is driven without `part`, in its form.
    read
        Function that returns a piece by its name.
    metadata
        Plain JSON values for the path's metadata.
    """

    file: Path
    kind: str
    noun: str
    names: Sequence[str]
    longest: str
    read: Callable[[str], Piece]
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def path(self, part: str | None) -> RawPath:
        """Return the points of the pieces that `part` names; None takes the longest.

        What was taken, of how many, is in `metadata["part"]`.

        Raises
        ------
        ValueError
            In one line that begins with the file's name, for a name that is not there, or for
            roads or lanelets whose ends do not meet.
        """
        taken = self.longest if part is None else part
        steps = [step.strip() for step in taken.split(",")]
        pieces, points = [], 0
        for step in steps:
            pieces.append(piece := self._step(step))
            points += len(piece.places)
            if points > MOST_ROWS:
                self.fail(f"more than {MOST_ROWS} points are not read")
            if not all(np.isfinite(values).all() for values in piece.columns.values()):
                self.fail(f"{self.noun} {shortened(step, 40)} has numbers that are too large")
        joined = pieces[0] if len(pieces) == 1 else self._joined(steps, pieces)
        metadata = {**self.metadata, **joined.metadata}
        if len(self.names) > 1 or part is not None:
            plural = "s" if len(steps) > 1 else ""
            of = " of" if part is not None else ", the longest of"
            more = "" if part is not None else " (the option part names others)"
            metadata["part"] = (
                f"{self.noun}{plural} {shortened(taken, 60)}{of} {len(self.names)}{more}"
            )
        return RawPath(
            self.kind, str(self.file), self.file.stem, joined.columns, joined.places,
            joined.closed, metadata,
        )  # fmt: skip

    def fail(self, message: str) -> NoReturn:
        """Raise a ValueError that begins with the file's name."""
        raise ValueError(f"{shortened(self.file)}: {message}")

    def unknown(self, name: str) -> NoReturn:
        """Refuse a name, and say which there are."""
        known = ", ".join(shortened(known, 20) for known in self.names[:NAMES_SHOWN])
        more = f", ... ({len(self.names)})" if len(self.names) > NAMES_SHOWN else ""
        self.fail(f"has no {self.noun} {shown(name)}: it has {known}{more}")

    def _step(self, step: str) -> Piece:
        if step.startswith("-") and step not in self.names:
            return self.read(step[1:].strip()).backwards()
        return self.read(step)

    def _joined(self, steps: Sequence[str], pieces: Sequence[Piece]) -> Piece:
        """Put pieces one after the other; where two meet, one point is left out."""
        common = set.intersection(*(set(piece.columns) for piece in pieces)) - {"time"}
        skipped = [0] * len(pieces)
        for k in range(1, len(pieces) if "x" in common else 0):
            before, after = pieces[k - 1], pieces[k]
            gap = float(np.hypot(*(after.end(0) - before.end(-1))))
            skipped[k] = 1
            if gap > MEETS:
                turned = float(np.hypot(*(after.end(-1) - before.end(-1))))
                name = shortened(steps[k], 40)
                other = name.removeprefix("-") if name.startswith("-") else f"-{name}"
                hint = f": write {other} to drive it the other way" if turned <= MEETS else ""
                self.fail(
                    f"{self.noun} {name} begins {gap:.4g} m from the end of "
                    f"{shortened(steps[k - 1], 40)}, more than {MEETS:g} m{hint}"
                )
        columns = {
            key: np.concatenate(
                [piece.columns[key][skip:] for piece, skip in zip(pieces, skipped, strict=True)]
            )
            for key in pieces[0].columns
            if key in common
        }
        places = [
            f"{self.noun} {step}, {place}"
            for step, piece, skip in zip(steps, pieces, skipped, strict=True)
            for place in piece.places[skip:]
        ]
        return Piece(columns, places)
