"""The command `drake-pose reproduce date`."""

from __future__ import annotations

from typing import Annotated, Literal

from drake_pose.commands.options import Json, Pictures, Seed, within
from drake_pose.commands.terminal import count_progress, output_console, print_json


def date(
    *,
    cameras: Annotated[int, within(3)] = 9,
    frames: Annotated[int, within(40)] = 240,
    seed: Seed = 0,
    method: Literal["silhouette", "paper"] = "silhouette",
    waist: Literal["reach", "person", "paper"] = "reach",
    search: Literal["surfaces", "rectangles"] = "surfaces",
    out: Pictures = None,
    json: Json = False,
) -> None:
    """Date, Yoshimatsu, Arita and Taniguchi: a moving person before many calibrated cameras.

    A simulated person walks, reaches, leans, crouches, turns and crosses the arms. Compared are the
    paper's inverse kinematics alone, the paper's search for elbows and knees, and one fit to all
    silhouettes at once. Times are those of one core, without rendering.

        drake-pose reproduce date --cameras 5 --frames 120 --out results/date

    Args:
        cameras: Number of cameras, including the one at the face; the paper has 9.
        frames: Number of frames; fewer than 120 do not show all motions.
        method: silhouette: the paper's method and a fit to all silhouettes; paper: the former.
        waist: The waist formula's constants. paper: 0.55, 0.225, 0.225; person: this person's;
            reach: as person, lowered until both feet are in the legs' reach.
        search: Of elbows and knees. rectangles: the paper's, on one circle; surfaces: points of
            the limbs' surfaces, on the circles of hands and feet up to 1.5 cm nearer or farther.
    """
    from drake_pose.papers.date.experiment import run_experiment
    from drake_pose.papers.date.pictures import save_pictures
    from drake_pose.results.folder import require_empty

    if out is not None:
        require_empty(out)
    with count_progress("frames", frames) as advance:
        result = run_experiment(cameras, frames, seed, method, advance, waist=waist, search=search)
    if out is not None:
        save_pictures(result, out)
    if json:
        print_json(result.as_json())
    else:
        output_console().print(result.table(), result.found_table(), result.costs())
