"""Compile kernels with numba on their first call and store them for all processes.

A compiled kernel is stored beside its source or, where that folder is not writable, in the user's
cache folder (``NUMBA_CACHE_DIR`` overrides both). Three things are added to numba's own cache:

- A lock file: when several processes need the same kernel, one compiles and the others load it.
- The cache key includes the functions and constants that a kernel takes from other modules. numba
  checks the kernel's own file only and would load a stale kernel after an upgrade.
- The logger ``drake_pose.compiled`` reports when kernels are compiled and where they are stored.
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
except ImportError:  # Windows has no fcntl: each process compiles its own kernels.
    fcntl = None  # type: ignore[assignment]

_LOGGER = logging.getLogger(__name__)
_Function = TypeVar("_Function", bound=Callable[..., Any])


@overload
def compiled(function: _Function) -> _Function: ...


@overload
def compiled(**options: Any) -> Callable[[_Function], _Function]: ...


def compiled(function: Any = None, **options: Any) -> Any:
    """Decorate a kernel with ``numba.njit``, without the GIL, with numpy's division, and cached.

    ``function``: the kernel, if the decorator is used without parentheses; None: with them.
    ``options``: options of ``numba.njit``; they override the defaults. Returns the compiled kernel,
    or, with parentheses, a decorator.
    """
    if function is None:
        return functools.partial(compiled, **options)
    kernel = njit(**{"nogil": True, "error_model": "numpy", **options})(function)
    if isinstance(kernel, Dispatcher):  # False under NUMBA_DISABLE_JIT.
        cache: _NoCache | _SharedCache = _NoCache()
        with suppress(RuntimeError):  # Raised by numba if no folder is writable.
            cache = _SharedCache(kernel.py_func)
        setattr(kernel, "_cache", cache)  # noqa: B010 - numba's type hints do not know it.
        plain = _without_literals(kernel.get_call_template)
        setattr(kernel, "get_call_template", plain)  # noqa: B010 - as above.
    return kernel


def default_arguments(kernel: Callable[..., Any]) -> tuple[Any, ...]:
    """Return a kernel's default arguments, for Python code that calls the kernel with them.

    numba finds the compiled code of such a call in a microsecond, but in half a millisecond or more
    if an argument is left out. Kernels may leave arguments of other kernels out.
    """
    return getattr(kernel, "py_func", kernel).__defaults__ or ()


def _without_literals(find_template: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel's ``get_call_template`` without literal types, each of which is compiled."""

    def find(args: Any, kws: Any) -> Any:
        plain = {name: types.unliteral(kind) for name, kind in kws.items()}
        return find_template(tuple(types.unliteral(kind) for kind in args), plain)

    return find


class _SharedCache(FunctionCache):
    """Cache of one kernel, shared by processes and keyed by what the kernel calls."""

    def __init__(self, py_func: Callable[..., Any]) -> None:
        super().__init__(py_func)
        self._held: int | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the stored kernel of a signature, or None; numba then compiles and saves it.

        None is returned while holding the lock, which ``save_overload`` releases.

        Args:
            sig: types of the arguments.
            target_context: numba's target, which rebuilds the kernel.
        """
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
        """Return the stored kernel of a signature, or None; an unreadable cache is deleted."""
        try:
            return super().load_overload(sig, target_context)
        # A stored kernel refers to the modules of its argument types, which may have moved.
        except (ImportError, AttributeError, EOFError, pickle.UnpicklingError):
            self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the kernel compiled for a signature, numba's result ``data``; release the lock."""
        try:
            super().save_overload(sig, data)
        finally:
            self._release()

    def _release(self) -> None:
        if self._held is not None:
            os.close(self._held)
            self._held = None

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), _dependency_digest(self._py_func))


def _lock_file(path: Path, longest_wait: float = 300.0) -> int | None:
    """Return a file descriptor that holds a lock until closed; None if there is no lock.

    That is after the timeout, without fcntl, or if the file cannot be opened or locked.

    Args:
        path: the lock file.
        longest_wait: timeout [s], so that a stopped process cannot block the others for longer.
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
    """Cache used where no folder is writable: every process compiles its own kernels."""

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """Return None: nothing is stored."""
        _announce(None, None)


@functools.cache
def _announce(folder: Path | None, beside: Path | None) -> None:
    """Log, once per process and folder, that kernels are compiled, and where they are stored.

    Args:
        folder: folder of the stored kernels; None: they cannot be stored.
        beside: folder beside the source, where they are stored by default.
    """
    if folder is None:
        _LOGGER.warning(
            "compiling kernels takes up to two minutes in every run, because they cannot be "
            "stored: set NUMBA_CACHE_DIR to a writable folder"
        )
    elif folder == beside:
        _LOGGER.info("compiling kernels: up to two minutes, once")
    else:
        _LOGGER.warning("compiling kernels into %s: up to two minutes, once", folder)


def _dependency_digest(function: Callable[..., Any]) -> str:
    """Return a digest of a kernel's dependencies: other files' kernels, and plain constants."""
    own = function.__code__.co_filename
    digest = hashlib.sha256()
    for name, value in sorted(set(_dependencies(function, set()))):
        if value != own:
            digest.update(f"{name}={file_digest(value) if name == 'file' else value}\n".encode())
    return digest.hexdigest()


def _dependencies(function: Callable[..., Any], seen: set[int]) -> Iterator[tuple[str, str]]:
    """Yield a function's dependencies, and those of the kernels that it calls.

    They are ("file", path) of each function's source, and (name, text of the value, or digest of an
    array) of each constant. ``seen``: ids of functions that are done; changed.
    """
    if id(function) in seen:
        return
    seen.add(id(function))
    yield "file", function.__code__.co_filename
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if isinstance(value, Dispatcher):
            yield from _dependencies(value.py_func, seen)
        elif isinstance(value, (bool, int, float, str, tuple, type(None))):
            yield name, repr(value)
        elif isinstance(value, (np.ndarray, np.generic)):
            yield name, hashlib.sha256(value.tobytes()).hexdigest()


@functools.cache
def file_digest(path: str) -> str:
    """Return the SHA-256 of a source file, cached at its first use in this process."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@compiled
def copy_into(target: np.ndarray, source: np.ndarray) -> None:
    """Copy an array into the leading corner of another one with the same number of dimensions.

    It replaces ``target[:n] = source``, for which numba compiles 38 functions just to format the
    error message about mismatched shapes.
    """
    for index in np.ndindex(source.shape):
        target[index] = source[index]


@compiled
def grow_rows(array: np.ndarray, used: int, rows: int) -> np.ndarray:
    """Return a new array of ``rows`` rows: the first ``used`` ones of ``array``, then garbage."""
    grown = np.empty((rows, *array.shape[1:]), dtype=array.dtype)
    copy_into(grown, array[:used])
    return grown


@compiled
def multiply(X_AB: np.ndarray, X_BC: np.ndarray, X_AC: np.ndarray) -> None:
    """Write the upper three rows of X_AB X_BC into X_AC; all three are (3, 4) or (4, 4)."""
    for i in range(3):
        for j in range(4):
            total = X_AB[i, 0] * X_BC[0, j] + X_AB[i, 1] * X_BC[1, j] + X_AB[i, 2] * X_BC[2, j]
            X_AC[i, j] = total + (X_AB[i, 3] if j == 3 else 0.0)


def kernel_folder() -> Path | None:
    """Return the folder where kernels are stored, or None if no folder is writable."""
    cache = getattr(copy_into, "_cache", None)
    return Path(cache.cache_path) if isinstance(cache, _SharedCache) else None


def is_stored(kernel: Callable[..., Any]) -> bool:
    """Return whether a function decorated with ``compiled`` is stored, for any argument types."""
    cache = getattr(kernel, "_cache", None)
    if not isinstance(cache, _SharedCache):
        return False
    return (Path(cache.cache_path) / f"{cache._impl.filename_base}.nbi").is_file()
