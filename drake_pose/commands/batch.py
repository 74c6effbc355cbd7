"""The command `drake-pose batch`."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.markup import escape
from rich.table import Table

from drake_pose.commands.common import (
    Json,
    Out,
    Resume,
    UsageError,
    output_console,
    print_files,
    print_json,
    progress_bar,
    say,
    warn,
    within,
)
from drake_pose.errors import SceneError, listed
from drake_pose.files.settings import percent

if TYPE_CHECKING:
    from drake_pose.jobs.batch import Batch


def batch(
    jobs: Path,
    /,
    *,
    out: Out,
    workers: Annotated[int | None, within(0)] = None,
    scheduler: Annotated[str | None, Parameter(metavar="ADDRESS")] = None,
    chunk: Annotated[int | None, within(1), Parameter(metavar="FRAMES")] = None,
    resume: Resume = False,
    json: Json = False,
) -> None:
    """Estimate or audit many scenes in worker processes; long scenes are cut into chunks of frames.

    Each scene gets the result folder that estimate or audit would write. A scene that fails is
    named and does not stop the others. Ctrl-C keeps the finished chunks. The workers of a Dask
    scheduler must have the same version of drake_pose, and find scenes, models and the output
    folder at the same paths.

    The job file holds settings of estimate by their names in Python (EstimateSettings):

        chunk: 100
        defaults: {replay: false}
        scenes:
          monday: {scene: recordings/monday, model: arm.urdf, every: 2}
          walker: {scene: recordings/walker}
          robot: {scene: recordings/robot, model: arm.urdf, audit: recordings/robot/joints.csv}

    A scene with the key audit is audited; all errors are listed in findings.csv. Of episodes in one
    data set or folder the first is searched, and the others start at its cameras; episodes.csv and
    episodes.png tell which episodes share a camera's pose, and when a camera moved.

        drake-pose batch jobs.yaml --out results/all --workers 2

    Args:
        jobs: The job file (YAML).
        workers: Number of worker processes on this machine; 0: this process does the work. Default:
            one for each core, or 0 if the extra cluster is not installed.
        scheduler: Address of a Dask scheduler whose workers are used instead, such as
            tcp://10.0.0.7:8786.
        chunk: Number of frames in a chunk. Default: that of the job file.
    """
    from drake_pose.jobs.batch import run_batch
    from drake_pose.jobs.batch_tasks import read_job
    from drake_pose.jobs.cluster import has_dask, open_cluster, require_fit_workers

    read = read_job(jobs, chunk)
    if workers and scheduler is not None:
        raise UsageError("give --workers or --scheduler, not both")
    if workers is None and scheduler is None and not has_dask():
        warn('one process does all the work; to use all cores: pip install "drake_pose[cluster]"')
        workers = 0
    with ExitStack() as opened:
        client = None
        if workers != 0 or scheduler is not None:
            client = opened.enter_context(open_cluster(workers, scheduler))
        if client is not None and scheduler is not None:
            require_fit_workers(client, out.absolute().parent)
        bar = opened.enter_context(progress_bar())
        task = bar.add_task("reading", total=None)

        def show(done: int, total: int, message: str) -> None:
            bar.update(task, description="frames", completed=done, total=total)
            if message:
                warn(message)

        result = run_batch(read, out, client, resume, show)
    if json:
        print_json(result.as_json())
    else:
        _print_batch(result)
    for name in result.failed:
        for error in result.scenes[name].errors:
            say(f"drake-pose: error: scene '{name}': {error}")
    if result.failed:
        raise SceneError(f"{len(result.failed)} of {len(result.scenes)} scenes failed")


def _print_batch(result: Batch) -> None:
    """Print a row for each scene, with some errors of audited ones, and the folder."""
    estimates = Table("scene", "state", "found", "E_total", "chunks", "seconds", title="Batch")
    audits = Table("scene", "state", "consistent", "errors", "seconds", title="Audits")
    for name, state in result.scenes.items():
        totals, seconds = state.totals, f"{state.seconds:.1f}"
        count = "found_count" if state.job.audit is None else "agreeing_count"
        good = f"{totals.get(count)} of {state.frame_count}" if totals else ""
        row = (escape(name), state.state, good)
        if state.job.audit is None:
            chunks = f"{len(state.done)} of {len(state.tasks)}"
            estimates.add_row(*row, percent(totals.get("mean_E_total")), chunks, seconds)
        else:
            named = [f"{one['what']} {one['name']}" for one in totals.get("findings", ())]
            audits.add_row(*row, escape(listed(named)), seconds)
    console = output_console()
    for table in (estimates, audits):
        if table.row_count:
            console.print(table)
    for text in result.moves:
        console.print(escape(text), soft_wrap=True)
    frames = sum(state.frames_done for state in result.scenes.values())
    console.print(f"frames         {frames} in {result.seconds:.1f} s")
    print_files(("results", result.out))
