"""What `drake-pose batch` shows."""

from __future__ import annotations

from collections.abc import Mapping

from rich.markup import escape
from rich.table import Table

from drake_pose.commands.report import output_console, progress_bar
from drake_pose.commands.terminal import warn
from drake_pose.jobs.batch.state import FINISHED, BatchResult, SceneState
from drake_pose.results.texts import percent

# Of what contradicts in a scene as many are shown.
_NAMED = 4


class BatchProgress:
    """A progress bar over the frames of all scenes that also says what went wrong."""

    def __init__(self) -> None:
        self._progress = progress_bar()
        self._task = self._progress.add_task("reading", total=None)

    def __enter__(self) -> BatchProgress:
        """Show the bar."""
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the bar away."""
        self._progress.stop()

    def __call__(self, done: int, total: int, message: str) -> None:
        """Show how far it is."""
        self._progress.update(self._task, description="frames", completed=done, total=total)
        if message:
            warn(message)


def print_batch(result: BatchResult) -> None:
    """Prints a row a scene, and where the results are."""
    estimates = {n: one for n, one in result.scenes.items() if one.job.audit is None}
    audits = {n: one for n, one in result.scenes.items() if one.job.audit is not None}
    console = output_console()
    if estimates:
        table = Table(
            "scene", "state", "found", "E_total", "chunks", "tries", "seconds", title="Batch"
        )
        for name, state in estimates.items():
            table.add_row(escape(name), *_cells(state))
        console.print(table)
    if audits:
        console.print(_audits_table(audits))
    frames = sum(state.frames_done for state in result.scenes.values())
    console.print(f"frames         {frames} in {result.seconds:.1f} s")
    console.print(f"results        {escape(str(result.out))}", soft_wrap=True)


def _audits_table(audits: Mapping[str, SceneState]) -> Table:
    """A row an audited scene; texts stand in contradictions.csv."""
    table = Table("scene", "state", "agree", "contradicts the rest", "seconds", title="Audits")
    for name, state in audits.items():
        named = [f"{one['what']} {one['name']}" for one in state.totals.get("contradictions", ())]
        more = [f"and {len(named) - _NAMED} more"] if len(named) > _NAMED else []
        agree = ""
        if state.state == FINISHED:
            agree = f"{state.totals['agreeing_count']} of {state.frame_count}"
        text = escape(", ".join([*named[:_NAMED], *more]))
        table.add_row(escape(name), state.state, agree, text, f"{state.seconds:.1f}")
    return table


def _cells(state: SceneState) -> list[str]:
    """A row of the table; seconds are those of all workers."""
    found = ""
    if state.state == FINISHED:
        found = f"{state.totals.get('found_count')} of {state.frame_count}"
    return [
        state.state,
        found,
        percent(state.totals.get("mean_E_total")),
        f"{len(state.done)} of {len(state.tasks)}",
        str(state.attempts),
        f"{state.seconds:.1f}",
    ]
