"""The paper's rule (kumar2025lpv): a set for each class of path, by the path's sharpest curvature.

The published table of sets is not known; here each class's set is searched on the paths of that
class, with a share of the budget as large as its share of the paths searched.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.weight_tuning.choice import SLEW
from agents.weights import TrackingWeights, WeightSchedule
from experiments.tuning.drives import weights_at
from experiments.tuning.search import CmaSearch, restore_state, write_state
from experiments.tuning.settings import TuningSettings
from experiments.tuning.tuner import Tuner
from trajectories import CurvatureBands, ReferencePath


class PathClassSearch(Tuner):
    """A search for each class of path that there is; the result is to be followed by "path".

    Classes without a path, or with so few that their share of the budget allows no generation, take
    the set of the nearest that is searched.
    """

    def __init__(self, settings: TuningSettings, paths: list[ReferencePath]) -> None:
        super().__init__(settings)
        self.bands = CurvatureBands()
        classes = [self.bands.select(path.curvature) for path in paths]
        self.searches = {
            band: CmaSearch(
                settings, [p for p, of in zip(paths, classes, strict=True) if of == band], 1
            )
            for band in sorted(set(classes))
        }
        self._share_out()
        # The smallest leaves first: what it had may be what another one lacks.
        while len(self.searches) > 1 and any(search.done for search in self.searches.values()):
            del self.searches[min(self.searches, key=lambda b: len(self.searches[b].paths))]
            self._share_out()

    def _share_out(self) -> None:
        """Give every search its share of the budget."""
        count = sum(len(search.paths) for search in self.searches.values())
        for search in self.searches.values():
            share = self.settings.solves * len(search.paths) // count
            search.settings = replace(self.settings, solves=max(share, 1))

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
        """Write every class's scores, all at once."""
        write_state(
            folder,
            {self.bands.names[band]: search.played for band, search in self.searches.items()},
        )

    def restore(self, folder: Path) -> bool:
        """Play every class's scores again; False where there are none."""

        def play(content: Mapping[str, Any]) -> None:
            for band, search in self.searches.items():
                search.play(content[self.bands.names[band]])

        return restore_state(folder, play)

    def result(self, provenance: Mapping[str, Any]) -> WeightSchedule:
        """A set for each class."""
        found = {
            band: weights_at(search.point[0], self.settings.directions, self.settings.span)
            for band, search in self.searches.items()
        }
        rows = [found[min(found, key=lambda b: abs(b - band))] for band in range(len(self.bands))]
        return WeightSchedule(
            self.bands, tuple(TrackingWeights.from_array(row) for row in rows), slew=SLEW,
            provenance=provenance,
        )  # fmt: skip
