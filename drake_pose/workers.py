"""Map functions over items in threads, with results that do not depend on the number of threads.

Threads suffice because compiled kernels and OpenCV release the GIL.
"""

import gc
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_CHOSEN: ContextVar[int | None] = ContextVar("workers", default=None)


@contextmanager
def use_workers(workers: int | None) -> Iterator[None]:
    """Set the number of worker threads inside a ``with`` block.

    Args:
        workers: number of threads; None: keep the current number, initially one per core.
    """
    token = _CHOSEN.set(workers or _CHOSEN.get())
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def map_ordered(
    function: Callable[[_Item], _Result], items: Iterable[_Item], workers: int | None = None
) -> list[_Result]:
    """Return the function's result for each item, in the order of the items.

    ``function``: the function, which several threads call at the same time. ``items``: its
    arguments. ``workers``: number of threads; None: as set by ``use_workers``. Nested calls, and
    calls in child processes of ``multiprocessing``, use a single thread.
    """
    listed = list(items)
    count = min(len(listed), workers or _CHOSEN.get() or _cores())
    if count < 2:
        return [function(one) for one in listed]
    # Drake's renderer aborts the process if a thread other than its own garbage-collects it.
    collects = gc.isenabled()
    gc.disable()
    try:
        with ThreadPoolExecutor(count, initializer=_CHOSEN.set, initargs=(1,)) as pool:
            return list(pool.map(function, listed))
    finally:
        if collects:
            gc.enable()


def _cores() -> int:
    """Return the number of cores available to this process; 1 in a child process."""
    if multiprocessing.parent_process() is not None:
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
