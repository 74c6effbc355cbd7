"""Maps over threads: order, nesting, errors and garbage collection."""

import gc
import threading

import pytest

from drake_pose.workers import map_ordered, use_workers


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_results_have_the_order_of_the_items(workers: int) -> None:
    assert map_ordered(lambda k: k * k, range(20), workers) == [k * k for k in range(20)]


def test_nested_maps_use_a_single_thread() -> None:
    together = threading.Barrier(3, timeout=10.0)

    def names(_: int) -> set[str]:
        together.wait()
        return set(map_ordered(lambda _: threading.current_thread().name, range(4)))

    with use_workers(3):
        found = map_ordered(names, range(3))
    assert [len(one) for one in found] == [1, 1, 1]
    assert len(set.union(*found)) == 3


def test_none_keeps_the_number_of_workers() -> None:
    with use_workers(1), use_workers(None):
        names = set(map_ordered(lambda _: threading.current_thread().name, range(4)))
    assert names == {threading.current_thread().name}


def test_garbage_collection_is_paused_in_threads() -> None:
    """Cyclic garbage, such as Drake's renderers, is freed by the thread that made it."""
    assert map_ordered(lambda _: gc.isenabled(), range(3), 2) == [False] * 3
    assert gc.isenabled()
    with pytest.raises(ZeroDivisionError):
        map_ordered(lambda k: 1 // k, range(3), 2)
    assert gc.isenabled()
