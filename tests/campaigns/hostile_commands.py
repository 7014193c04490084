"""Command lines of `lpv-track` with wrong, absurd and hostile values, for every command and option.

Each try takes a small command line that works, and gives one of its options (or arguments) a
hostile value, or changes what the process finds around it: no standard output, no home, another
locale. It must end by itself with 0, 1 or 2, without a traceback; a refusal is one line. Nothing
may be written outside the folder in which it is called and its home. Commands whose work would
take long are stopped where the work begins.
"""

import argparse
import contextlib
import importlib
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from tests.campaigns import Counts, Say
from tests.helpers.forked import Ended, forked

SECONDS = 60.0
LONGEST = 1000
"""Characters of the longest message, lists of all known names included."""
REAL = 0.1
"""Share of the tries that are processes of their own, in a changed environment."""

BASES: dict[str, list[str]] = {
    "benchmark": ["--agents", "stanley", "--trajectories", "u-turn", "--workers", "1"],
    "report": [],
    "drive": ["--agent", "stanley", "--trajectory", "u-turn", "--frames", "out", "--every", "500"],
    "trajectories": ["u-turn", "--write", "out"],
    "speed": ["--only", "single", "--quick"],
    "ablation": ["--agent", "stanley", "--trajectories", "u-turn", "--seeds", "1"],
    "latency": ["--trajectories", "u-turn", "--seeds", "1", "--times", "times.json"],
    "switching": ["--episodes", "1", "--spans", "10"],
    "highway": ["--agents", "stanley", "--seeds", "1", "--workers", "1"],
    "verify": ["--states", "1", "--workers", "1"],
    "bag export": ["--agent", "stanley", "--trajectory", "u-turn", "--out", "out.bag"],
    "bag info": ["run.bag"],
    "bag reference": ["run.bag", "--out", "path.csv"],
    "bag replay": ["run.bag", "--trajectory", "u-turn", "--agent", "stanley"],
    "run-parallel": ["--agent", "stanley", "--trajectory", "u-turn", "--seconds", "0.5"],
    "train": ["ppo", "--steps", "1000"],
    "tune": ["--method", "search", "--solves", "1000"],
    "tuning-study": ["--rungs", "search", "--seeds", "1"],
    "import-policy": ["model.zip", "--algorithm", "ppo", "--trust", "--out", "mine.json"],
}
"""A command line of each command that works; `report` and `bag` get files that are made first."""

ENGINES = (
    "experiments.run.engines.local_pool", "experiments.run.engines.in_process",
    "experiments.run.ray_engine.run_on_ray",
)  # fmt: skip
LONG: dict[str, tuple[str, ...]] = {
    "ablation": ENGINES,
    "latency": ENGINES,
    "highway": ENGINES,
    "train": ("experiments.training.loop.make_trainer",),
    "tune": ("experiments.tuning.loop.make_tuner",),
    "speed": ("experiments.commands.speed._measure_all",),
    "verify": ("experiments.commands.verify._measure",),
    "tuning-study": ("experiments.study.study.run_trainings",),
    "switching": ("experiments.study.weight_switching.drive_arm",),
    "run-parallel": (
        "experiments.parallel.supervisor.run",
        "experiments.parallel.mailbox_bench.bench_mailbox",
    ),
}
"""Functions with which the long work of a command begins."""

VALUES: dict[str, str] = {
    "empty": "",
    "blank": " ",
    "word": "abc",
    "-1": "-1",
    "0": "0",
    "0.5": "0.5",
    "nan": "nan",
    "inf": "inf",
    "-inf": "-inf",
    "1e400": "1e400",
    "1e8": "1e8",
    "1e-12": "1e-12",
    "10^9": "1000000000",
    "10^11": "99999999999",
    "10^30": "1" + "0" * 30,
    "10^5000": "1" + "0" * 5000,
    "hexadecimal": "0x10",
    "arabic digits": "٣",
    "unicode": "é😀\u202e",
    "escape": "\x1b[31m\nred",
    "surrogate": "\udcff",
    "long": "x" * 100_000,
    "long lines": "a b\n" * 25_000,
    "pair": "a=b",
    "equals": "=",
    "deep": "[" * 100_000,
    "parent": "../../x",
    "device": "/dev/zero",
    "memory": "/proc/self/mem",
    "fifo.csv": "fifo.csv",
    "fifo.json": "fifo.json",
    "fifo.bag": "fifo.bag",
    "folder.csv": "folder.csv",
    "folder.json": "folder.json",
    "missing.csv": "missing.csv",
    "missing.json": "missing.json",
    "missing.py": "missing.py:Agent",
    "broken.py": "broken.py:Agent",
    "exit.py": "exit.py:Agent",
    "noise.csv": "noise.csv",
    "noise.json": "noise.json",
    "noise.zip": "noise.zip",
    "noise.bag": "noise.bag",
    "below a file": "noise.csv/below",
    "dashes": "--",
    "dash": "-",
    "random": "random-" + "9" * 30,
    "format": "%s%n{0}",
}

PAIRS = (
    "null", "true", '"abc"', "[]", "[[1],[2]]", "{}", "1e400", "1e308", "-1", "0", "1e-12", "1e8",
    "1000000000000", "NaN", "[1,2,3,4]", "[null]", '{"a":1}', "[" * 100_000, "5e-324", "1" * 5000,
)  # fmt: skip
"""Values of settings, as JSON."""

AROUND: dict[str, dict[str, Any]] = {
    "no standard output": {"shell": ">&-"},
    "no standard error": {"shell": "2>&-"},
    "no standard input": {"shell": "<&-"},
    "no stream at all": {"shell": "<&- >&- 2>&-"},
    "full standard output": {"shell": ">/dev/full"},
    "reader ends": {"shell": "| true"},
    "no home": {"env": {"HOME": None}},
    "home is a file": {"env": {"HOME": "noise.csv"}},
    "dumb terminal": {"env": {"TERM": "dumb"}},
    "no terminal": {"env": {"TERM": ""}},
    "ascii": {"env": {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}},
    "latin": {"env": {"LC_ALL": "C", "PYTHONIOENCODING": "latin-1", "PYTHONCOERCECLOCALE": "0"}},
    "columns 0": {"env": {"COLUMNS": "0"}},
    "columns 1": {"env": {"COLUMNS": "1"}},
    "columns text": {"env": {"COLUMNS": "abc"}},
    "columns huge": {"env": {"COLUMNS": "1000000000"}},
    "nothing in the environment": {"env": dict.fromkeys(os.environ)},
    "threads": {"env": {"OMP_NUM_THREADS": "abc"}},
}
"""Environment variables and streams of a process."""


class Try(NamedTuple):
    """A command line, and its surroundings: one of `AROUND`, or "" for a fork of this process."""

    words: list[str]
    around: str = ""

    def __str__(self) -> str:
        words = shlex.join(["lpv-track", *self.words])
        return ascii(f"{words[:300]}{f' ({self.around})' if self.around else ''}")


class StartedError(BaseException):
    """The long work of a command has begun."""


def _started(*_: Any, **__: Any) -> Any:
    raise StartedError


def actions_of(command: str) -> list[argparse.Action]:
    """Return the options and arguments of a command, such as "drive" or "bag export"."""
    from experiments.cli import parser

    found: Any = parser([command.split(maxsplit=1)[0]])
    for word in command.split():
        (choices,) = [one.choices for one in found._actions if isinstance(one.choices, dict)]
        found = choices[word]
    return [one for one in found._actions if not isinstance(one, argparse._HelpAction)]


def keys_of(option: str) -> list[str]:
    """Return known keys of an option that takes KEY=VALUE."""
    import dataclasses

    from experiments.run.case import REWARD_FIELDS, VEHICLE_FIELDS, keyword_settings
    from experiments.training.settings import HYPERPARAMETERS
    from lpv_track_env.conditions import Conditions
    from lpv_track_env.env import PathTrackingEnv

    known = {
        "--env": keyword_settings(PathTrackingEnv),
        "--conditions-set": [field.name for field in dataclasses.fields(Conditions)],
        "--vehicle-set": VEHICLE_FIELDS,
        "--reward": REWARD_FIELDS,
        "--set": [*HYPERPARAMETERS["ppo"], "sigma"],
    }
    return [*known.get(option, ("gain", "weights", "horizon", "delay_compensation")), "no_such"]


def draw(rng: random.Random) -> Try:
    """Draw a command line."""
    command = rng.choice(list(BASES))
    words = [*command.split(), *BASES[command]]
    if rng.random() < REAL:
        quick = rng.choice(["trajectories", "report", "benchmark"])
        words = [quick, *(["results"] if quick == "report" else BASES[quick])]
        if rng.random() < 0.3:
            words += ["--help"]
        return Try(words, rng.choice(list(AROUND)))
    if command == "report":
        words += [rng.choice(["results", *VALUES.values()])]
    action = rng.choice(actions_of(command))
    name = action.option_strings[0] if action.option_strings else ""
    if "=" in str(action.metavar):
        pair = f"{rng.choice(keys_of(name))}={rng.choice(PAIRS)}"
        values = [rng.choice([pair, pair, pair, *VALUES.values()])]
    elif action.nargs == 0:
        values = []
    else:
        count = action.nargs if isinstance(action.nargs, int) else rng.choice([1, 1, 1, 2])
        values = [rng.choice(list(VALUES.values())) for _ in range(count)]
    given = [f"{name}={values[0]}"] if name and len(values) == 1 else [name, *values]
    how = rng.random()
    if how < 0.1 and action.option_strings:
        given = [action.option_strings[-1]]  # without its value
    elif how < 0.2:
        given = given * 2
    elif how < 0.25:
        given = ["--no-such", *given]
    return Try([word for word in [*words, *given] if word])


@contextlib.contextmanager
def _prepared() -> Iterator[Path]:
    """Make a folder with the files that command lines name; yield it."""
    from experiments.cli import main

    with tempfile.TemporaryDirectory(prefix="hostile-") as scratch, contextlib.chdir(scratch):
        made = Path(scratch) / "made"
        made.mkdir()
        with contextlib.chdir(made):
            for kind in ("csv", "json", "bag"):
                os.mkfifo(f"fifo.{kind}")
                Path(f"folder.{kind}").mkdir()
                noise = random.Random(kind).randbytes(5000)  # noqa: S311
                Path(f"noise.{kind}").write_bytes(noise)
            Path("noise.zip").write_bytes(b"PK\3\4" + noise)
            Path("model.zip").write_bytes(b"PK\3\4" + noise)
            Path("broken.py").write_text("def (")
            Path("exit.py").write_text("raise SystemExit(9)")
            Path("times.json").write_text(
                '{"ekf": [1e-4], "lpv-nmpc": [1e-3], "lpv-nmpc-ipopt": [1e-2]}'
            )
            with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):  # noqa: PTH123
                main(["benchmark", *BASES["benchmark"], "--out", "results"])
                main(["bag", "export", *BASES["bag export"][:-1], "run.bag"])
        yield made


def _in_fork(words: list[str]) -> Ended:
    """Run a command line in a fork of this process."""

    def call() -> int:
        from experiments.cli import main

        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False, errors="backslashreplace")
        with contextlib.ExitStack() as stack:
            for target in LONG.get(words[0], ()):
                stack.enter_context(mock.patch(target, _started))
            try:
                code = main(words)
            except StartedError:
                code = 0
        sys.stdout.flush()
        sys.stderr.flush()
        return code

    return forked(call, SECONDS)


def _as_process(one: Try) -> Ended:
    """Run a command line as a process of its own, in its surroundings."""
    around = AROUND[one.around]
    found = os.pathsep.join(entry for entry in sys.path if entry)
    changed = {**os.environ, **around.get("env", {}), "PYTHONPATH": found}
    env = {name: value for name, value in changed.items() if value is not None}
    line = shlex.join([sys.executable, "-P", "-m", "experiments", *one.words])
    line = f"{line} {around.get('shell', '')}; exit ${{PIPESTATUS[0]}}"
    with subprocess.Popen(
        ["bash", "-c", line], env=env, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            out, err = process.communicate(timeout=2.0 * SECONDS)
            code: int | None = process.returncode
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, err = process.communicate()
            code = None
    return Ended(code, out.decode(errors="replace"), err.decode(errors="replace"), 0.0)


def fault_of(ended: Ended) -> str | None:
    """Return what is wrong with the end of a command line, or None."""
    if ended.code is None:
        return "hung"
    if "Traceback" in ended.err or ended.code not in {0, 1, 2}:
        last = ended.err.strip().splitlines()[-1:] or [""]
        return f"exit code {ended.code}: {last[0][:200]}"
    said = [line for line in ended.err.splitlines() if "compiling" not in line]
    if ended.code == 2 and (len(said) != 1 or len(said[0]) > LONGEST):
        return f"a refusal of {len(said)} lines, {sum(map(len, said))} characters: {said[:1]}"
    if "Exception ignored" in ended.err:
        return "an exception at the end of the process"
    return None


def _strays(scratch: Path) -> list[str]:
    """Return what stands beside the folder in which the command was called."""
    return sorted({entry.name for entry in scratch.iterdir()} - {"made", "here"})


def run(count: int, seed: int, say: Say) -> Counts:
    """Run `count` command lines, drawn from the seed."""
    rng = random.Random(seed)  # noqa: S311
    for module in ("torch", "stable_baselines3", "matplotlib.figure", "casadi", "rosbags.rosbag1"):
        importlib.import_module(module)  # once, not in every fork
    faults: list[str] = []
    seen = {"done": 0, "failed": 0, "refused": 0, "processes": 0}
    with _prepared() as made:
        here = made.parent / "here"
        for number in range(1, count + 1):
            one = draw(rng)
            shutil.copytree(made, here, symlinks=True, copy_function=_copy)
            with contextlib.chdir(here), mock.patch.dict(os.environ, {"HOME": str(here)}):
                ended = _as_process(one) if one.around else _in_fork(one.words)
            fault = fault_of(ended)
            if strays := _strays(made.parent):
                fault = f"written outside: {strays}"
            if fault is None:
                seen[("done", "failed", "refused")[ended.code or 0]] += 1
            else:
                faults.append(f"{one}: {fault}")
                say(faults[-1])
            seen["processes"] += bool(one.around)
            shutil.rmtree(here)
            if number % 50 == 0:
                say(f"{number} of {count}")
    return Counts(count, faults, seen)


def _copy(source: str, target: str) -> None:
    """Copy a file; a FIFO is made anew."""
    if Path(source).is_fifo():
        os.mkfifo(target)
    else:
        shutil.copy2(source, target)
