"""The rungs of the study: what is tuned, how, at what budget, and followed by which rule."""

from dataclasses import dataclass

from experiments.tuning.settings import TuningSettings, usual

BASELINE = "search x10"
"""The best fixed set, at ten times the others' budget: what every gain is over."""
OURS = "paired"
"""Of our own; and by a library's PPO:"""
PPO = "rl"


@dataclass(frozen=True)
class Rung:
    """A way to weights."""

    label: str
    method: str
    words: str
    factor: int = 1
    """Of the budget of solves."""
    view: str = "all"
    conditions: str = "randomised"

    @property
    def by_path(self) -> bool:
        """Whether a set is chosen once a path."""
        return self.method == "paper"

    def settings(self, seed: int, solves: int) -> TuningSettings:
        """Settings of a training."""
        return usual(
            self.method, seed=seed, solves=self.factor * solves, view=self.view,
            conditions=self.conditions,
        )  # fmt: skip

    def command(self, seed: int, solves: int) -> str:
        """The command that makes the same weights alone."""
        words = ["lpv-track", "tune", "--method", self.method]
        words += ["--solves", str(self.factor * solves), "--seed", str(seed)]
        return " ".join([*words, "--view", self.view, "--conditions", self.conditions])


LADDER: tuple[Rung, ...] = (
    Rung("default", "fixed", "default weights"),
    Rung("paper", "paper", "a set by the path's sharpest curvature, searched"),
    Rung("search", "search", "best fixed set, CMA-ES"),
    Rung(BASELINE, "search", "the same at ten times the budget", factor=10),
    Rung("bands", "bands", "a set a band, CMA-ES"),
    Rung("gradient", "gradient", "a set a band, gradients of the closed loop"),
    Rung("catalogue", "catalogue", "PPO chooses of 25 sets"),
    Rung(PPO, "rl", "PPO multiplies weights"),
    Rung(OURS, "paired", "a linear policy multiplies weights, learned from pairs of drives"),
    Rung("paired, path", "paired", "the same, shown curvature alone", view="path"),
    Rung("paired, drive", "paired", "the same, shown the drive's history alone", view="drive"),
)
CURVATURE: tuple[Rung, ...] = (
    Rung(f"{BASELINE}, simulation", "search", "best fixed set without disturbances", 10,
         conditions="simulation"),
    Rung("bands, simulation", "bands", "a set a band without disturbances",
         conditions="simulation"),
    Rung("rl, simulation", "rl", "PPO shown curvature alone, without disturbances", view="path",
         conditions="simulation"),
    Rung("paired, simulation", "paired", "a linear policy shown curvature alone, without them",
         view="path", conditions="simulation"),
)  # fmt: skip
"""Curvature alone: nothing differs between drives but the path."""
EVERY = (*LADDER, *CURVATURE)


def rung(label: str) -> Rung:
    """Rung of a label."""
    return next(one for one in EVERY if one.label == label)


def baseline_of(one: Rung) -> str:
    """Label of what a rung is compared with: the best fixed set under the same conditions."""
    return f"{BASELINE}, simulation" if one.conditions == "simulation" else BASELINE
