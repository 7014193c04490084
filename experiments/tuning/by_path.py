"""The paper's rule (kumar2025lpv): a set for each class of path, by the path's sharpest curvature.

The published table of sets is not known; here each class's set is searched on the paths of that
class, with a share of the budget as large as its share of the paths.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.weight_tuning.choice import SLEW
from agents.weights import TrackingWeights, WeightSchedule
from experiments.tuning.drives import weights_at
from experiments.tuning.search import CmaSearch
from experiments.tuning.settings import TuningSettings
from experiments.tuning.tuner import Tuner
from trajectories import CurvatureBands, ReferencePath


class PathClassSearch(Tuner):
    """A search for each class of path that there is; the result is to be followed by "path".

    Classes without a path take the set of the nearest that has one.
    """

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath]) -> None:
        super().__init__(settings)
        self.bands = CurvatureBands()
        classes = [self.bands.select(path.curvature) for path in paths]
        self.searches: dict[int, CmaSearch] = {}
        for band in sorted(set(classes)):
            own = [path for path, of in zip(paths, classes, strict=True) if of == band]
            share = int(settings.solves * len(own) / len(paths))
            self.searches[band] = CmaSearch(replace(settings, solves=share), own, 1)

    @property
    def solves(self) -> int:
        """NMPC solves so far."""
        return sum(search.solves for search in self.searches.values())

    @property
    def cost(self) -> int:
        """Solves of the next generation at most."""
        return min(search.cost for search in self.searches.values())

    @property
    def done(self) -> bool:
        """Whether every class has used its share."""
        return all(search.done for search in self.searches.values())

    def step(self) -> dict[str, float]:
        """One generation of every class that has solves left."""
        figures = [search.step() for search in self.searches.values() if not search.done]
        return {key: float(np.mean([each[key] for each in figures])) for key in figures[0]}

    def save(self, folder: Path) -> None:
        """Write every class's scores."""
        for band, search in self.searches.items():
            (folder / self.bands.names[band]).mkdir(exist_ok=True)
            search.save(folder / self.bands.names[band])

    def restore(self, folder: Path) -> None:
        """Play every class's scores again."""
        for band, search in self.searches.items():
            search.restore(folder / self.bands.names[band])

    def result(self, provenance: Mapping[str, Any]) -> WeightSchedule:
        """A set for each class."""
        found = {
            band: weights_at(search.point[0], self.settings)
            for band, search in self.searches.items()
        }
        rows = [found[min(found, key=lambda b: abs(b - band))] for band in range(len(self.bands))]
        return WeightSchedule(
            self.bands, tuple(TrackingWeights.from_array(row) for row in rows), slew=SLEW,
            provenance=provenance,
        )  # fmt: skip
