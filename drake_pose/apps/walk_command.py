"""The command `drake-pose walk`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drake_pose.apps.estimate_options import JsonOption
from drake_pose.apps.terminal import errors_as_messages, print_json, say, warn


def walk(
    result: Annotated[
        Path | None, typer.Argument(help="Result folder of capture, to be played; else the keys.")
    ] = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Play a simulated person's motion.")
    ] = False,
    model: Annotated[
        Path | None, typer.Option(help="The model of the result, where it is not a bundled one.")
    ] = None,
    rate: Annotated[float, typer.Option(help="The result's frames a second.")] = 30.0,
    seconds: Annotated[
        float | None, typer.Option(help="End after so many seconds of the walk.")
    ] = None,
    speed: Annotated[
        float, typer.Option(help="Seconds walked a second; 0: as fast as can be.")
    ] = 1.0,
    port: Annotated[
        int | None, typer.Option(help="Where the page listens; a free port if not given.")
    ] = None,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
    ] = True,
    json: JsonOption = False,
) -> None:
    """See help_texts.WALK."""
    if simulate and result is not None:
        raise typer.BadParameter("give a result or --simulate, not both")
    with errors_as_messages():
        from drake_pose.apps import walk as walking

        if result is not None:
            player = walking.recorded_player(result, model, rate)
        elif simulate:
            player = walking.simulated_player()
        else:
            player = walking.key_player()
        page = walking.open_page(port)
        say(f"drake-pose: {page.web_url()} - arrow keys walk and turn, Ctrl-C ends")
        if browser and not walking.show(page):
            warn("no browser has opened the page yet")
        walked = walking.walk(
            player, page, seconds, speed, lambda words: say(f"drake-pose: {words or 'stand'}")
        )
        if json:
            print_json(walked)
        else:
            say(f"drake-pose: {walking.summary_line(walked)}")
