"""The cache of machine code: whatever is wrong with a file, the function is compiled anew."""

import os
import pickle
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numba
import pytest
from numba.core.caching import FunctionCache, IndexDataCacheFile

from trajectories import disk_cache
from trajectories.compilation import compiled

DISTURBED = "compiled code on disk not used"


@pytest.fixture
def start(tmp_path: Path) -> Callable[..., tuple[str, str]]:
    """A process that calls compiled functions and says which were on disk."""
    (tmp_path / "model.py").write_text(
        "from trajectories.compilation import compiled\n"
        + "".join(f"@compiled\ndef f{k}(x):\n    return {k} * x\n" for k in range(len(DAMAGE)))
    )
    code = (
        "import model\n"
        f"for f in [getattr(model, f'f{{k}}') for k in range({len(DAMAGE)})]:\n"
        "    print(f(0.5), sum(f.stats.cache_hits.values()))\n"
    )
    environment = {
        **os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]),
    }  # fmt: skip

    def started(before: str = "") -> tuple[str, str]:
        done = subprocess.run(
            [sys.executable, "-c", before + code], cwd=tmp_path, env=environment,
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout, done.stderr

    return started


def printed(hits: int) -> str:
    return "".join(f"{0.5 * k} {hits}\n" for k in range(len(DAMAGE)))


def kept(folder: Path) -> list[Path]:
    return sorted(path for path in (folder / "cache").rglob("*") if path.is_file())


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


def replace_by_fifo(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def truncate(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "truncated": (truncate, "it is damaged"),
    "empty": (lambda file: file.write_bytes(b""), "it is damaged"),
    "garbled": (lambda file: file.write_bytes(bytes(range(256)) * 40), "it is damaged"),
    "one bit": (flip, "it is damaged"),
    "a pipe": (replace_by_fifo, "it is not a regular file"),
    "writable": (lambda file: file.chmod(0o666), "everybody may write to it"),
}


def cache_file(folder: Path, stamp: str = "stamp") -> disk_cache.CacheFile:
    return disk_cache.CacheFile(folder / "f.nbc", stamp, Path(__file__))


@pytest.mark.parametrize("kind", list(DAMAGE))
def test_a_file_that_cannot_be_used_is_replaced(kind: str, tmp_path: Path) -> None:
    file = cache_file(tmp_path)
    assert file.load("key") is None
    file.save("key", [1, 2])
    file.save("other", 3)
    assert (file.load("key"), file.load("other")) == ([1, 2], 3)
    damage, reason = DAMAGE[kind]
    damage(file.place)
    with pytest.raises(ValueError, match=reason):
        file.load("key")
    file.save("key", [4])
    assert (file.load("key"), file.load("other")) == ([4], None)
    assert list(tmp_path.iterdir()) == [file.place]
    assert cache_file(tmp_path, "of other sources").load("key") is None


def test_a_folder_in_its_place_is_left(tmp_path: Path) -> None:
    file = cache_file(tmp_path)
    (file.place / "of a user").mkdir(parents=True)
    with pytest.raises(IsADirectoryError):
        file.load("key")
    with pytest.raises(IsADirectoryError):
        file.save("key", 1)
    assert list(tmp_path.iterdir()) == [file.place]


def test_damage_costs_a_warning_and_heals(
    tmp_path: Path, start: Callable[..., tuple[str, str]]
) -> None:
    assert start()[0] == printed(hits=0)
    files = kept(tmp_path)
    for file, (damage, _) in zip(files, DAMAGE.values(), strict=True):
        damage(file)
    found, said = start()
    assert found == printed(hits=0)
    assert said.count(DISTURBED) == 1  # in the folder, not for each file
    assert f"{files[0]}: it is damaged; compiling anew" in said
    assert start() == (printed(hits=1), "")


def test_a_full_disk_costs_only_the_time_to_compile(
    tmp_path: Path, start: Callable[..., tuple[str, str]]
) -> None:
    """The limit on the size of files fails a write as a full disk does, in the middle of it."""
    limited = (
        "import resource, signal\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
    )
    found, said = start(limited)
    assert found == printed(hits=0)
    assert said.count(DISTURBED) == 1
    assert "File too large" in said
    assert kept(tmp_path) == []


def status(owner: int, mode: int) -> os.stat_result:
    return os.stat_result((stat.S_IFREG | mode, 0, 0, 1, owner, owner, 0, 0, 0, 0))


def test_files_of_others_are_not_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    source = status(1001, 0o644)
    for owner in (0, 1000, 1001):
        disk_cache.check_owner(status(owner, 0o664), source)
    with pytest.raises(ValueError, match="it belongs to another user, 1002"):
        disk_cache.check_owner(status(1002, 0o644), source)
    with pytest.raises(ValueError, match="everybody may write to it"):
        disk_cache.check_owner(status(1000, 0o646), source)
    # Whoever may change the source needs no cache to have code run.
    disk_cache.check_owner(status(1000, 0o666), status(1001, 0o666))


class Bomb:
    """Creates a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.file,)


def test_nothing_is_unpickled_without_its_checksum(tmp_path: Path) -> None:
    file, ran = cache_file(tmp_path), tmp_path / "ran"
    file.place.write_bytes(pickle.dumps(Bomb(ran)))
    with pytest.raises(ValueError, match="it is damaged"):
        file.load("key")
    file.save("key", 1)
    assert not ran.exists()


def test_new_files_are_not_writable_by_others(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        cache_file(tmp_path).save("key", 1)
    finally:
        os.umask(before)
    assert stat.S_IMODE(cache_file(tmp_path).place.stat().st_mode) == 0o644


@compiled
def twice(x: float) -> float:
    return 2.0 * x


def test_the_parts_of_numba_that_are_replaced_are_there() -> None:
    """Private parts of numba are used here: a release that changes them must be noticed."""
    assert isinstance(numba.njit(cache=True)(twice.py_func)._cache, FunctionCache)
    for name in ("load_overload", "save_overload", "_index_key"):
        assert callable(getattr(FunctionCache, name))
    for name in ("load", "save", "flush"):
        assert callable(getattr(IndexDataCacheFile, name))
        assert callable(getattr(disk_cache.CacheFile, name))
    assert isinstance(twice._cache, disk_cache.DiskCache)
    assert isinstance(twice._cache._cache_file, disk_cache.CacheFile)
    calls: list[str] = []

    class Spy:
        place = Path("spy")

        def load(self, *_: object) -> None:
            calls.append("load")

        def save(self, *_: object) -> None:
            calls.append("save")

    twice._cache._cache_file = Spy()
    assert twice(1.5) == 3.0
    assert calls == ["load", "save"]
