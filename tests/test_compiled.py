"""Kernels are compiled once for all processes, and again if anything they call changes."""

import ast
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


def test_unreadable_stored_kernels_are_recompiled(package: Path) -> None:
    """As if a type of a kernel's arguments had moved to another module."""
    run(package)
    for index in package.glob("__pycache__/*.nbi"):
        data = index.read_bytes()
        first = pickle.loads(data)
        rest = b"cdrake_pose.moved_away\nThing\n."
        index.write_bytes(pickle.dumps(first) + rest)
    values, _ = run(package)
    assert values == [14, 1]
    assert run(package)[0] == [14, 0]


def test_concurrent_processes_compile_once(package: Path) -> None:
    processes = [start(package) for _ in range(3)]
    outputs = [process.communicate(timeout=100)[0].split() for process in processes]
    assert sorted(outputs) == [["14", "0"], ["14", "0"], ["14", "1"]]


def close_folder(folder: Path) -> None:
    """Put a file in place of the cache folder, because for root no folder is read-only."""
    (folder / "__pycache__").write_text("")


def test_a_read_only_installation_uses_the_users_cache(package: Path, tmp_path: Path) -> None:
    close_folder(package)
    home = tmp_path / "home"
    places = {"HOME": str(home), "XDG_CACHE_HOME": str(home / ".cache")}
    values, log = run(package, **places)
    assert values == [14, 1]
    assert log.count(f"compiling kernels into {home / '.cache'}") == 1
    assert run(package, **places) == ([14, 0], "")


def test_without_a_writable_folder_kernels_still_run(package: Path, tmp_path: Path) -> None:
    close_folder(package)
    home = tmp_path / "home"
    home.write_text("")
    values, log = run(package, HOME=str(home), XDG_CACHE_HOME=str(home / ".cache"))
    assert values == [14, 1]
    assert log.count("set NUMBA_CACHE_DIR to a writable folder") == 1


def test_python_calls_kernels_with_all_arguments() -> None:
    """A call that leaves one out takes numba's slow path, which takes longer than the kernel."""
    trees = [ast.parse(file.read_text()) for file in (ROOT / "drake_pose").rglob("*.py")]
    functions = [
        (one, any(ast.unparse(place).startswith("compiled") for place in one.decorator_list))
        for tree in trees
        for one in ast.walk(tree)
        if isinstance(one, ast.FunctionDef)
    ]
    kernels = [one for one, is_kernel in functions if is_kernel and one.args.defaults]
    counts = {one.name: len(one.args.args) for one in kernels}
    short = []
    for function in (one for one, is_kernel in functions if not is_kernel):
        for call in ast.walk(function):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name):
                given = len(call.args) + len(call.keywords)
                is_whole = any(isinstance(one, ast.Starred) for one in call.args)
                if given < counts.get(call.func.id, 0) and not is_whole:
                    short.append(f"{function.name}: {call.func.id}")
    assert not short
