"""Weights of the NMPC's cost, and schedules that choose them from curvature."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trajectories import CurvatureBands, ReferencePath
from trajectories.fileio import write_atomically

Array = NDArray[np.float64]

LOWEST, HIGHEST = 1e-4, 1e6
"""Bounds of every weight; `TrackingWeights.clipped` brings others within them."""
FORMAT, WITHOUT_SLEW = "weight-schedule/2", "weight-schedule/1"


@dataclass(frozen=True)
class TrackingWeights:
    """Diagonals of the cost's matrices: Q (stage) and S (end) on [vx, psi, X, Y], R on [a, delta].

    Only ratios matter to the plan. The defaults track all six trajectories within centimetres:
    heading is weighted a tenth of position, since a car in a bend drives with sideslip and a
    heading error of zero would cost lateral error.

    Raises
    ------
    ValueError
        For a wrong number of weights, or one that is negative or not finite.
    """

    Q: tuple[float, float, float, float] = (1.0, 1.0, 10.0, 10.0)
    S: tuple[float, float, float, float] = (5.0, 5.0, 50.0, 50.0)
    R: tuple[float, float] = (0.01, 1.0)

    def __post_init__(self) -> None:
        for name, size in (("Q", 4), ("S", 4), ("R", 2)):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != size:
                raise ValueError(f"{name} needs {size} weights, not {len(values)}")
            if not all(math.isfinite(value) and value >= 0.0 for value in values):
                raise ValueError(f"{name} must be finite and not negative, not {values}")
            object.__setattr__(self, name, values)

    def as_array(self) -> Array:
        """Q, S, R in one vector, shape (10,)."""
        return np.array([*self.Q, *self.S, *self.R])

    @classmethod
    def from_array(cls, values: ArrayLike) -> "TrackingWeights":
        """Inverse of `as_array`."""
        array = np.asarray(values, dtype=np.float64)
        if array.shape != (10,):
            raise ValueError(f"10 weights are needed, not shape {array.shape}")
        flat = array.tolist()
        return cls(tuple(flat[:4]), tuple(flat[4:8]), tuple(flat[8:]))

    def clipped(self) -> "TrackingWeights":
        """Every weight brought within [LOWEST, HIGHEST]."""
        return self.from_array(np.clip(self.as_array(), LOWEST, HIGHEST))

    def blended(self, other: "TrackingWeights", share: float) -> "TrackingWeights":
        """Geometric mean with another set: this one at share 0, the other at 1."""
        here, there = (np.log(w.clipped().as_array()) for w in (self, other))
        return self.from_array(np.exp((1.0 - share) * here + share * there))


@dataclass(frozen=True)
class WeightSchedule:
    """Q and S (and R) per curvature band.

    Parameters
    ----------
    bands
        The bands of |kappa|.
    weights
        One set per band, from the straightest to the sharpest.
    blend
        Half width, as a share of a threshold, of the zone around it in which the two sets are
        blended geometrically; 0 switches hard, with the bands' hysteresis.
    slew
        Largest change of every weight's natural logarithm, 1/s, from the set in use towards the
        one that is chosen; None does not limit it.
    provenance
        Where the numbers come from, plain JSON values.

    Raises
    ------
    ValueError
        If the number of sets does not fit the bands, blending zones would overlap, or the slew
        limit is not positive.
    """

    bands: CurvatureBands
    weights: tuple[TrackingWeights, ...]
    blend: float = 0.0
    slew: float | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.weights) != len(self.bands):
            raise ValueError(f"{len(self.bands)} bands need as many sets, not {len(self.weights)}")
        edges = np.array(self.bands.thresholds)
        if (
            not 0.0 <= self.blend < 1.0
            or (edges[1:] * (1.0 - self.blend) < edges[:-1] * (1.0 + self.blend)).any()
        ):
            raise ValueError(f"blend {self.blend} must be in [0, 1) and its zones must not overlap")
        if self.slew is not None and not self.slew > 0.0:
            raise ValueError(f"slew must be positive, not {self.slew}")

    def for_path(self, path: ReferencePath) -> TrackingWeights:
        """The paper's rule: one set, chosen by the path's sharpest curvature."""
        return self.weights[self.bands.select(path.curvature)]

    def select(
        self, curvature: Sequence[float] | Array, band: int | None = None
    ) -> tuple[TrackingWeights, int]:
        """Weights for a preview of curvature (1/m), and the band to hand in with the next call."""
        chosen = self.bands.select(curvature, band)
        if self.blend == 0.0:
            return self.weights[chosen], chosen
        sharpest = float(np.max(np.abs(curvature), initial=0.0))
        for k, edge in enumerate(self.bands.thresholds):
            low, high = edge * (1.0 - self.blend), edge * (1.0 + self.blend)
            if low < sharpest < high:
                share = (sharpest - low) / (high - low)
                return self.weights[k].blended(self.weights[k + 1], share), chosen
        return self.weights[int(self.bands.classify(sharpest))], chosen

    def as_dict(self) -> dict[str, Any]:
        """All of it, as its file and the files of policies that start from it hold it."""
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
        """Inverse of `as_dict`, also for what JSON makes of it.

        Raises
        ------
        ValueError
            In one line, if it is not of that form.
        """
        try:
            if content.get("format") not in (FORMAT, WITHOUT_SLEW):
                raise ValueError(f"format is {content.get('format')!r}, not {FORMAT!r}")
            bands, slew = content["bands"], content.get("slew")
            return cls(
                CurvatureBands(
                    thresholds=tuple(float(edge) for edge in bands["thresholds"]),
                    names=tuple(str(name) for name in bands["names"]),
                    hysteresis=float(bands["hysteresis"]),
                ),
                tuple(TrackingWeights(**weights) for weights in content["weights"]),
                float(content["blend"]),
                None if slew is None else float(slew),
                dict(content["provenance"]),
            )
        except KeyError as error:
            raise ValueError(f"no {error} in it") from error
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            raise ValueError(" ".join(str(error).split())) from error

    def write(self, file: Path) -> None:
        """Write as JSON, atomically."""
        write_atomically(Path(file), json.dumps(self.as_dict(), indent=2).encode())

    @classmethod
    def read(cls, file: Path) -> "WeightSchedule":
        """Read what `write` wrote.

        Raises
        ------
        ValueError
            One line that names the file, if it cannot be read or is not such a schedule.
        """
        try:
            return cls.from_dict(json.loads(Path(file).read_text(encoding="utf-8")))
        except (OSError, ValueError, RecursionError) as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"weight schedule {file}: {reason}") from error


def in_words(weights: ArrayLike) -> dict[str, str]:
    """Weights (10,) in words of two digits for a picture, a row each: Q, S, R."""
    q, s, r = np.split(np.asarray(weights, dtype=np.float64), (4, 8))
    return {
        label: "   ".join(_short(value) for value in values.tolist())
        for label, values in (("Q", q), ("S", s), ("R", r))
    }


def _short(value: float) -> str:
    """Write two digits, of numbers from 100 to 9999 all."""
    return f"{value:.0f}" if 100.0 <= value < 1e4 else f"{value:.2g}"
