"""Compare the vector field with its LPV form x' = A(x, u) x + B(x, u) u, and differentiate it.

The same function works on floats, arrays and CasADi symbols. Prints the largest difference of both
forms over random states, and an entry of the Jacobian that A does not have.
"""

import argparse

import casadi
import numpy as np

from lpv_track_env import bicycle, lpv
from lpv_track_env.vehicle import VEHICLES


def main() -> None:
    """Run the example; `--help` lists its options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=1000)
    options = parser.parse_args()

    vehicle = VEHICLES["m2-minibus"]
    rng = np.random.default_rng(0)
    scale = np.array([15.0, 0.5, 3.0, 0.5, 100.0, 100.0])
    worst = 0.0
    for _ in range(options.states):
        state = scale * rng.uniform(-1.0, 1.0, 6)
        state[0] = rng.uniform(1.0, 25.0)
        action = np.array([rng.uniform(-4.0, 2.0), rng.uniform(-0.5, 0.5)])
        A, B = lpv.matrices(state, action, vehicle)
        field = bicycle.derivative(state, action, vehicle)
        worst = max(worst, float(np.abs(A @ state + B @ action - field).max()))
    print(f"largest difference of both forms over {options.states} states: {worst:.1e}")

    x, u = casadi.SX.sym("x", 6), casadi.SX.sym("u", 2)
    symbolic = bicycle.casadi_derivative(x, u, vehicle)
    jacobian = casadi.Function("jacobian", [x, u], [casadi.jacobian(symbolic, x)])
    state, action = np.array([8.0, 0.1, 0.3, 0.2, 0.0, 0.0]), np.array([0.5, 0.05])
    A, _ = lpv.matrices(state, action, vehicle)
    exact = float(jacobian(state, action)[5, 2])
    print(f"dY'/dpsi: {exact:.3f} in the Jacobian, {A[5, 2]:.3f} in A")


if __name__ == "__main__":
    main()
