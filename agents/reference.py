"""Reference ahead, reconstructed from an observation.

The preview holds mean curvatures and end speeds over intervals of the reference's own time grid
(`lpv_track_env.observation`). Integrating them gives the path ahead without access to it, in the
frame with its origin at the foot point, the x axis along the path's tangent there and the y axis to
the left. In this frame the vehicle is at (0, lateral_error) with heading heading_error.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.speed_cap import SHARE, cap_speeds, capped_interval
from lpv_track_env import observation as entry
from lpv_track_env.observation import TrackingObservation
from trajectories.compilation import compiled, compiled_internal

Array = NDArray[Any]

# Columns of a node in compiled code, beginning with the NMPC's outputs in their order.
NODE_SPEED, NODE_HEADING, NODE_X, NODE_Y, NODE_ARC_LENGTH = range(5)
NODE = 5
"""Number of columns of a node."""
LEAD = 0.3
"""Speed by which nodes are faster than a slow vehicle that they lead, m/s."""
NEAR_PATH = 0.5
"""Lateral error, m, up to which a predictive controller heads for the path itself."""
APPROACH_SLOPE = 0.4
"""Largest tangent of the angle to the path at which a vehicle far from it approaches."""
APPROACH_TIME, SHORTEST_APPROACH = 0.5, 2.0
"""Least length over which the offset of an approach decays: time at the vehicle's speed, s; m."""


class LocalReference(NamedTuple):
    """Reference at n + 1 nodes, by default a preview period apart; node 0 is the foot point.

    Each field has the shape (..., n + 1), with the batch dimensions of the observation in front.
    """

    arc_length: Array
    """Distance from the foot point along the path, m."""
    x: Array
    """Position along the path's tangent at the foot point, m."""
    y: Array
    """Position to the left of that tangent, m."""
    heading: Array
    """Heading relative to that at the foot point, rad; not wrapped."""
    speed: Array
    """Speed along the path, m/s."""


class LocalPoint(NamedTuple):
    """Point of the reference in the frame of the foot point: m, m, rad."""

    x: float
    y: float
    heading: float


def local_reference(
    observation: TrackingObservation,
    period: float,
    lengths: Array | None = None,
    *,
    leading: float | None = None,
    grip: float = math.inf,
    braking: float = math.inf,
) -> LocalReference:
    """Reconstruct nodes of the reference from the preview of an observation.

    Each interval has constant acceleration, so its length is the mean of its end speeds times the
    period; and constant curvature, so it is an arc: the chord is length * sinc(turn / 2) long and
    has the interval's mean heading. The result is exact for a path of such intervals.

    Parameters
    ----------
    observation
        Scalars shaped (...), previews (..., K).
    period
        Spacing of the preview in the reference's time, s (`ObservationLayout.preview_period`).
    lengths
        Time from each node to the next, (n,) s; by default the preview's K periods.
    leading
        Largest acceleration, m/s^2, of the vehicle; with it the nodes lead a vehicle far from its
        reference, as `fill_leading_nodes` does.
    grip, braking
        Largest total acceleration and deceleration, m/s^2, with `leading`: the nodes are no faster
        than they allow, see `cap_speeds`.
    """
    curvature = np.asarray(observation.preview_curvature, dtype=np.float64)
    rows = curvature.reshape(-1, curvature.shape[-1])
    first = np.asarray(observation.reference_speed, dtype=np.float64).reshape(-1)
    speed = np.asarray(observation.preview_speed, dtype=np.float64).reshape(rows.shape)
    lengths = np.full(rows.shape[1], period) if lengths is None else lengths
    nodes = np.empty((rows.shape[0], len(lengths) + 1, NODE))
    if leading is None:
        _fill_rows(rows, first, speed, period, lengths, nodes)
    else:
        vx, heading, error = (
            np.asarray(values, dtype=np.float64).reshape(-1)
            for values in (
                observation.longitudinal_speed, observation.heading_error,
                observation.lateral_error,
            )
        )  # fmt: skip
        _lead_rows(
            rows, first, speed, period, lengths, vx, heading, error, leading, grip, braking,
            np.empty(rows.shape[1] + 1), nodes,
        )  # fmt: skip
    shaped = nodes.reshape(*curvature.shape[:-1], len(lengths) + 1, NODE)
    return LocalReference(
        arc_length=shaped[..., NODE_ARC_LENGTH],
        x=shaped[..., NODE_X],
        y=shaped[..., NODE_Y],
        heading=shaped[..., NODE_HEADING],
        speed=shaped[..., NODE_SPEED],
    )


@compiled_internal
def along_arc(c: Any, d: Any, x: Any, y: Any, curvature: Any, length: Any) -> Any:
    """Move on by an arc: return the new direction (c, d), position x, y (m) and the turn (rad)."""
    half = 0.5 * curvature * length
    ch, sh = math.cos(half), math.sin(half)
    chord = length if abs(half) < 1e-9 else length * sh / half
    # The chord has the direction at the middle of the arc.
    c, d = c * ch - d * sh, d * ch + c * sh
    x, y = x + chord * c, y + chord * d
    return c * ch - d * sh, d * ch + c * sh, x, y, 2.0 * half


@compiled_internal
def fill_nodes(curvature: Array, first_speed: Any, speed: Array, period: Any, nodes: Array) -> None:
    """Fill nodes (n + 1, NODE) from the first n intervals of one preview."""
    s = x = y = heading = 0.0
    before = first_speed
    # Direction of the path at the node before.
    c, d = 1.0, 0.0
    nodes[0, NODE_SPEED], nodes[0, NODE_HEADING], nodes[0, NODE_X] = first_speed, 0.0, 0.0
    nodes[0, NODE_Y], nodes[0, NODE_ARC_LENGTH] = 0.0, 0.0
    for k in range(nodes.shape[0] - 1):
        after = float(speed[k])
        length = 0.5 * (before + after) * period
        c, d, x, y, turn = along_arc(c, d, x, y, curvature[k], length)
        s += length
        heading += turn
        before = after
        nodes[k + 1, NODE_SPEED], nodes[k + 1, NODE_HEADING] = after, heading
        nodes[k + 1, NODE_X], nodes[k + 1, NODE_Y], nodes[k + 1, NODE_ARC_LENGTH] = x, y, s


@compiled_internal
def way_beside(offset: Any, decay: Any, s: Any, curvature: Any) -> Any:
    """Return the length of an approach by that of the path below it, at least 1.

    At the arc length s (m), where the path has a curvature (1/m); `offset` and `decay` (m) are
    those of `approach`.
    """
    if offset == 0.0:
        return 1.0
    beside = offset * math.exp(-s / decay)
    return max(math.hypot(1.0 - curvature * beside, beside / decay), 1.0)


@compiled_internal
def fill_nodes_at(
    curvature: Array, first_speed: Any, speed: Array, period: Any, lengths: Array, pace: Any,
    rate: Any, grip: Any, braking: Any, offset: Any, decay: Any, capped: Array, nodes: Array,
) -> None:  # fmt: skip
    """Fill nodes (n + 1, NODE) that are `lengths` (n,) s apart, from the intervals of one preview.

    Within an interval of `period` s acceleration and curvature are constant, as in `fill_nodes`.
    Beyond the last interval the reference goes on along it, at its end speed.

    The nodes are no faster than pace + LEAD + SHARE `rate` t (m/s, m/s^2), and none of the first
    intervals, as many as `capped` has entries for beside the first, is passed faster than
    `cap_speeds` says: where the reference is, they pass its places more slowly. So they do where a
    vehicle that approaches the path, from `offset` m beside it within the length `decay` (m), has
    the longer way: outside of a bend, and across.
    """
    limited = grip < math.inf and cap_speeds(
        curvature, first_speed, speed, period, pace, rate, grip, braking, capped
    )
    s = x = y = heading = 0.0
    c, d = 1.0, 0.0
    v, at, last = first_speed, 0, curvature.shape[0] - 1
    end, left = float(speed[0]), period
    if limited:
        v = capped[0]
        end, left = capped_interval(first_speed, speed, period, capped, 0)
    fastest = max(pace, 0.0) + LEAD
    nodes[0, NODE_SPEED], nodes[0, NODE_HEADING] = min(v, fastest), 0.0
    nodes[0, NODE_X], nodes[0, NODE_Y], nodes[0, NODE_ARC_LENGTH] = 0.0, 0.0, 0.0
    for k in range(nodes.shape[0] - 1):
        rest, gain = lengths[k], SHARE * rate * lengths[k]
        if fastest + 0.5 * gain < v:
            # The share of the reference's own time.
            rest *= (fastest + 0.5 * gain) / v
        fastest += gain
        rest /= way_beside(offset, decay, s, float(curvature[min(at, last)]))
        while rest > 1e-9:
            interval = min(at, last)
            step, after = left, end
            if rest < left - 1e-9:
                step, after = rest, v + (end - v) * (rest / left)
            if at > last:
                step, after = rest, v
            length = 0.5 * (v + after) * step
            c, d, x, y, turn = along_arc(c, d, x, y, curvature[interval], length)
            s += length
            heading += turn
            v, rest, left = after, rest - step, left - step
            if left <= 1e-9:
                at, left = at + 1, period
                if at <= last:
                    end = float(speed[at])
                    if limited:
                        end, left = capped_interval(first_speed, speed, period, capped, at)
        nodes[k + 1, NODE_SPEED], nodes[k + 1, NODE_HEADING] = min(v, fastest), heading
        nodes[k + 1, NODE_X], nodes[k + 1, NODE_Y], nodes[k + 1, NODE_ARC_LENGTH] = x, y, s


@compiled_internal
def fill_leading_nodes(
    curvature: Array, first_speed: Any, speed: Array, period: Any, lengths: Array, vx: Any,
    heading_error: Any, lateral_error: Any, rate: Any, grip: Any, braking: Any, capped: Array,
    nodes: Array,
) -> None:  # fmt: skip
    """Fill nodes as `fill_nodes_at` does, such that they lead a vehicle far from its reference.

    A vehicle that is slow along the path, at a standing start for instance or because it heads
    elsewhere, gets goals that it can reach with the acceleration `rate` (m/s^2): to those of the
    reference it would cut the bend between. One far beside the path is led back by `approach`.
    """
    pace = vx * math.cos(heading_error)
    offset, decay = approach(lateral_error, vx)
    fill_nodes_at(
        curvature, first_speed, speed, period, lengths, pace, rate, grip, braking, offset, decay,
        capped, nodes,
    )  # fmt: skip
    if offset == 0.0:
        return
    for k in range(nodes.shape[0]):
        beside = offset * math.exp(-nodes[k, NODE_ARC_LENGTH] / decay)
        heading = nodes[k, NODE_HEADING]
        nodes[k, NODE_X] -= beside * math.sin(heading)
        nodes[k, NODE_Y] += beside * math.cos(heading)
        nodes[k, NODE_HEADING] = heading - math.atan(beside / decay)


@compiled_internal
def approach(lateral_error: Any, speed: Any) -> tuple[Any, Any]:
    """Return the offset (m) from which nodes lead a vehicle far beside the path back, and a length.

    An offset that decays along the path is added to the nodes, with the heading that goes with it:
    a reference trajectory in the sense of Richalet (Automatica 29, 1993). It begins with the part
    of the lateral error (m) beyond `NEAR_PATH` and decays as exp(-s / d). The length d (m) bounds
    the angle of approach, and grows with the speed (m/s). Without it a quadratic cost asks for an
    overshoot: it is cheaper to be on the other side later than on this side now.
    """
    excess = abs(lateral_error) - NEAR_PATH
    if not excess > 0.0:
        return 0.0, SHORTEST_APPROACH
    length = max(excess / APPROACH_SLOPE, APPROACH_TIME * abs(speed), SHORTEST_APPROACH)
    return math.copysign(excess, lateral_error), length


@compiled
def replace_previews(
    rows: Array, period: Any, lengths: Array, rate: Any, grip: Any, braking: Any, capped: Array,
    nodes: Array,
) -> None:  # fmt: skip
    """Replace the references in observations (n, size) by those that the vehicles can follow.

    They are the nodes of `fill_nodes_at`, which friction allows and which lead a slow vehicle, in
    the form of a preview of the same period. Observations that are not finite stay.

    Parameters
    ----------
    rows
        Observations, float64.
    period, lengths
        Period of their preview of K nodes, s; K times.
    rate, grip, braking
        As `fill_nodes_at` takes them, m/s^2.
    capped, nodes
        Working space, (K + 1,) and (K + 1, NODE).
    """
    first = entry.PREVIEW_START
    speeds = first + lengths.shape[0]
    for row in range(rows.shape[0]):
        o, finite = rows[row], True
        for value in o:
            finite = finite and math.isfinite(value)
        if not finite:
            continue
        pace = o[entry.LONGITUDINAL_SPEED] * math.cos(o[entry.HEADING_ERROR])
        fill_nodes_at(
            o[first:speeds], o[entry.REFERENCE_SPEED], o[speeds:], period, lengths, pace, rate,
            grip, braking, 0.0, 1.0, capped, nodes,
        )  # fmt: skip
        o[entry.REFERENCE_SPEED] = nodes[0, NODE_SPEED]
        for k in range(lengths.shape[0]):
            length = 0.5 * (nodes[k, NODE_SPEED] + nodes[k + 1, NODE_SPEED]) * period
            turn = nodes[k + 1, NODE_HEADING] - nodes[k, NODE_HEADING]
            o[first + k] = turn / length if length > 1e-9 else 0.0
            o[speeds + k] = nodes[k + 1, NODE_SPEED]


@compiled
def _fill_rows(
    curvature: Array, first_speed: Array, speed: Array, period: Any, lengths: Array, nodes: Array
) -> None:
    for row in range(nodes.shape[0]):
        fill_nodes_at(
            curvature[row], first_speed[row], speed[row], period, lengths, math.inf, 0.0, math.inf,
            math.inf, 0.0, 1.0, speed[row], nodes[row],
        )  # fmt: skip


@compiled
def _lead_rows(
    curvature: Array, first_speed: Array, speed: Array, period: Any, lengths: Array, vx: Array,
    heading_error: Array, lateral_error: Array, rate: Any, grip: Any, braking: Any, capped: Array,
    nodes: Array,
) -> None:  # fmt: skip
    for row in range(nodes.shape[0]):
        fill_leading_nodes(
            curvature[row], first_speed[row], speed[row], period, lengths, vx[row],
            heading_error[row], lateral_error[row], rate, grip, braking, capped, nodes[row],
        )  # fmt: skip


def point_at(
    reference: LocalReference, arc_length: float, curvature_beyond: float = 0.0
) -> LocalPoint:
    """Return the point of one reference, fields (K + 1,), at an arc length (m).

    Within an interval the point lies on its arc. The path is continued straight behind the foot
    point, and with `curvature_beyond` (1/m) beyond the preview.
    """
    nodes = reference.arc_length
    index = int(np.searchsorted(nodes, arc_length, side="right")) - 1
    index = min(max(index, 0), len(nodes) - 1)
    offset = arc_length - float(nodes[index])
    heading = float(reference.heading[index])
    turn = 0.0
    if index == len(nodes) - 1:
        turn = offset * curvature_beyond
    elif offset > 0.0:
        share = offset / float(nodes[index + 1] - nodes[index])
        turn = share * float(reference.heading[index + 1] - reference.heading[index])
    chord = offset * float(np.sinc(turn / (2.0 * np.pi)))
    direction = heading + 0.5 * turn
    return LocalPoint(
        float(reference.x[index]) + chord * math.cos(direction),
        float(reference.y[index]) + chord * math.sin(direction),
        heading + turn,
    )


def mean_curvature(reference: LocalReference, start: float, end: float) -> float:
    """Return the mean curvature (1/m) of one reference between two arc lengths (m).

    A stretch that reaches beyond the preview is cut at its end.
    """
    first, last = float(reference.arc_length[0]), float(reference.arc_length[-1])
    # At least a centimetre long, even at the end of the preview.
    end = min(max(end, first + 0.01), max(last, first + 0.01))
    start = min(max(start, first), end - 0.01)
    turned = np.interp([start, end], reference.arc_length, reference.heading)
    return float(turned[1] - turned[0]) / (end - start)
