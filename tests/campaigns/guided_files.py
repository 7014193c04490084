"""Coverage-guided part of `hostile_files`, by atheris, in a child process.

The child runs libFuzzer over the readers of paths and JSON. It keeps its corpus in a temporary
folder and ends with the first input that breaks something.
"""

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.campaigns import Counts, Say

SECONDS = 20
"""Limit for an input."""
MEGABYTES = 3000
INSTRUMENTED = (
    "trajectories.fileio", "trajectories.text_table", "trajectories.columns", "trajectories.files",
    "trajectories.cleaning", "trajectories.importers", "trajectories.import_options",
    "trajectories.geodesy", "trajectories.path", "trajectories.catalog",
    "lpv_track_env.plausibility", "lpv_track_env.vehicle", "agents.weights",
)  # fmt: skip
"""Modules without compiled functions, whose bytecode may be changed."""


def run(count: int, seed: int, say: Say) -> Counts:
    """Try `count` inputs; without atheris, none."""
    if importlib.util.find_spec("atheris") is None:
        say("without the coverage-guided part: atheris is not installed (extra `fuzz`)")
        return Counts(0, [], {"guided": 0})
    with tempfile.TemporaryDirectory() as folder:
        corpus, found = Path(folder) / "corpus", Path(folder) / "found"
        corpus.mkdir()
        found.mkdir()
        _seed(corpus)
        ended = subprocess.run(
            [
                sys.executable, "-m", "tests.campaigns.guided_files", f"-runs={count}",
                f"-seed={seed + 1}", f"-timeout={SECONDS}", f"-rss_limit_mb={MEGABYTES}",
                "-max_len=4096", f"-artifact_prefix={found}/", "-verbosity=0", str(corpus),
            ],
            check=False, env={**os.environ, "TMPDIR": folder}, capture_output=True, text=True,
            errors="replace", timeout=20 * 3600,
        )  # fmt: skip
        faults = [
            f"guided {file.name.partition('-')[0]}: {file.read_bytes()[:200]!r}: "
            f"{_last_error(ended.stderr + ended.stdout)}"
            for file in sorted(found.iterdir())
        ]
        if ended.returncode != 0 and not faults:
            faults = [f"guided: ended with {ended.returncode}: {ended.stderr[-200:]!r}"]
        for fault in faults:
            say(fault)
        return Counts(count, faults, {"guided": count, "corpus": len(list(corpus.iterdir()))})


def _last_error(text: str) -> str:
    lines = [line for line in text.splitlines() if "Error" in line or "ERROR" in line]
    return lines[-1][:200] if lines else ""


def _seed(corpus: Path) -> None:
    """Write inputs to start from: the first byte chooses the reader."""
    from tests.campaigns.hostile_files import paths, schedules, vehicles

    for first, reader in enumerate((paths(), vehicles(), schedules())):
        for k, seed in enumerate(reader.seeds):
            content = next(iter(seed.values()))[:4000]
            (corpus / f"{first}-{k}").write_bytes(bytes([first]) + content)


def main() -> None:
    """Fuzz with the options of the command line."""
    import atheris

    with atheris.instrument_imports(include=list(INSTRUMENTED)):
        for name in INSTRUMENTED:
            importlib.import_module(name)
    from tests.campaigns.hostile_files import paths, schedules, vehicles, verdict

    readers = (paths(), vehicles(), schedules())
    folder = Path(tempfile.mkdtemp())  # in the parent's temporary folder

    def one(data: bytes) -> None:
        if not data:
            return
        reader = readers[data[0] % len(readers)]
        name = next(iter(reader.mutations))
        (folder / name).write_bytes(data[1:])
        kind, reason = verdict(reader, folder)
        if kind == "broke":
            raise RuntimeError(reason)

    atheris.Setup(sys.argv, one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
