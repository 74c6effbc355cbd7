"""The command `drake-pose reproduce date`."""

from __future__ import annotations

from typing import Annotated

import typer

from drake_pose.commands.estimate_options import JsonOption, PicturesOption
from drake_pose.commands.terminal import errors_as_messages, print_json


def date(
    cameras: Annotated[
        int,
        typer.Option(
            min=3, help="Number of cameras, including the one at the face; the paper has 9."
        ),
    ] = 9,
    frames: Annotated[
        int, typer.Option(min=40, help="Number of frames; fewer than 120 do not show all motions.")
    ] = 240,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random motions.")] = 0,
    method: Annotated[
        str,
        typer.Option(
            help="silhouette: the paper's method and a fit to all silhouettes; paper: the former."
        ),
    ] = "silhouette",
    waist: Annotated[
        str,
        typer.Option(
            help="The waist formula's constants. paper: 0.55, 0.225, 0.225; person: this person's; "
            "reach: as person, lowered until both feet are in the legs' reach."
        ),
    ] = "reach",
    search: Annotated[
        str,
        typer.Option(
            help="Of elbows and knees. rectangles: the paper's, on one circle; surfaces: points of "
            "the limbs' surfaces, on the circles of hands and feet up to 1.5 cm nearer or farther."
        ),
    ] = "surfaces",
    out: PicturesOption = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.DATE."""
    with errors_as_messages():
        from drake_pose.commands.report import count_progress, output_console
        from drake_pose.papers.date.experiment import run_experiment
        from drake_pose.papers.date.pictures import save_pictures
        from drake_pose.results.folder import require_empty

        if out is not None:
            require_empty(out)
        with count_progress("frames", frames) as advance:
            result = run_experiment(
                cameras, frames, seed, method, advance, waist=waist, search=search
            )
        if out is not None:
            save_pictures(result, out)
        if json:
            print_json(result.as_json())
        else:
            output_console().print(result.table(), result.found_table(), result.costs())
