"""The command `drake-pose masks`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_pose.commands.estimate_options import HoldOption, JsonOption, PackageOption
from drake_pose.commands.terminal import (
    errors_as_messages,
    print_result,
    say,
    usage_errors,
)
from drake_pose.results.options import (
    parse_assignments,
    parse_numbers,
    parse_packages,
    parse_size,
)

if TYPE_CHECKING:
    from drake_pose.jobs.masks.masks import SceneMasks
    from drake_pose.jobs.masks.settings import MaskSettings

_GIVEN = "Masks of other tools"
_EMPTY = "By the empty room"
_MARKED = "By a box or strokes"
_MODEL = "By the object's model"
_NETWORK = "By a network"

SourceArgument = Annotated[
    Path,
    typer.Argument(
        metavar="SOURCE",
        help="Folder with images/<camera>/<frame>.png or .jpg, or videos/<camera>.mp4, or pictures "
        "of a single camera; a picture, a video; annotations of COCO or labelme (.json).",
    ),
]
SceneOutOption = Annotated[
    Path,
    typer.Option("--out", "-o", metavar="SCENE", help="Folder for the scene; new or empty."),
]
CamerasOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Camera file that the scene gets. Default: SOURCE/cameras.yaml, if it exists.",
    ),
]
ClassOption = Annotated[
    list[str] | None,
    typer.Option(
        "--class",
        metavar="NAME",
        help="Class that is the object, by name or number; repeat for several; all: each but the "
        "background. Default: the only one.",
        rich_help_panel=_GIVEN,
    ),
]
PixelsOption = Annotated[
    str,
    typer.Option(
        metavar="KIND",
        help="What pixels of masks' pictures mean: classes, alpha, probability (from one half on); "
        "auto: as the file tells.",
        rich_help_panel=_GIVEN,
    ),
]
BackgroundOption = Annotated[
    str | None,
    typer.Option(
        metavar="PATH",
        help="Empty room: a picture, or a folder with <camera>.png or <camera>/<frame>.png; "
        "median: of the pictures themselves, in which the body moves. Default: SOURCE/background, "
        "if it exists.",
        rich_help_panel=_EMPTY,
    ),
]
BoxOption = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,W,H",
        help=r"Box around the object in all pictures: left, top, width, height \[pixel].",
        rich_help_panel=_MARKED,
    ),
]
StrokesOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Boxes and lines on the object and beside it, by camera and frame (YAML).",
        rich_help_panel=_MARKED,
    ),
]
DrawOption = Annotated[
    bool,
    typer.Option(
        "--draw",
        help="Draw boxes and lines on a page in the browser, on this machine alone; they are kept "
        "in strokes.yaml.",
        rich_help_panel=_MARKED,
    ),
]
PortOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=65535,
        help="Port of that page. Default: any free one.",
        rich_help_panel=_MARKED,
    ),
]
BrowserOption = Annotated[
    bool,
    typer.Option(
        "--browser/--no-browser", help="Open that page in the browser.", rich_help_panel=_MARKED
    ),
]
BodyOption = Annotated[
    Path | None,
    typer.Option(
        "--model",
        "-m",
        metavar="FILE",
        help="The object: URDF, SDFormat, MJCF or .dmd.yaml; pose and mask are found in turn.",
        rich_help_panel=_MODEL,
    ),
]
StartOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=r"Rough joint positions of every frame \[rad or m]: a CSV file with the column frame "
        "and one for each joint.",
        rich_help_panel=_MODEL,
    ),
]
StartErrorOption = Annotated[
    float,
    typer.Option(
        metavar="DEG",
        help="How far off their angles are: standard deviation.",
        rich_help_panel=_MODEL,
    ),
]
NetworkOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="ONNX file of a segmentation network; --class NUMBER is the object.",
        rich_help_panel=_NETWORK,
    ),
]
NetworkSizeOption = Annotated[
    str | None,
    typer.Option(
        metavar="W,H",
        help=r"Size that the network takes \[pixel]. Default: the pictures'.",
        rich_help_panel=_NETWORK,
    ),
]
NetworkMeanOption = Annotated[
    str,
    typer.Option(
        metavar="R,G,B",
        help="It takes (colour / 255 - mean) / std.",
        rich_help_panel=_NETWORK,
    ),
]
NetworkStdOption = Annotated[
    str, typer.Option(metavar="R,G,B", help="See --network-mean.", rich_help_panel=_NETWORK)
]
NetworkBgrOption = Annotated[
    bool,
    typer.Option("--network-bgr", help="It takes blue, green, red.", rich_help_panel=_NETWORK),
]
LargestOption = Annotated[
    bool, typer.Option("--largest", help="Keep only the largest patch of each mask.")
]
OutlineOption = Annotated[
    bool,
    typer.Option(
        "--overlay/--no-overlay",
        help="Write the pictures with the masks' outlines, overlay/<camera>/<frame>.jpg.",
    ),
]


def masks(
    source: SourceArgument,
    out: SceneOutOption,
    cameras: CamerasOption = None,
    class_: ClassOption = None,
    pixels: PixelsOption = "auto",
    background: BackgroundOption = None,
    box: BoxOption = None,
    strokes: StrokesOption = None,
    draw: DrawOption = False,
    port: PortOption = None,
    browser: BrowserOption = True,
    model: BodyOption = None,
    start: StartOption = None,
    start_error: StartErrorOption = 5.0,
    hold: HoldOption = None,
    package: PackageOption = None,
    network: NetworkOption = None,
    network_size: NetworkSizeOption = None,
    network_mean: NetworkMeanOption = "0,0,0",
    network_std: NetworkStdOption = "1,1,1",
    network_bgr: NetworkBgrOption = False,
    largest: LargestOption = False,
    overlay: OutlineOption = True,
    json: JsonOption = False,
) -> None:
    """See help_texts.MASKS."""
    with errors_as_messages():
        from drake_pose.jobs.masks.settings import MaskSettings

        with usage_errors():
            settings = MaskSettings(
                pixels=pixels,  # type: ignore[arg-type]  # It is checked there.
                classes=tuple(class_ or ()),
                background=background,
                box=None if box is None else parse_numbers(box, 4, "--box"),
                strokes=strokes,
                draw=draw,
                port=port,
                model=model,
                start=start,
                start_error=start_error,
                hold=parse_assignments(hold or (), "--hold"),
                packages=parse_packages(package or ()),
                network=network,
                network_size=None
                if network_size is None
                else parse_size(network_size, "--network-size"),
                network_mean=parse_numbers(network_mean, 3, "--network-mean"),
                network_std=parse_numbers(network_std, 3, "--network-std"),
                network_bgr=network_bgr,
                largest=largest,
                cameras=cameras,
            )
        _run(source, out, settings, overlay, browser, json)


def _run(
    source: Path, out: Path, settings: MaskSettings, overlay: bool, browser: bool, json: bool
) -> None:
    """Makes the masks, and says what was made."""
    from drake_pose.commands.report import count_progress
    from drake_pose.jobs.masks.masks import make_masks

    def show(address: str) -> None:
        say(f"drake-pose: draw at {address}")
        if browser:
            import webbrowser

            webbrowser.open(address)

    with count_progress("masks", None) as advance:
        result = make_masks(source, out, settings, overlay=overlay, on_mask=advance, on_page=show)
    print_result(result, json, _print)


def _print(result: SceneMasks) -> None:
    """How many masks each camera has, then where they are."""
    from rich.markup import escape

    from drake_pose.commands.report import output_console

    console = output_console()
    for name, frames in result.summary["cameras"].items():
        good = [one["area"] for one in frames.values() if "area" in one]
        text = f"{len(good)} masks of {len(frames)} pictures"
        text += f", {min(good)} to {max(good)} pixels" if good else ""
        console.print(f"{escape(name or 'camera'):<14} {text}")
    console.print(f"scene          {escape(str(result.folder))}", soft_wrap=True)
