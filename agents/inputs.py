"""Inputs of `predict`, checked and brought into the form that all agents work with.

Observations saturate at the bounds of their layout (`lpv_track_env.observation`), at which those of
the environments saturate, too. Absurd numbers, such as 1e300 from a faulty sensor, thus reach no
arithmetic that would overflow. NaN and infinity stay: they mark an observation as blind.
"""

import math
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from lpv_track_env.observation import PREVIEW_BOUNDS, PREVIEW_START, SCALARS
from trajectories.arguments import shown
from trajectories.compilation import compiled, compiled_internal


class BatchMemory(Protocol):
    """Memory of a batch of rows."""

    @property
    def shape(self) -> tuple[Any, ...]:
        """Sizes of the arrays, without the number of rows."""
        ...

    def __len__(self) -> int: ...


Memory = TypeVar("Memory", bound=BatchMemory)

NUMBERS, MARKS = "fiu", "biuf"
"""Kinds of NumPy types that observations and `episode_start` may have."""

# In the precision of the environments' observations, so that theirs never change.
BOUNDS = tuple(float(np.float32(bound)) for _, _, bound in SCALARS)
CURVATURE_BOUND, SPEED_BOUND = (float(np.float32(bound)) for _, _, bound in PREVIEW_BOUNDS)


@compiled_internal
def limited(value: Any, bound: Any) -> Any:
    """Return a value saturated at -bound and bound, unless it is not finite."""
    if math.isnan(value):  # of any kind: the signalling ones would warn later on
        return math.nan
    return math.copysign(bound, value) if bound < abs(value) < math.inf else value


@compiled_internal
def saturate_row(row: Any) -> None:
    """Saturate the finite entries of an observation (size,) at their bounds, in place."""
    speeds = PREVIEW_START + (row.shape[0] - PREVIEW_START) // 2
    for k in range(PREVIEW_START):
        row[k] = limited(row[k], BOUNDS[k])
    for k in range(PREVIEW_START, speeds):
        row[k] = limited(row[k], CURVATURE_BOUND)
    for k in range(speeds, row.shape[0]):
        row[k] = limited(row[k], SPEED_BOUND)


@compiled
def saturate_rows(rows: Any) -> None:
    """`saturate_row` for rows (n, size)."""
    for row in range(rows.shape[0]):
        saturate_row(rows[row])


def observation_rows(observation: Any, size: int) -> NDArray[np.float64]:
    """Copy one observation (size,) or a batch (n, size) into rows (n, size) float64, saturated.

    Raises
    ------
    ValueError
        If the observation has another size, or does not consist of real numbers.
    """
    if type(observation) is not np.ndarray or observation.dtype.kind not in NUMBERS:
        observation = _array("observation", observation, NUMBERS)
    rows = np.array(observation, dtype=np.float64, order="C")
    if rows.ndim == 1:
        rows = rows.reshape(1, -1)
    if rows.ndim != 2 or rows.shape[1] != size:
        raise ValueError(
            f"observation has shape {np.shape(observation)}, this layout has {size} "
            "entries, alone or in rows: make the agent for this environment"
        )
    saturate_rows(rows)
    return rows


def started_rows(episode_start: Any, rows: int) -> list[int]:
    """Return the rows that `episode_start` marks: one value for all rows, or one for each.

    Truth values may also be 0 and 1 of any type of number, such as float32 in replay buffers.

    Raises
    ------
    ValueError
        If it has another shape, or does not consist of truth values.
    """
    if episode_start is None:
        return []
    marks = episode_start
    if type(marks) is not np.ndarray or marks.dtype.kind not in MARKS:
        marks = _array("episode_start", marks, MARKS)
    if marks.dtype.kind == "f" and not ((marks == 0.0) | (marks == 1.0)).all():
        raise ValueError(f"episode_start must be truth values, or 0 and 1, not {shown(marks)}")
    if marks.size == 1:  # several times as fast as any()
        return list(range(rows)) if marks.item() else []
    if marks.shape != (rows,):
        raise ValueError(
            f"episode_start has shape {marks.shape}: give one truth value for each of {rows} rows"
        )
    started: list[int] = marks.nonzero()[0].tolist()
    return started


def memory_of(
    state: Any, kept: Memory | None, rows: int, blank: Memory, new: Callable[[int], Memory]
) -> Memory:
    """Return the memory of a batch of rows: `state` if there is one, else the one `kept`.

    A missing memory, or one of another number of rows, is replaced by a `new` one.

    Raises
    ------
    TypeError
        If `state` is not a memory like `blank`, one that this agent has made.
    """
    if state is None:
        state = kept
    elif type(state) is not type(blank) or state.shape != blank.shape:
        raise foreign(state)
    return new(rows) if state is None or len(state) != rows else state


def foreign(state: object) -> TypeError:
    """Return the error for a `state` that this agent has not made."""
    return TypeError(
        f"state is not this agent's memory but {type(state).__name__}: give what its last predict "
        "returned, or None"
    )


def _array(name: str, value: object, kinds: str) -> NDArray[Any]:
    """Convert a value to an array of one of some kinds of numbers."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:  # torch raises its own kinds
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{name} is not an array of numbers: {reason}") from None
    if array.dtype.kind not in kinds:
        raise ValueError(
            f"{name} must be an array of numbers, not {type(value).__name__} of {array.dtype}"
        )
    return array
