"""The table of physical limits: its cases, its file, and the limit of a case."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from experiments.run.provenance import command_line, provenance
from trajectories import ReferencePath
from trajectories.fileio import checked, read_json, write_atomically

SHIPPED = Path(__file__).parents[1] / "limits" / "data" / "limits.json"
FORMAT = "lpv-track-limits/1"
CORRIDOR = 0.5
"""Half width of the corridor of a lap, m."""
BEYOND = 0.02
"""Share by which a speed or a lap time is better than the limit where no motion must be found."""


class LimitCase(msgspec.Struct, frozen=True, order=True):
    """A path, a vehicle and a friction.

    `corridor` (m) counts for laps only. `kept` counts for lane changes only: the share of the entry
    speed that the vehicle must keep; 0 lets it brake as it likes.
    """

    path: str
    vehicle: str
    friction: float
    corridor: float = CORRIDOR
    kept: float = 0.0


class Limit(msgspec.Struct, frozen=True):
    """A limit, with what shows that it is one."""

    case: LimitCase
    kind: str
    """Either "entry speed" (m/s, the highest) or "lap time" (s, the least)."""
    value: float
    """The limit."""
    replayed: float
    """Distance from the cones, or largest lateral error, m, of the inputs found when the
    environment's integrator drives them anew."""
    beyond: float
    """Largest distance from the cones (negative: they are hit), or least corridor, m, at a speed or
    lap time that is `BEYOND` better than the limit: the best that was found from several starts."""
    starts: int
    """Number of these starts from which a local optimum was found."""
    nodes: int
    iterations: int
    seconds: float
    """Size and effort of the solve."""
    path_digest: str
    """Digest of the path's geometry."""

    @property
    def shown(self) -> bool:
        """True if the replay passes the test, and nothing that was found beyond the limit does."""
        if self.kind == "entry speed":
            return self.replayed >= 0.0 > self.beyond and self.starts > 0
        return self.replayed <= self.case.corridor < self.beyond and self.starts > 0


class Table(msgspec.Struct):
    """Content of the file."""

    format: str
    limits: list[Limit]


LANE_CHANGES = (
    LimitCase("iso-3888-1-1.61", "bmw-320i", 0.9),
    LimitCase("iso-3888-2-1.61", "bmw-320i", 0.9),
    LimitCase("iso-3888-1-2.0", "m2-minibus", 0.9),
    LimitCase("iso-3888-2-2.0", "m2-minibus", 0.9),
)
HELD = tuple(msgspec.structs.replace(case, kept=0.95) for case in LANE_CHANGES)
"""The same at almost constant speed."""
LAPS = tuple(LimitCase(f"circuit-{seed}", "bmw-320i", 0.9) for seed in range(3))
CASES = (*LANE_CHANGES, *HELD, *LAPS)
"""Cases of the shipped table."""


def digest(path: ReferencePath) -> str:
    """Return a digest of a path's geometry and its cones, to the micrometre."""
    columns = [path.x, path.y, path.curvature]
    content = [[round(float(value), 6) + 0.0 for value in column] for column in columns]
    text = json.dumps([content, path.metadata.get("cones")])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read(file: Path = SHIPPED) -> list[Limit]:
    """Read the limits of a file that `write` has written.

    Raises
    ------
    ValueError
        In one line, if the file cannot be read or is no such table.
    """
    table = checked(read_json(file), Table, file)
    if table.format != FORMAT:
        raise ValueError(f"{file}: format {table.format!r} is not known, only {FORMAT!r}")
    return table.limits


def write(limits: Iterable[Limit], file: Path) -> None:
    """Write limits and where they come from."""
    ordered = sorted(limits, key=lambda limit: (limit.kind, limit.case))
    content: dict[str, Any] = {
        "format": FORMAT, "command": command_line(), **provenance(),
        "limits": msgspec.to_builtins(ordered),
    }  # fmt: skip
    write_atomically(file, (json.dumps(content, indent=1) + "\n").encode())


@lru_cache(maxsize=1)
def _shipped() -> Sequence[Limit]:
    return read() if SHIPPED.is_file() else []


def limit_of(
    path: str, vehicle: str, friction: float, corridor: float = CORRIDOR, kept: float = 0.0
) -> float | None:
    """Return the shipped limit of a case: entry speed (m/s) or lap time (s); None if unknown.

    `corridor` (m) counts for laps only, `kept`, see `LimitCase`, for lane changes only.
    """
    for limit in _shipped():
        case = limit.case
        same = case.kept == kept if limit.kind == "entry speed" else case.corridor == corridor
        named = _same_path(case.path, path) and case.vehicle == vehicle
        if same and named and case.friction == friction:
            return limit.value
    return None


def _same_path(one: str, other: str) -> bool:
    """Compare names, in which a width may be written as 2 or 2.0."""
    return one.removesuffix(".0") == other.removesuffix(".0")
