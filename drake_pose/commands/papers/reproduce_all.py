"""The command `drake-pose reproduce all`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from drake_pose.commands.terminal import errors_as_messages, say


def reproduce_all(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")],
    short: Annotated[
        bool, typer.Option("--short", help="A few images and runs only, to see that it works.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an interrupted result in --out.")
    ] = False,
) -> None:
    """See help_texts.REPRODUCE_ALL."""
    with errors_as_messages(out), ExitStack() as bars:
        from drake_pose.commands.report import count_progress
        from drake_pose.papers.all_experiments import reproduce_all as run
        from drake_pose.results.folder import require_empty

        if not resume:
            require_empty(out)

        def count(what: str, total: int) -> Callable[[int], None]:
            bars.close()
            return bars.enter_context(count_progress(what, total))

        page = run(out, short, count, lambda text: say(f"drake-pose: {text}"))
        bars.close()
        say(f"drake-pose: wrote {page}")
