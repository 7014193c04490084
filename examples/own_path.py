"""Three ways to a path of one's own: segments, waypoints in a file, arrays; drive each of them."""

import argparse
from pathlib import Path

import numpy as np

import trajectories
from experiments.run.case import run_case
from trajectories import SpeedLimits, shapes
from trajectories.files import write

LIMITS = SpeedLimits(max_speed=8.0, max_lateral_acceleration=1.5, max_acceleration=1.0)


def from_segments() -> trajectories.ReferencePath:
    """Straights in metres, turns in degrees with their radius: the language of T1 to T6."""
    segments = shapes.fit(shapes.parse("S 40 | L 90 r15 | S 30 | R 60 r20 | S 40"), LIMITS)
    return shapes.from_geometry(shapes.build(segments), LIMITS, "segments")


def from_waypoints(file: Path) -> trajectories.ReferencePath:
    """Points 5 m apart in a file `x_m,y_m`: smoothed, resampled, given a speed that can be driven.

    Circuits with `w_tr_right_m,w_tr_left_m` and GPS logs with `lat,lon` are read the same way.
    """
    x = np.arange(0.0, 120.0, 5.0)
    rows = np.column_stack([x, 3.0 * np.sin(x / 15.0)])
    np.savetxt(file, rows, delimiter=",", header="x_m,y_m", comments="")
    return trajectories.load(file)


def from_arrays() -> trajectories.ReferencePath:
    """Everything given: a clothoid, whose curvature grows with arc length, at 5 m/s."""
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
    """Run it; `--help` lists the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path(), help="where paths are written")
    folder: Path = parser.parse_args().folder
    for path in (from_segments(), from_waypoints(folder / "waypoints.csv"), from_arrays()):
        file = folder / f"{path.name}-path.csv"
        write(path, file)  # what every --trajectory takes
        result = run_case({"agent": "lpv-nmpc", "trajectory": str(file)})
        sharpest = np.abs(path.curvature).max()
        print(
            f"{file.name}: {path.length:.1f} m, up to {sharpest:.3f} 1/m; {result['end']}, "
            f"largest lateral error {result['metrics']['mle']:.3f} m"
        )


if __name__ == "__main__":
    main()
