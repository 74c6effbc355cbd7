"""The command `drake-pose batch`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_pose.commands.cluster_options import SchedulerOption, WorkersOption, workers_of
from drake_pose.commands.estimate_options import JsonOption
from drake_pose.commands.terminal import FAILED, errors_as_messages, print_json, say


def batch(
    jobs: Annotated[Path, typer.Argument(help="The job file (YAML): scenes, models, settings.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the results.")
    ],
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    chunk: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="FRAMES", help="Frames in a chunk. Default: that of the job file."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted batch in --out.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """See help_texts.BATCH."""
    if workers is not None and scheduler is not None:
        raise typer.BadParameter("give --workers or --scheduler, not both")
    with errors_as_messages(out):
        from drake_pose.commands.batch_report import BatchProgress, print_batch
        from drake_pose.jobs.batch.batch import run_batch
        from drake_pose.jobs.batch.job import read_job
        from drake_pose.jobs.batch.workers import ClusterPool

        read = read_job(jobs, chunk)
        with workers_of(workers, scheduler, out.absolute().parent) as client:
            pool = None if client is None else ClusterPool(client)
            with BatchProgress() as progress:
                result = run_batch(read, out, pool, resume, progress)
        if json:
            print_json(result.as_json())
        else:
            print_batch(result)
        for name in result.failed:
            for error in result.scenes[name].errors:
                say(f"drake-pose: error: scene '{name}': {error}")
        if result.failed:
            raise typer.Exit(FAILED)
