"""Options that several commands have, and who works: this process, others, other machines."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from drake_pose.commands.terminal import UsageError, warn
from drake_pose.files.options import within

if TYPE_CHECKING:
    from distributed import Client

SPREAD = Parameter("*")
"""The fields of a settings class are options."""

Model = Annotated[
    Path, Parameter(["--model", "-m"], help="The body: URDF, SDFormat, MJCF or .dmd.yaml.")
]
Out = Annotated[Path, Parameter(["--out", "-o"], help="Folder for the result; new or empty.")]
Pictures = Annotated[
    Path | None, Parameter(["--out", "-o"], help="Folder for pictures. Default: none are written.")
]
Resume = Annotated[bool, Parameter(help="Continue an interrupted result in --out.")]
Replay = Annotated[bool, Parameter(negative="--no-replay", help="Write replay.html.")]
Overlay = Annotated[
    bool, Parameter(negative="--no-overlay", help="Write overlay/<camera>/<frame>.png.")
]
Browser = Annotated[bool, Parameter(negative="--no-browser", help="Open the page in the browser.")]
Json = Annotated[bool, Parameter(help="Print the result as JSON.")]
Truth = Annotated[
    Path | None,
    Parameter(
        help="Measured joint positions [rad or m] to compare with: a CSV file with the column "
        "frame and one for each joint. Default: SCENE/joint_angles.csv, if it exists."
    ),
]
Seed = Annotated[int, within(0), Parameter(help="Seed of the random numbers.")]
Scheduler = Annotated[
    str | None,
    Parameter(
        metavar="ADDRESS",
        help="Address of a Dask scheduler whose workers are used instead, like "
        "tcp://10.0.0.7:8786.",
    ),
]


@contextmanager
def workers_of(
    workers: int | None, scheduler: str | None, shared: Path | None = None
) -> Iterator[Client | None]:
    """The workers that were asked for; None: this process works.

    Args:
        workers: how many on this machine; None: one for each core, or none without the extra.
        scheduler: address of a scheduler instead.
        shared: a folder that a scheduler's workers must see; None: none.

    Raises:
        UsageError: both were asked for.
        ClusterError: they cannot be had, or are not fit.
    """
    if workers and scheduler is not None:
        raise UsageError("give --workers or --scheduler, not both")
    if workers == 0 and scheduler is None:
        yield None
        return
    from drake_pose.jobs.cluster.scheduler import has_dask, open_cluster, require_fit_workers

    if workers is None and scheduler is None and not has_dask():
        warn('this process does all the work; for one a core: pip install "drake_pose[cluster]"')
        yield None
        return
    with open_cluster(workers, scheduler) as client:
        if scheduler is not None:
            require_fit_workers(client, shared)
        yield client
