"""Kernels are compiled once for all processes, and again if anything they call changes."""

import os
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = """
    import logging, sys
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    from kernels import caller
    print(caller.kernel(3), sum(caller.kernel.stats.cache_misses.values()))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of two modules: kernel() in one calls constant() in the other."""
    folder = tmp_path / "with spaces ä" / "kernels"
    folder.mkdir(parents=True)
    (folder / "__init__.py").touch()
    write_callee(folder, 10, 1)
    (folder / "caller.py").write_text(
        "from drake_pose.compiled import compiled\n"
        "from kernels.callee import OFFSET, constant\n"
        "@compiled\ndef kernel(n):\n    return n + constant() + OFFSET\n"
    )
    return folder


def write_callee(folder: Path, constant: int, offset: int) -> None:
    text = f"@compiled\ndef constant():\n    return {constant}\nOFFSET = {offset}\n"
    (folder / "callee.py").write_text(f"from drake_pose.compiled import compiled\n{text}")


def start(package: Path, **variables: str) -> subprocess.Popen[str]:
    search_path = os.pathsep.join([str(ROOT), str(package.parent)])
    environment = {**os.environ, "PYTHONPATH": search_path, **variables}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-B", "-c", textwrap.dedent(PROGRAM)]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def run(package: Path, **variables: str) -> tuple[list[int], str]:
    """Return kernel(3) and the number of compilations, and the log."""
    process = start(package, **variables)
    out, log = process.communicate(timeout=100)
    assert process.returncode == 0, log
    return [int(word) for word in out.split()], log


def test_kernels_are_recompiled_only_when_a_dependency_changes(package: Path) -> None:
    values, log = run(package)
    assert values == [14, 1]
    assert log.count("compiling kernels: up to two minutes, once") == 1
    assert run(package) == ([14, 0], "")
    write_callee(package, 20, 1)
    assert run(package)[0] == [24, 1]
    write_callee(package, 20, 5)
    assert run(package)[0] == [28, 1]
    assert run(package) == ([28, 0], "")

    # As if a type of a kernel's arguments had moved to another module.
    for index in package.glob("__pycache__/*.nbi"):
        first = pickle.loads(index.read_bytes())
        index.write_bytes(pickle.dumps(first) + b"cdrake_pose.moved_away\nThing\n.")
    assert run(package)[0] == [28, 1]
    assert run(package)[0] == [28, 0]


def test_concurrent_processes_compile_once(package: Path) -> None:
    processes = [start(package) for _ in range(3)]
    outputs = [process.communicate(timeout=100)[0].split() for process in processes]
    assert sorted(outputs) == [["14", "0"], ["14", "0"], ["14", "1"]]


def test_a_read_only_installation_uses_the_users_cache_or_none(
    package: Path, tmp_path: Path
) -> None:
    # A file in place of the cache folder, because for root no folder is read-only.
    (package / "__pycache__").write_text("")
    home = tmp_path / "home"
    places = {"HOME": str(home), "XDG_CACHE_HOME": str(home / ".cache")}
    values, log = run(package, **places)
    assert values == [14, 1]
    assert log.count(f"compiling kernels into {home / '.cache'}") == 1
    assert run(package, **places) == ([14, 0], "")
    (tmp_path / "file").write_text("")
    values, log = run(package, HOME=str(tmp_path / "file"), XDG_CACHE_HOME=str(tmp_path / "file"))
    assert values == [14, 1]
    assert log.count("set NUMBA_CACHE_DIR to a writable folder") == 1
