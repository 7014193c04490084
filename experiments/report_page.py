"""The report's page: its frame, its style, and the list of the paper's errata."""

from string import Template

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
"""Where kumar2025lpv contradicts itself or leaves something out, and the reading taken."""
"""What a researcher who compares with kumar2025lpv will stumble over, and our reading."""

PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { --ink: #1b1f24; --soft: #57606a; --page: #ffffff; --card: #f6f8fa; --line: #d0d7de;
  --accent: #0a58a8; --bad: #b00020; color-scheme: light dark; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6edf3; --soft: #9da7b1; --page: #0d1117; --card: #161b22; --line: #30363d;
    --accent: #6cb6ff; --bad: #ff7b8a; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1320px; margin: 0 auto; padding: 1rem clamp(0.75rem, 3vw, 2rem) 4rem; }
p, li, dd, dt { max-width: 46rem; overflow-wrap: anywhere; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 1rem 0 0.25rem; }
h2 { font-size: 1.3rem; margin: 2.75rem 0 0.5rem; padding-top: 0.75rem;
  border-top: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.75rem 0 0.5rem; overflow-wrap: anywhere; }
h4 { font-size: 0.95rem; margin: 1.25rem 0 0.35rem; }
a { color: var(--accent); }
nav { display: flex; flex-wrap: wrap; gap: 0.25rem 1rem; margin: 0.75rem 0 0; }
small, .soft, figcaption { color: var(--soft); }
.wide { overflow-x: auto; margin: 0.5rem 0 0.75rem; }
table { border-collapse: collapse; font-size: 0.875rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.65rem; text-align: left; vertical-align: baseline;
  border-bottom: 1px solid var(--line); overflow-wrap: break-word; }
thead th { vertical-align: bottom; font-weight: 600; border-bottom: 2px solid var(--line); }
thead small, td small { display: block; font-weight: 400; }
td.n, th.n { text-align: right; white-space: nowrap; }
thead th.n { white-space: normal; }
td.who { white-space: nowrap; }
td.t { min-width: 5rem; } td.t:last-child { min-width: 9rem; }
@media (max-width: 600px) { th, td { padding: 0.2rem 0.4rem; } table { font-size: 0.8125rem; } }
th[scope="row"], td:first-child { white-space: nowrap; }
.grouped td, .grouped tbody th { border-bottom: 0; }
.grouped tr.first > * { border-top: 1px solid var(--line); }
.grouped tr.published > td { color: var(--soft); font-style: italic; }
dl.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr));
  gap: 0.6rem; margin: 1rem 0; }
dl.tiles div { background: var(--card); border: 1px solid var(--line); border-radius: 6px;
  padding: 0.5rem 0.75rem; }
dl.tiles dt { color: var(--soft); font-size: 0.8rem; }
dl.tiles dd { margin: 0; font-size: 1.25rem; font-weight: 600; }
.legend { display: flex; flex-wrap: wrap; gap: 0.2rem 1.1rem; margin: 0.4rem 0; padding: 0;
  list-style: none; font-size: 0.875rem; }
.legend svg { width: 30px; height: 10px; vertical-align: middle; margin-right: 0.35rem;
  background: #fff; border-radius: 2px; }
.panels { display: grid; gap: 0.75rem; margin: 0.5rem 0 0.5rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 330px), 1fr)); }
figure { margin: 0; padding: 0.35rem 0.5rem 0.5rem; background: #fff; color: #1b1f24;
  border: 1px solid var(--line); border-radius: 6px; break-inside: avoid; }
figure figcaption { color: #1b1f24; font-weight: 600; font-size: 0.875rem; }
figure svg { display: block; width: 100%; max-width: 640px; height: auto; }
figure svg text { font-family: system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans",
  sans-serif; }
.bad { color: var(--bad); }
pre { overflow-x: auto; background: var(--card); border: 1px solid var(--line);
  border-radius: 6px; padding: 0.6rem 0.8rem; font-size: 0.85rem; }
@media print {
  :root { --ink: #000; --soft: #444; --page: #fff; --card: #fff; --line: #bbb; --accent: #000;
    --bad: #900; }
  body { font-size: 10pt; } nav { display: none; } main { max-width: none; padding: 0; }
  .wide { overflow: visible; } table { font-size: 8pt; } th, td { padding: 0.15rem 0.35rem; }
  tr { break-inside: avoid; } h2, h3, h4 { break-after: avoid; }
  .panels { grid-template-columns: repeat(2, 1fr); } }
</style>
</head>
<body><main>
<h1>$title</h1>
<p class="soft">$subtitle</p>
<nav>$contents</nav>
$body
</main></body>
</html>
""")
