"""Weights of the NMPC's cost, and schedules of weights over the path's curvature."""

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lpv_track_env.vehicle import VehicleParameters
from trajectories import CurvatureBands, ReferencePath
from trajectories.arguments import Number, check_fields, instance_of, numbers, shortened, shown
from trajectories.arguments import array as numbers_of
from trajectories.fileio import read_json, write_atomically
from trajectories.naming import choose

Array = NDArray[np.float64]

LOWEST, HIGHEST = 1e-4, 1e6
"""Bounds of every weight that the NMPC uses."""
FULL_SIZE = 2.0
"""m: wheelbase of the smallest car whose lateral errors are judged like those of any other."""
WEIGHTS = 12
"""Size of a set of weights: Q, S, R, R_rate."""
FORMAT = "weight-schedule/3"
"""Format of a schedule's file."""
EARLIER = ("weight-schedule/1", "weight-schedule/2")
"""Earlier formats, without R_rate, the first also without a slew limit, which are still read."""


@dataclass(frozen=True)
class TrackingWeights:
    """Diagonals of the cost: Q (stage) and S (terminal) on [vx, psi, X, Y], R and R_rate on inputs.

    X and Y are positions along and across the path. R weighs [a, delta], R_rate their rates [jerk,
    steering rate]; agents add a weight on lateral jerk to the latter, which grows with the speed
    (`NmpcProblem.weights_at`). `agents.nmpc.problem` has units.

    Only their ratios affect the plan. The defaults track all six trajectories within centimetres.
    Heading has a tenth of the weight of position: a car drives through a bend with sideslip, so a
    heading error of zero would cost lateral error.

    Raises
    ------
    ValueError
        For a wrong number of weights, or one that is negative or not finite.
    """

    Q: tuple[float, float, float, float] = (1.0, 1.0, 10.0, 10.0)
    S: tuple[float, float, float, float] = (10.0, 10.0, 100.0, 100.0)
    R: tuple[float, float] = (0.01, 0.5)
    R_rate: tuple[float, float] = (0.001, 0.06)

    def __post_init__(self) -> None:
        for name, size in (("Q", 4), ("S", 4), ("R", 2), ("R_rate", 2)):
            values = numbers(name, getattr(self, name), Number(0.0), size)
            object.__setattr__(self, name, values)

    @classmethod
    def of(cls, vehicle: VehicleParameters) -> "TrackingWeights":
        """Return the default weights for a vehicle.

        Positions count by the vehicle's size where it is small: with a wheelbase shorter than
        `FULL_SIZE`, their weights grow by the square of the ratio. On circuits at 1:10, `lpv-nmpc`
        with `f1tenth` keeps within 2.2 cm so, and within 7.4 cm with the weights of a car.
        """
        larger = max(FULL_SIZE / vehicle.wheelbase, 1.0) ** 2
        q, s = cls.Q, cls.S
        return cls(
            Q=(*q[:2], larger * q[2], larger * q[3]), S=(*s[:2], larger * s[2], larger * s[3])
        )

    def as_array(self) -> Array:
        """Return Q, S, R, R_rate in one vector, (12,)."""
        return np.array([*self.Q, *self.S, *self.R, *self.R_rate])

    @classmethod
    def from_array(cls, values: ArrayLike) -> "TrackingWeights":
        """Make weights of a vector (12,): the inverse of `as_array`."""
        array = numbers_of("weights", values)
        if array.shape != (WEIGHTS,):
            raise ValueError(f"{WEIGHTS} weights are needed, not shape {array.shape}")
        flat = array.tolist()
        return cls(tuple(flat[:4]), tuple(flat[4:8]), tuple(flat[8:10]), tuple(flat[10:]))

    def clipped(self) -> "TrackingWeights":
        """Return the weights clipped to [LOWEST, HIGHEST]."""
        return self.from_array(np.clip(self.as_array(), LOWEST, HIGHEST))


@dataclass(frozen=True)
class WeightSchedule:
    """Weights per band of the path's curvature; `agents.nmpc.schedule` follows it.

    Parameters
    ----------
    bands
        The bands of |kappa|.
    weights
        One set per band, from the straightest to the sharpest.
    blend
        Half width, as a share of a threshold, of the zone around it in which the two sets are
        blended geometrically. 0 switches at once, with the bands' hysteresis.
    slew
        Largest rate of change of each weight's natural logarithm, 1/s; None: no limit.
    provenance
        Origin of the numbers, plain JSON.

    Raises
    ------
    ValueError
        If the number of sets differs from that of the bands, the blending zones overlap, or the
        slew limit is not positive.
    """

    bands: CurvatureBands
    weights: tuple[TrackingWeights, ...]
    blend: float = 0.0
    slew: float | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        instance_of("bands", self.bands, CurvatureBands, "CurvatureBands")
        instance_of("weights", self.weights, tuple, "a tuple of TrackingWeights")
        for one in self.weights:
            instance_of("weights", one, TrackingWeights, "a tuple of TrackingWeights")
        instance_of("provenance", self.provenance, Mapping, "a mapping")
        check_fields(self, {"blend": Number()})
        if self.slew is not None:
            check_fields(self, {"slew": Number(0.0, math.inf, "1/s", above=True)})
        if len(self.weights) != len(self.bands):
            raise ValueError(f"{len(self.bands)} bands need as many sets, not {len(self.weights)}")
        edges = np.array(self.bands.thresholds)
        if (
            not 0.0 <= self.blend < 1.0
            or (edges[1:] * (1.0 - self.blend) < edges[:-1] * (1.0 + self.blend)).any()
        ):
            raise ValueError(f"blend {self.blend} must be in [0, 1) and its zones must not overlap")

    def for_path(self, path: ReferencePath) -> TrackingWeights:
        """Return the set for the path's sharpest curvature, the rule of the paper."""
        return self.weights[self.bands.select(path.curvature)]

    def as_dict(self) -> dict[str, Any]:
        """Return the content of its file, which files of weight policies contain, too."""
        return {
            "format": FORMAT,
            "bands": dataclasses.asdict(self.bands),
            "weights": [dataclasses.asdict(weights) for weights in self.weights],
            "blend": self.blend,
            "slew": self.slew,
            "provenance": dict(self.provenance),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "WeightSchedule":
        """Make a schedule of the result of `as_dict`, also after it has been through JSON.

        Raises
        ------
        ValueError
            In one line, for anything else.
        """
        try:
            if content.get("format") not in (FORMAT, *EARLIER):
                raise ValueError(f"format is {shown(content.get('format'))}, not {FORMAT!r}")
            bands, slew = content["bands"], content.get("slew")
            absent = {} if content["format"] == FORMAT else {"R_rate": (0.0, 0.0)}
            return cls(
                CurvatureBands(
                    thresholds=tuple(float(edge) for edge in bands["thresholds"]),
                    names=tuple(str(name) for name in bands["names"]),
                    hysteresis=float(bands["hysteresis"]),
                ),
                tuple(TrackingWeights(**{**absent, **one}) for one in content["weights"]),
                float(content["blend"]),
                None if slew is None else float(slew),
                dict(content["provenance"]),
            )
        except KeyError as error:
            raise ValueError(f"no {error} in it") from error
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(shortened(error)) from error

    def write(self, file: Path) -> None:
        """Write the schedule as JSON, atomically."""
        write_atomically(Path(file), json.dumps(self.as_dict(), indent=2).encode())

    @classmethod
    def read(cls, file: Path) -> "WeightSchedule":
        """Read a schedule written by `write`.

        Raises
        ------
        ValueError
            In one line that names the file, if it cannot be read or is not a schedule.
        """
        try:
            content = read_json(file, infinite=True)  # a slew limit may be infinite
        except ValueError as error:
            raise ValueError(f"weight schedule {error}") from error
        try:
            return cls.from_dict(content)
        except ValueError as error:
            raise ValueError(f"weight schedule {shortened(file)}: {error}") from error


def weights_from(value: object) -> TrackingWeights | WeightSchedule:
    """Return weights as a user may give them: in code, in a file, or typed on a command line.

    Parameters
    ----------
    value
        Weights, a schedule, or the path of a schedule's .json; or a mapping: Q, S, R and R_rate, or
        a schedule as in its file. Entries left out of a mapping have their defaults.

    Raises
    ------
    ValueError
        In one line, for anything else.
    """
    if isinstance(value, TrackingWeights | WeightSchedule):
        return value
    if isinstance(value, str | Path):
        return WeightSchedule.read(Path(value))
    if not isinstance(value, Mapping):
        raise ValueError(  # noqa: TRY004  as for every unusable setting
            f"weights must be weights, a schedule or its file, not {type(value).__name__}"
        )
    try:
        if "weights" in value:
            bands = {**dataclasses.asdict(CurvatureBands()), **value.get("bands", {})}
            defaults = {"format": FORMAT, "blend": 0.0, "provenance": {}}
            return WeightSchedule.from_dict({**defaults, **value, "bands": bands})
        for name in value:
            choose("matrix of weights", name, ("Q", "S", "R", "R_rate"))
        return TrackingWeights(**value)
    except (ValueError, TypeError) as error:
        raise ValueError(f"weights: {' '.join(str(error).split())}") from error


def in_words(weights: ArrayLike) -> dict[str, str]:
    """Format weights (12,) with two digits, for a picture: a text for each matrix."""
    parts = np.split(np.asarray(weights, dtype=np.float64), (4, 8, 10))
    return {
        label: "   ".join(_two_digits(value) for value in values.tolist())
        for label, values in zip(("Q", "S", "R", "R_rate"), parts, strict=True)
    }


def _two_digits(value: float) -> str:
    """Format a number with two significant digits; numbers from 100 to 9999 as integers."""
    return f"{value:.0f}" if 100.0 <= value < 1e4 else f"{value:.2g}"
