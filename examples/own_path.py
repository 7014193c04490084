"""Make paths from segments, from waypoints in a file and from arrays; drive each of them."""

import argparse
from pathlib import Path

import numpy as np

import trajectories
from experiments.run.case import run_case
from trajectories import SpeedLimits, shapes
from trajectories.files import write

LIMITS = SpeedLimits(max_speed=8.0, max_lateral_acceleration=1.5, max_acceleration=1.0)


def from_segments() -> trajectories.ReferencePath:
    """Make a path of straights (m) and turns (deg, radius in m), as T1 to T6 are described."""
    segments = shapes.fit(shapes.parse("S 40 | L 90 r15 | S 30 | R 60 r20 | S 40"), LIMITS)
    return shapes.from_geometry(shapes.build(segments), LIMITS, "segments")


def from_waypoints(file: Path) -> trajectories.ReferencePath:
    """Write points 5 m apart and load them, which smooths them and plans a feasible speed.

    Circuits with `w_tr_right_m,w_tr_left_m` and GPS logs with `lat,lon` are loaded the same way.
    """
    x = np.arange(0.0, 120.0, 5.0)
    rows = np.column_stack([x, 3.0 * np.sin(x / 15.0)])
    np.savetxt(file, rows, delimiter=",", header="x_m,y_m", comments="")
    return trajectories.load(file)


def from_arrays() -> trajectories.ReferencePath:
    """Make a clothoid (curvature grows linearly with arc length) at 5 m/s from its arrays."""
    s = np.linspace(0.0, 80.0, 321)
    curvature = 0.06 * s / s[-1]
    heading = 0.5 * curvature * s
    step = s[1]
    middle = 0.5 * (heading[1:] + heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(step * np.cos(middle))])
    y = np.concatenate([[0.0], np.cumsum(step * np.sin(middle))])
    speed = np.full_like(s, 5.0)
    return trajectories.ReferencePath(s, x, y, heading, curvature, speed, name="clothoid")


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path(), help="folder for the written paths")
    folder: Path = parser.parse_args().folder
    for path in (from_segments(), from_waypoints(folder / "waypoints.csv"), from_arrays()):
        file = folder / f"{path.name}-path.csv"
        write(path, file)  # a file for any --trajectory option
        result = run_case({"agent": "lpv-nmpc", "trajectory": str(file)})
        sharpest = np.abs(path.curvature).max()
        print(
            f"{file.name}: {path.length:.1f} m, up to {sharpest:.3f} 1/m; {result['end']}, "
            f"largest lateral error {result['metrics']['mle']:.3f} m"
        )


if __name__ == "__main__":
    main()
