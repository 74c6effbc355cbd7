"""The command `drake-pose reproduce all`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

from drake_pose.commands.options import Out, Resume
from drake_pose.commands.terminal import count_progress, say


def reproduce_all(*, out: Out, short: bool = False, resume: Resume = False) -> None:
    """Run the experiments of the three papers, and make one page about them, report.html.

    An experiment that is finished is kept: after Ctrl-C, --resume goes on with the others.

        drake-pose reproduce all --out results/papers

    Args:
        short: A few images and runs only, to see that it works.
    """
    from drake_pose.papers.all_experiments import reproduce_all as run
    from drake_pose.results.folder import require_empty

    if not resume:
        require_empty(out)
    with ExitStack() as bars:

        def count(what: str, total: int) -> Callable[[int], None]:
            bars.close()
            return bars.enter_context(count_progress(what, total))

        page = run(out, short, count, lambda text: say(f"drake-pose: {text}"))
    say(f"drake-pose: wrote {page}")
