"""Mutated files over every reader: only a result or a ValueError of one line may come of them.

A worker process reads, with a limit of time and memory for each file. To repeat a try:
`python -m tests.campaigns.hostile_files SEED NUMBER`.
"""

import contextlib
import io
import json
import multiprocessing as mp
import resource
import shutil
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.campaigns import Counts, Say, guided_files
from tests.campaigns.mutations import BYTES, JSON, TEXT, Mutation, Rng, edit, special

MEMORY = 1_500 * 2**20
"""Memory that a reader may take beyond what its process has, bytes."""
LONGEST_MESSAGE = 700
SPECIAL = 0.02
"""Share of files in whose place something else is put."""

Folder = dict[str, bytes]
"""Contents of small files by their names."""


class Reader(NamedTuple):
    """A reader: files that it reads, how to mutate which of them, and the call."""

    seeds: Sequence[Folder]
    mutations: Mapping[str, tuple[Mutation, ...]]
    read: Callable[[Path], object]
    share: int = 1
    """Relative number of tries."""
    seconds: float = 10.0
    repair: Callable[[Path, Rng], None] | None = None
    """Edits a folder so that its digests fit, for half of the tries."""


# Readers and their seeds --------------------------------------------------------------------------


def paths() -> Reader:
    import trajectories
    from trajectories.files import write
    from trajectories.speed import constant_speed

    angle = np.linspace(0.0, 2.0, 40)
    x, y = 20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle))
    seeds: list[bytes] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in ("u-turn", "circle"):
            write(trajectories.load(name), Path(folder) / "path.csv")
            seeds.append((Path(folder) / "path.csv").read_bytes())

    def table(header: str, *columns: Any, separator: str = ",") -> bytes:
        rows = [separator.join(f"{cell:.9g}" for cell in row) for row in zip(*columns, strict=True)]
        return "\n".join([header, *rows, ""]).encode()

    one = np.ones_like(x)
    seeds += [
        table("x_m;y_m", x, y, separator=";"),
        table("x,y", x, y),
        table("# x_m,y_m,w_tr_right_m,w_tr_left_m", 10 * np.cos(3 * angle), 10 * np.sin(3 * angle),
              one, one),
        table("time,lat,lon,alt", angle, 48.0 + 1e-5 * x, 11.0 + 1e-5 * y, one),
    ]  # fmt: skip

    def read(folder: Path) -> None:
        path = trajectories.load(folder / "path.csv")
        assert np.isfinite(path.table).all()
        assert np.isfinite(constant_speed(path))
        write(path, folder / "again.csv")
        assert np.array_equal(trajectories.load(folder / "again.csv").table, path.table)

    folders = [{"path.csv": seed} for seed in seeds]
    return Reader(folders, {"path.csv": TEXT}, read, share=4, seconds=60.0)


def vehicles() -> Reader:
    from lpv_track_env import vehicle
    from lpv_track_env.bicycle import longest_substep

    def read(folder: Path) -> None:
        car = vehicle.load(folder / "car.json")
        assert 1e-4 < longest_substep(car) <= 0.005
        (folder / "again.json").write_text(json.dumps(car.as_dict()))
        assert vehicle.load(folder / "again.json") == car

    seeds = [{"car.json": json.dumps(car.as_dict()).encode()} for car in vehicle.VEHICLES.values()]
    return Reader(seeds, {"car.json": JSON}, read, share=3)


def schedules() -> Reader:
    from agents.weight_tuning import policy
    from agents.weights import TrackingWeights, WeightSchedule, weights_from
    from trajectories import CurvatureBands

    bands = CurvatureBands()
    schedule = WeightSchedule(bands, (TrackingWeights(),) * len(bands), 0.2, 0.5, {"made": [1]})
    seeds = [{"weights.json": json.dumps(schedule.as_dict(), indent=2).encode()}]

    def read(folder: Path) -> None:
        found = WeightSchedule.read(folder / "weights.json")
        assert np.isfinite([one.as_array() for one in found.weights]).all()
        assert policy.load(folder / "weights.json") == weights_from(folder / "weights.json")

    return Reader(seeds, {"weights.json": JSON}, read, share=2)


def _policies(noun: str) -> Reader:
    from tests.helpers.policy_files import KINDS, change

    kind = next(kind for kind in KINDS if kind.noun == noun)
    spec, weights = kind.whole()
    seed = {"mine.json": spec, json.loads(spec)["weights"]["file"]: weights}

    def read(folder: Path) -> None:
        for reader in kind.readers:
            reader(folder / "mine.json")

    def repair(folder: Path, rng: Rng) -> None:
        change(folder / "mine.json", lambda spec: edit(spec, rng))

    mutations = {"mine.json": JSON, next(name for name in seed if name != "mine.json"): BYTES}
    return Reader([seed], mutations, read, share=2, repair=repair)


def _conditions() -> Reader:
    from agents.weights import weights_from
    from lpv_track_env import conditions
    from trajectories.fileio import read_json

    values: list[dict[str, Any]] = [
        {"name": "realtime", "gnss_noise": [0.01, 0.1], "estimator": "raw"},
        {"name": "ideal", "estimator_settings": {"position_deviation": 0.1}, "gnss_latency": 0.1},
        {"Q": [1, 1, 10, 10], "S": [5, 5, 50, 50], "R": [0.01, 1]},
    ]

    def read(folder: Path) -> None:
        found = read_json(folder / "settings.json")
        (weights_from if isinstance(found, dict) and "Q" in found else conditions.load)(found)

    seeds = [{"settings.json": json.dumps(one).encode()} for one in values]
    return Reader(seeds, {"settings.json": JSON}, read)


def _results() -> Reader:
    from experiments.report.build import write_report
    from tests.helpers.made_results import case, folder_of, trace

    with tempfile.TemporaryDirectory() as made:
        store = folder_of(Path(made), [case(1), case(2, agent="pid")], traces=False)
        store.append({**case(3, trajectory="T4"), "trace": trace(n=60)})
        store.append(case(4, status="failed", error="it broke", end=None))
        store.write_manifest({"seeds": [0]})
        seed = {
            str(file.relative_to(made)): file.read_bytes()
            for file in Path(made).rglob("*")
            if file.is_file() and not file.name.startswith(".")
        }

    def read(folder: Path) -> None:
        page = write_report(folder).read_text(encoding="utf-8")
        assert page.rstrip().endswith("</html>")

    kinds = {".jsonl": JSON, ".json": JSON, ".npz": BYTES}
    return Reader([seed], {name: kinds[Path(name).suffix] for name in seed}, read, 2, 30.0)


def _jobs() -> Reader:
    from experiments.commands.latency import read_times
    from experiments.jobs.job import read_lines, stored_settings
    from experiments.study.study import FIGURES, read_figures
    from experiments.training.settings import usual

    def read(folder: Path) -> None:
        calls = (
            lambda: stored_settings(folder, "training"), lambda: read_lines(folder),
            lambda: read_times(folder / "times.json"), lambda: read_figures(folder / "figures.npz"),
        )  # fmt: skip
        refusals = []
        for call in calls:
            try:
                call()
            except ValueError as error:
                refusals.append(error)
        if refusals:
            raise refusals[0]

    line = {"number": 1, "seconds": 2.0, "steps": 100, "validation": {"score": 0.5}}
    figures = io.BytesIO()
    np.savez_compressed(figures, **{name: np.zeros((2, 3)) for name in FIGURES})
    seed = {
        "settings.json": json.dumps(usual("ppo").as_dict()).encode(),
        "progress.jsonl": (json.dumps(line) + "\n").encode() * 3,
        "times.json": json.dumps(
            {"ekf": [0.001] * 4, "lpv-nmpc": [0.002] * 4, "lpv-nmpc-ipopt": [0.02] * 4}
        ).encode(),
        "figures.npz": figures.getvalue(),
    }
    mutations = {name: BYTES if name.endswith("npz") else JSON for name in seed}
    return Reader([seed], mutations, read)


def _bags() -> Reader:
    from experiments.ros.read import info, read
    from experiments.ros.topics import Odometry
    from experiments.ros.write import write

    stamps = 10**9 + 10**8 * np.arange(30)
    columns = {name: np.zeros(30) for name in Odometry.columns()}
    topics = {"/odometry": Odometry(stamps, **columns, frame="map")}
    seeds: list[Folder] = []
    with tempfile.TemporaryDirectory() as made:
        for name, storage in (("run.bag", "sqlite3"), ("run", "sqlite3"), ("mcap", "mcap")):
            write(Path(made) / name, topics, storage=storage)
            files = [f for f in [Path(made) / name, *Path(made, name).rglob("*")] if f.is_file()]
            seeds.append({str(f.relative_to(made)): f.read_bytes() for f in files})

    def read_all(folder: Path) -> None:
        bag = next(iter(folder.iterdir()), folder / "run.bag")
        assert info(bag).ros in {1, 2}
        assert np.isfinite(read(bag, Odometry).data.x).all()

    names = {name for seed in seeds for name in seed}
    mutations = {name: TEXT if name.endswith("yaml") else BYTES for name in names}
    return Reader(seeds, mutations, read_all, share=2)


def readers(say: Say) -> dict[str, Reader]:
    """Make all readers; those of bags need an optional package."""
    found = {
        "paths": paths(), "vehicles": vehicles(), "schedules": schedules(),
        "policies": _policies("policy"), "weight policies": _policies("weight policy"),
        "conditions": _conditions(), "results": _results(), "jobs": _jobs(),
    }  # fmt: skip
    try:
        found["bags"] = _bags()
    except ModuleNotFoundError as error:
        say(f"without bags: {error}")
    return found


# Tries --------------------------------------------------------------------------------------------


def write_seed(seed: Folder, folder: Path) -> None:
    """Write the files of a seed."""
    for name, content in seed.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def put(reader: Reader, folder: Path, rng: Rng) -> str:
    """Fill a folder with a mutated seed; return which file was mutated and how."""
    seed = reader.seeds[int(rng.integers(len(reader.seeds)))]
    other = reader.seeds[int(rng.integers(len(reader.seeds)))]
    write_seed(seed, folder)
    names = sorted(seed)
    name = names[int(rng.integers(len(names)))]
    if rng.random() < SPECIAL:
        return f"{name} {special(folder / name, rng)}"
    if reader.repair is not None and rng.random() < 0.5:
        reader.repair(folder, rng)
        return "edited with its digest"
    content, done = seed[name], []
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        mutations = reader.mutations[name]
        mutation = mutations[int(rng.integers(len(mutations)))]
        content = mutation(content, other.get(name, content), rng)[: 2**23]
        done.append(mutation.__name__)
    (folder / name).write_bytes(content)
    return f"{name} {'+'.join(done)}"


def verdict(reader: Reader, folder: Path) -> tuple[str, str]:
    """Read a folder: ("read" or "refused", ""), or ("broke", reason)."""
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            reader.read(folder)
    except ValueError as error:
        text = str(error)
        if len(text) <= LONGEST_MESSAGE and len(text.splitlines()) == 1:
            return "refused", ""
        return "broke", f"message of {len(text)} characters: {text[:100]!r}"
    except BaseException as error:  # noqa: BLE001  every other error is a fault
        return "broke", f"{type(error).__name__}: {str(error)[:150]!r}"
    return "read", ""


def _serve(found: dict[str, Reader], pipe: Connection) -> None:
    """Answer (name, folder) with a verdict until the pipe closes."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    with contextlib.suppress(EOFError):
        while True:
            name, folder = pipe.recv()
            pipe.send(verdict(found[name], folder))


class Worker:
    """A process that reads; it is replaced after one that hangs or dies."""

    def __init__(self, found: dict[str, Reader]) -> None:
        self.found = found
        self._start()

    def _start(self) -> None:
        context = mp.get_context("fork")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(self.found, theirs), daemon=True)
        self.process.start()
        theirs.close()

    def ask(self, name: str, folder: Path) -> tuple[str, str]:
        """Return the verdict on a folder, also if the process hangs or dies of it."""
        self.pipe.send((name, folder))
        seconds = self.found[name].seconds
        try:
            if self.pipe.poll(seconds):
                kind, reason = self.pipe.recv()
                return kind, reason
            answer = "broke", f"not read within {seconds:g} s"
        except (EOFError, ConnectionError):
            answer = "broke", "the process died"
        self.close()
        self._start()
        return answer

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()


def chosen(found: dict[str, Reader], rng: Rng) -> str:
    """Draw a reader by its share."""
    shares = np.array([reader.share for reader in found.values()], float)
    return list(found)[int(rng.choice(len(shares), p=shares / shares.sum()))]


def run(count: int, seed: int, say: Say) -> Counts:
    """Read `count` mutated files, then as many that coverage has guided."""
    found, seen, faults = readers(say), Counter[str](), list[str]()
    worker = Worker(found)
    try:
        for name, reader in found.items():
            for k, files in enumerate(reader.seeds):
                with tempfile.TemporaryDirectory() as folder:
                    write_seed(files, Path(folder))
                    if (answer := worker.ask(name, Path(folder)))[0] != "read":
                        faults.append(f"{name}: seed file {k} is not read: {answer}")
        for number in range(count):
            rng = np.random.default_rng((seed, number))
            name = chosen(found, rng)
            with tempfile.TemporaryDirectory() as folder:
                how = put(found[name], Path(folder), rng)
                kind, reason = worker.ask(name, Path(folder))
            seen[f"{name} {kind}"] += 1
            if kind == "broke":
                faults.append(f"{name} --seed {seed} try {number} ({how}): {reason}")
                say(faults[-1])
            if number % 1000 == 999:
                say(f"{number + 1:,} files, {len(faults)} broke")
    finally:
        worker.close()
    guided = guided_files.run(count, seed, say)
    return Counts(count + guided.tried, faults + guided.faults, dict(seen) | guided.seen)


def main() -> None:
    """Repeat one try in this process, and keep its folder."""
    seed, number = map(int, sys.argv[1:])
    found = readers(print)
    rng = np.random.default_rng((seed, number))
    name = chosen(found, rng)
    folder = Path(tempfile.gettempdir()) / f"hostile-files-{seed}-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    print(name, put(found[name], folder, rng), folder, flush=True)
    found[name].read(folder)


if __name__ == "__main__":
    main()
