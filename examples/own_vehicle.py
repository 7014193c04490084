"""Derive a vehicle from a preset, save it as a file, and drive the same path with both."""

import argparse
import json
from pathlib import Path

from experiments.run.case import run_case
from lpv_track_env.vehicle import VEHICLES


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trajectory", default="T2")
    parser.add_argument("--folder", type=Path, default=Path(), help="folder for the written file")
    options = parser.parse_args()

    empty = VEHICLES["m2-minibus"]
    full = empty.replace(
        name="m2-minibus-full",
        source="m2-minibus with eleven passengers of 75 kg, their inertia as the bus's",
        mass=empty.mass + 11 * 75.0,
        yaw_inertia=empty.yaw_inertia * (empty.mass + 11 * 75.0) / empty.mass,
    )
    file = options.folder / "full.json"
    file.write_text(json.dumps(full.as_dict(), indent=2))
    for vehicle in ("m2-minibus", str(file)):
        result = run_case(
            {"agent": "lpv-nmpc", "trajectory": options.trajectory, "vehicle": vehicle}
        )
        metrics = result["metrics"]
        print(f"{Path(vehicle).stem}: {result['end']}, MLE {metrics['mle']:.4f} m")
    gradient = 1e3 * full.understeer_gradient
    print(f"understeer gradient of the full bus: {gradient:.2f}e-3 rad s^2/m")


if __name__ == "__main__":
    main()
