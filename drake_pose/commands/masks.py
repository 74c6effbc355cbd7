"""The command `drake-pose masks`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.markup import escape

from drake_pose.commands.options import SPREAD, Json
from drake_pose.commands.terminal import count_progress, output_console, print_result
from drake_pose.jobs.masks.settings import MaskSettings

if TYPE_CHECKING:
    from drake_pose.jobs.masks.masks import SceneMasks


def masks(
    source: Path,
    /,
    *,
    out: Annotated[Path, Parameter(alias="-o", metavar="SCENE")],
    settings: Annotated[MaskSettings | None, SPREAD] = None,
    overlay: Annotated[bool, Parameter(negative="--no-overlay")] = True,
    json: Json = False,
) -> None:
    """Make a scene of masks: of masks that other tools wrote, or of pictures.

    Masks of other tools are COCO files, PNG pictures with a palette, with an alpha channel or with
    probabilities, and black and white videos. In pictures and videos an object is found by the
    empty room (--background), a box (--box), a network of yours (--network), or the object's own
    model (--model with --start): pose and mask are found in turn. A median of the pictures stands
    for the empty room only where the body leaves every place; the command says where it does not.

    Files in SCENE: masks/; cameras.yaml and scene.yaml; overlay/, the pictures with the masks'
    outlines: look at them; summary.json, each mask's area, refusal and warnings.

    A photograph, the object in a box:

        drake-pose masks photograph.jpg --out scene --box 120,80,300,260

    Args:
        source: Folder with images/<camera>/<frame>.png or .jpg, or videos/<camera>.mp4, or pictures
            of a single camera; a picture, a video; a COCO file (.json).
        out: Folder for the scene; new or empty.
        overlay: Write the pictures with the masks' outlines, overlay/<camera>/<frame>.jpg.
    """
    from drake_pose.jobs.masks.masks import make_masks

    with count_progress("masks", None) as advance:
        result = make_masks(source, out, settings, overlay=overlay, on_mask=advance)
    print_result(result, json, _print)


def _print(result: SceneMasks) -> None:
    """How many masks each camera has, then where they are."""
    console = output_console()
    for name, frames in result.summary["cameras"].items():
        good = [one["area"] for one in frames.values() if "area" in one]
        text = f"{len(good)} masks of {len(frames)} pictures"
        text += f", {min(good)} to {max(good)} pixels" if good else ""
        console.print(f"{escape(name or 'camera'):<14} {text}")
    console.print(f"scene          {escape(str(result.folder))}", soft_wrap=True)
