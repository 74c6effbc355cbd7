"""The options that say who works: this process, others on this machine, or other machines."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from distributed import Client

_PANEL = "Workers"

WorkersOption = Annotated[
    int | None,
    typer.Option(
        min=0,
        metavar="N",
        help="Number of worker processes on this machine; 0: none, this process does the work. "
        "Default: one for each core.",
        rich_help_panel=_PANEL,
    ),
]
WatchersOption = Annotated[
    int,
    typer.Option(
        "--workers",
        min=0,
        metavar="N",
        help="Number of worker processes on this machine that process the pictures of a "
        "sources.yaml, each those of its own cameras; 0: none, this process does it.",
        rich_help_panel=_PANEL,
    ),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address of a Dask scheduler whose workers are used instead, like "
        "tcp://10.0.0.7:8786.",
        rich_help_panel=_PANEL,
    ),
]


@contextmanager
def workers_of(
    workers: int | None, scheduler: str | None, shared: Path | None = None
) -> Iterator[Client | None]:
    """The workers that were asked for; None: this process works.

    Args:
        workers: how many on this machine; None: one for each core.
        scheduler: address of a scheduler instead.
        shared: a folder that a scheduler's workers must see; None: none.

    Raises:
        ClusterError: they cannot be had, or are not fit.
    """
    if workers == 0 and scheduler is None:
        yield None
        return
    from drake_pose.jobs.cluster.scheduler import open_cluster, require_fit_workers

    with open_cluster(workers, scheduler) as client:
        if scheduler is not None:
            require_fit_workers(client, shared)
        yield client
