"""How the kernels are compiled: by numba, on their first call, once for all processes.

A compiled kernel is stored beside its source or, where that folder cannot be written, in the user's
cache folder (``NUMBA_CACHE_DIR`` names another). Three things are added to numba's own storing:

- Processes that need the same kernel at the same time compile it once: the first holds a lock on a
  file, the others wait and load what it has stored.
- A stored kernel is used only while the functions and numbers that it takes from other modules are
  what they were; numba itself looks at the kernel's own file alone, and would go on with the old
  ones after an upgrade.
- Where kernels are compiled, and where they are stored, is logged (``drake_pose.compiled``).
"""

import functools
import hashlib
import logging
import os
import pickle
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
from numba import njit, types
from numba.core.caching import FunctionCache, NullCache
from numba.core.dispatcher import Dispatcher

try:
    import fcntl
except ImportError:  # Not on Windows: there each process compiles for itself.
    fcntl = None  # type: ignore[assignment]

_LOGGER = logging.getLogger(__name__)
_Function = TypeVar("_Function", bound=Callable[..., Any])


@overload
def compiled(function: _Function) -> _Function: ...


@overload
def compiled(**options: Any) -> Callable[[_Function], _Function]: ...


def compiled(function: Any = None, **options: Any) -> Any:
    """Decorates a kernel: ``numba.njit`` that holds no GIL, divides as numpy does, and is stored.

    Args:
        function: the kernel, where the decorator stands without brackets.
        options: of ``numba.njit``, instead of or beside these.
    """
    if function is None:
        return functools.partial(compiled, **options)
    kernel = njit(**{"nogil": True, "error_model": "numpy", **options})(function)
    if isinstance(kernel, Dispatcher):  # It is not with NUMBA_DISABLE_JIT.
        cache: _NoCache | _SharedCache = _NoCache()
        with suppress(RuntimeError):  # numba's way to say that no folder can be written.
            cache = _SharedCache(kernel.py_func)
        setattr(kernel, "_cache", cache)  # noqa: B010 - numba's type hints do not know it.
        plain = _without_literals(kernel.get_call_template)
        setattr(kernel, "get_call_template", plain)  # noqa: B010 - as above.
    return kernel


def _without_literals(find_template: Callable[..., Any]) -> Callable[..., Any]:
    """Lets kernels call a kernel as one of plain numbers: else it is compiled for each literal."""

    def find(args: Any, kws: Any) -> Any:
        plain = {name: types.unliteral(kind) for name, kind in kws.items()}
        return find_template(tuple(types.unliteral(kind) for kind in args), plain)

    return find


class _SharedCache(FunctionCache):
    """numba's store of one kernel, shared by processes and bound to what the kernel calls."""

    def __init__(self, py_func: Callable[..., Any]) -> None:
        super().__init__(py_func)
        self._held: int | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Returns the stored kernel, or None: the caller compiles it then, and saves it."""
        found = self._load(sig, target_context)
        if found is not None or self._held is not None:
            return found
        self._held = _lock_file(Path(self.cache_path) / f"{self._impl.filename_base}.lock")
        found = self._load(sig, target_context)
        if found is not None:
            self._release()
        else:
            source = Path(self._py_func.__code__.co_filename)
            _announce(Path(self.cache_path), source.parent / "__pycache__")
        return found

    def _load(self, sig: Any, target_context: Any) -> Any:
        """The stored kernel, or None; what cannot be read any more is thrown away."""
        try:
            return super().load_overload(sig, target_context)
        # It names the modules of its arguments' types, which may have moved since.
        except (ImportError, AttributeError, EOFError, pickle.UnpicklingError):
            self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Stores a kernel that was compiled."""
        try:
            super().save_overload(sig, data)
        finally:
            self._release()

    def _release(self) -> None:
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), _digest_of_others(self._py_func))


def _lock_file(path: Path, longest_wait: float = 300.0) -> int | None:
    """Returns a descriptor that holds a lock until it is closed; None where there are no locks.

    A process that is stopped while it compiles stops the others for no longer than this time [s].
    """
    if fcntl is None:
        return None
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
    except OSError:
        return None
    end = time.monotonic() + longest_wait
    while time.monotonic() < end:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return descriptor
        except BlockingIOError:
            time.sleep(0.02)
        except OSError:
            break
    os.close(descriptor)
    return None


class _NoCache(NullCache):
    """Stands in where no folder can be written: every process compiles for itself."""

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """Returns None: nothing is stored."""
        _announce(None, None)


@functools.cache
def _announce(folder: Path | None, beside: Path | None) -> None:
    """Says once where this process stores what it compiles."""
    if folder is None:
        _LOGGER.warning(
            "compiling kernels, which takes up to two minutes; they cannot be stored, so every run "
            "does it again: name a folder that can be written in NUMBA_CACHE_DIR"
        )
    elif folder == beside:
        _LOGGER.info("compiling kernels: up to two minutes, once")
    else:
        _LOGGER.warning("compiling kernels into %s: up to two minutes, once", folder)


def _digest_of_others(function: Callable[..., Any]) -> str:
    """A digest of what a kernel takes from elsewhere: other files' kernels, and plain constants."""
    own = function.__code__.co_filename
    digest = hashlib.sha256()
    for name, value in sorted(set(_taken(function, set()))):
        if value != own:
            digest.update(f"{name}={file_digest(value) if name == 'file' else value}\n".encode())
    return digest.hexdigest()


def _taken(function: Callable[..., Any], seen: set[int]) -> Iterator[tuple[str, str]]:
    """Files of the kernels below a kernel, as ("file", path), and constants as (name, value)."""
    if id(function) in seen:
        return
    seen.add(id(function))
    yield "file", function.__code__.co_filename
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher):
            yield from _taken(value.py_func, seen)
        elif isinstance(value, (bool, int, float, str, tuple, type(None))):
            yield name, repr(value)
        elif isinstance(value, (np.ndarray, np.generic)):
            yield name, hashlib.sha256(value.tobytes()).hexdigest()


@functools.cache
def file_digest(path: str) -> str:
    """SHA-256 of a source file, as it was when this process first asked."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@compiled
def copy_into(target: np.ndarray, source: np.ndarray) -> None:
    """Writes an array into the beginning of another of as many dimensions.

    In a kernel ``target[:n] = source`` makes numba compile 38 functions, for a message that says
    which shapes differ.
    """
    for index in np.ndindex(source.shape):
        target[index] = source[index]


@compiled
def grow_rows(array: np.ndarray, used: int, rows: int) -> np.ndarray:
    """Returns an array of this many rows that begins with the first rows in use of another."""
    wider = np.empty((rows, *array.shape[1:]), dtype=array.dtype)
    copy_into(wider, array[:used])
    return wider


@compiled
def multiply(X_AB: np.ndarray, X_BC: np.ndarray, X_AC: np.ndarray) -> None:
    """Writes the upper three rows of the product of two transforms (3 or 4, 4) into a third."""
    for i in range(3):
        for j in range(4):
            total = X_AB[i, 0] * X_BC[0, j] + X_AB[i, 1] * X_BC[1, j] + X_AB[i, 2] * X_BC[2, j]
            X_AC[i, j] = total + (X_AB[i, 3] if j == 3 else 0.0)


def kernel_folder() -> Path | None:
    """The folder where this package's kernels are stored; None where none can be written."""
    cache = getattr(copy_into, "_cache", None)
    return Path(cache.cache_path) if isinstance(cache, _SharedCache) else None


def is_stored(kernel: Callable[..., Any]) -> bool:
    """Whether a kernel was compiled before, for whatever arguments, and is stored."""
    cache = getattr(kernel, "_cache", None)
    if not isinstance(cache, _SharedCache):
        return False
    return (Path(cache.cache_path) / f"{cache._impl.filename_base}.nbi").is_file()
