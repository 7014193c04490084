"""Where kumar2025lpv contradicts itself or leaves something out, and the reading taken."""

ERRATA = (
    "A[vy, vy] is printed with the front stiffness twice; the field gives Car + Caf cos δ.",
    "B is printed with its columns in the order [δ, a], while u = [a, δ].",
    (
        "The text bounds dvx/dt by 2 m/s², the derived row by 1; the table's own trajectories "
        "need up to 2.01. We take 2."
    ),
    "The section is titled kinematic; the model is the dynamic bicycle.",
    (
        "Ts, N, the vehicle's parameters and the weights are not given. The rate limits are per "
        "step: we take Ts = 0.02 s for them (0.5236 rad/s, 5 m/s³) and keep them as physical "
        "rates."
    ),
    (
        "The reference velocities are rotated with a sign that does not give the tangential "
        "speed; the tangential speed is meant."
    ),
    (
        "“Average” lateral and orientation errors are root mean squares by formula. By the "
        "formulas Max CTE equals MLE and Mean CTE never exceeds ALE, yet the published table "
        "has Mean CTE above ALE everywhere: its reference point must be another one, for "
        "example by the clock. The distance by the clock is given separately."
    ),
    (
        "The published maximum curvatures (up to 4.0 1/m) cannot be driven: |δ| ≤ π/6 allows "
        "0.175 1/m at a wheelbase of 3.3 m. The drivable trajectories match the other rows; the "
        "Tn-raw ones have kinks that match the curvature rows."
    ),
    (
        "The parallel nodes are said to cut latency; the paper gives no figure. Solve times are "
        "measured here."
    ),
)
"""What a researcher who compares with kumar2025lpv will stumble over, and our reading."""
