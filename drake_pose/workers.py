"""Work that is done side by side on the cores that there are, with the same result on any number.

Kernels and OpenCV hold no interpreter lock, so threads will do.
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
    """Has so many threads work meanwhile; None: as many as before, at first one for each core."""
    token = _CHOSEN.set(workers or _CHOSEN.get())
    try:
        yield
    finally:
        _CHOSEN.reset(token)


def map_ordered(
    function: Callable[[_Item], _Result], items: Iterable[_Item], workers: int | None = None
) -> list[_Result]:
    """What a function makes of each item, in the items' order.

    Args:
        workers: so many threads; None: as ``use_workers`` says. What a thread maps itself it does
            alone, as does a process that another one started beside others.
    """
    things = list(items)
    count = min(len(things), workers or _CHOSEN.get() or _cores())
    if count < 2:
        return [function(one) for one in things]
    # A renderer of Drake's aborts the process where another thread than its own collects it.
    collects = gc.isenabled()
    gc.disable()
    try:
        with ThreadPoolExecutor(count, initializer=_CHOSEN.set, initargs=(1,)) as pool:
            return list(pool.map(function, things))
    finally:
        if collects:
            gc.enable()


def _cores() -> int:
    """How many cores this process may use."""
    if multiprocessing.parent_process() is not None:
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
