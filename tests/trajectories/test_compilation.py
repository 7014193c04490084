"""Compiled functions: their results, and a cache that is never stale."""

import gc
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core import event
from numba.core.types.functions import BaseFunction

from trajectories import compilation
from trajectories.compilation import compiled, entry_point, source_digest


@pytest.fixture(autouse=True)
def _forget_digests() -> Iterator[None]:
    """Within a process a digest is taken once: sources do not change under a running program."""
    yield
    source_digest.cache_clear()


def fresh_digest(*folders: Path) -> str:
    source_digest.cache_clear()
    return source_digest(*folders)


def test_digest_changes_with_the_sources(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("X = 1\n")
    first = fresh_digest(tmp_path)
    assert fresh_digest(tmp_path) == first
    (tmp_path / "notes.txt").write_text("not a source")
    assert fresh_digest(tmp_path) == first
    digests = [first]
    (tmp_path / "a.py").write_text("X = 2\n")
    digests.append(fresh_digest(tmp_path))
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "b.py").write_text("Y = 1\n")
    digests.append(fresh_digest(tmp_path))
    (tmp_path / "sub" / "b.py").rename(tmp_path / "sub" / "c.py")
    digests.append(fresh_digest(tmp_path))
    (tmp_path / "sub" / "c.py").unlink()
    digests.append(fresh_digest(tmp_path))
    assert len(set(digests[:4])) == 4
    assert digests[4] == digests[1]


def test_digest_covers_every_folder(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.py").write_text("X = 1\n")
    first = fresh_digest(tmp_path / "one", tmp_path / "two")
    (tmp_path / "two" / "a.py").write_text("X = 2\n")
    assert fresh_digest(tmp_path / "one", tmp_path / "two") != first


def python_sum(x: float, y: float, z: float) -> float:
    return (x + y) + z


def python_quotient(x: float, y: float) -> float:
    return x / y


def python_is_nan(x: float) -> bool:
    return x != x  # noqa: PLR0124


compiled_sum, compiled_quotient = compiled(python_sum), compiled(python_quotient)
compiled_is_nan = compiled(python_is_nan)


def test_compiled_functions_keep_ieee_results() -> None:
    # With fastmath 1 would come out as 0, and a NaN unseen.
    assert compiled_sum(1e16, -1e16, 1.0) == python_sum(1e16, -1e16, 1.0) == 1.0
    assert compiled_sum(1.0, 1e16, -1e16) == python_sum(1.0, 1e16, -1e16) == 0.0
    assert compiled_is_nan(math.nan)
    rng = np.random.default_rng(0)
    for x, y, z in rng.uniform(-1e3, 1e3, (200, 3)).tolist():
        assert compiled_sum(x, y, z) == python_sum(x, y, z)
        assert compiled_quotient(x, y) == python_quotient(x, y)


def test_division_by_zero_gives_inf() -> None:
    assert compiled_quotient(1.0, 0.0) == math.inf
    assert compiled_quotient(-1.0, 0.0) == -math.inf
    assert math.isnan(compiled_quotient(0.0, 0.0))


@compiled
def first_of_sum(x: Any, y: Any) -> Any:
    return x[0] + y


def test_entry_point_is_the_compiled_function_for_these_types() -> None:
    """Each array layout has its own entry point: no dispatch tells layouts apart here."""
    row, column = np.arange(6.0), np.arange(6.0).reshape(3, 2)[1:, 1]
    for array, wanted in ((row, 2.5), (column, 5.5)):
        entry = entry_point(first_of_sum, array, 2.5)
        assert entry(array, 2.5) == first_of_sum(array, 2.5) == wanted
    assert entry_point(first_of_sum, row, 1.0) is entry_point(first_of_sum, row + 1.0, 0.0)
    assert entry_point(first_of_sum, row, 1.0) is not entry_point(first_of_sum, column, 1.0)
    assert entry_point(python_sum, 1.0, 2.0, 3.0) is python_sum


def test_internal_functions_can_be_called_from_python_too() -> None:
    internal = compilation.compiled_internal(python_sum)
    assert internal(1e16, -1e16, 1.0) == 1.0
    assert internal(1, 2, 3) == 6
    # For all integers that compiled code writes out there is one version.
    caller = numba.njit(lambda x: internal(x, 1, 2) + internal(x, 3, 4) + internal(x, 5, 6))
    assert caller(0.5) == 22.5
    assert len(internal.signatures) == 3  # type: ignore[attr-defined]


def test_what_shortens_compiling_is_undone_after_it() -> None:
    plain = BaseFunction.get_call_type
    seen = []

    @compiled
    def product(x: Any, y: Any) -> Any:
        return x * y

    class Spy(event.Listener):
        def on_start(self, _: event.Event) -> None:
            seen.append((BaseFunction.get_call_type is plain, gc.isenabled()))

        def on_end(self, _: event.Event) -> None:
            pass

    spy = Spy()
    event.register("numba:compile", spy)  # type: ignore[no-untyped-call]
    try:
        assert product(3.0, 0.5) == 1.5
        assert product(3, 5) == 15
        with pytest.raises(numba.TypingError):
            product("a", 1.5)
    finally:
        event.unregister("numba:compile", spy)  # type: ignore[no-untyped-call]
    assert seen[0] == (False, False)
    assert BaseFunction.get_call_type is plain
    assert gc.isenabled()


def run(code: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **environment}
    variables["PYTHONPATH"] = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=variables, capture_output=True, text=True,
        timeout=120, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return result


def test_cache_is_used_and_never_stale(tmp_path: Path) -> None:
    """A constant in an imported module changes: numba alone would use the cached old value."""
    (tmp_path / "constants.py").write_text("FACTOR = 2.0\n")
    (tmp_path / "model.py").write_text(
        "from constants import FACTOR\n"
        "from trajectories.compilation import compiled\n"
        "@compiled\n"
        "def inner(x):\n"
        "    return FACTOR * x\n"
        "@compiled\n"
        "def outer(x):\n"
        "    return inner(x) + 1.0\n"
    )
    code = "import model\nprint(model.outer(3.0), sum(model.outer.stats.cache_hits.values()))\n"
    environment = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    assert run(code, tmp_path, **environment).stdout.split() == ["7.0", "0"]
    assert run(code, tmp_path, **environment).stdout.split() == ["7.0", "1"]
    (tmp_path / "constants.py").write_text("FACTOR = 10.0\n")
    assert run(code, tmp_path, **environment).stdout.split() == ["31.0", "0"]
    assert run(code, tmp_path, **environment).stdout.split() == ["31.0", "1"]


def test_compiled_forms_of_one_function_have_code_of_their_own(tmp_path: Path) -> None:
    """Whatever the order in which processes compile them."""
    (tmp_path / "model.py").write_text(
        "from trajectories import compilation\n"
        "def double(x):\n"
        "    return 2.0 * x\n"
        "plain = compilation.compiled(double)\n"
        "listed = compilation.compiled_with_lists()(double)\n"
    )
    code = (
        "import sys, model\n"
        "one = getattr(model, sys.argv[1])\n"
        "print(one(1.5), sum(one.stats.cache_hits.values()))\n"
    )
    environment = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for hits in ("0", "1"):
        for form in ("plain", "listed"):
            chosen = f"import sys\nsys.argv = ['', {form!r}]\n{code}"
            assert run(chosen, tmp_path, **environment).stdout.split() == ["3.0", hits]


def test_function_that_numba_cannot_cache_warns_and_works() -> None:
    """Code without a file has no place for a cache: numba refuses it like an unwritable folder."""
    names: dict[str, Any] = {}
    exec("def triple(x):\n    return 3.0 * x\n", names)  # noqa: S102
    with pytest.warns(
        RuntimeWarning, match="numba finds no writable cache folder.*NUMBA_CACHE_DIR"
    ):
        triple = compiled(names["triple"])
    assert triple(2.0) == 6.0


@pytest.mark.skipif(
    not hasattr(numba.config, "CACHE_LOCATOR_CLASSES"), reason="this numba's locators are fixed"
)
def test_without_a_writable_cache_it_warns_and_works(tmp_path: Path) -> None:
    """Permissions do not stop root, so numba is left with one folder that cannot exist."""
    code = "import trajectories.table as p\nprint(*p.cell(2.5, 4.0, False, 5))\n"
    result = run(
        code, tmp_path, NUMBA_CACHE_LOCATOR_CLASSES="UserProvidedCacheLocator",
        NUMBA_CACHE_DIR="/dev/null/nowhere",
    )  # fmt: skip
    assert result.stdout.split() == ["2", "0.5"]
    assert "numba finds no writable cache folder" in result.stderr
