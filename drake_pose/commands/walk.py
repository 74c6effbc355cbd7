"""The command `drake-pose walk`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drake_pose.commands.cluster_options import SchedulerOption, WatchersOption, workers_of
from drake_pose.commands.estimate_options import JsonOption, PackageOption
from drake_pose.commands.live import ShapeOption
from drake_pose.commands.terminal import (
    errors_as_messages,
    finite,
    print_json,
    say,
    usage_errors,
    warn,
)
from drake_pose.results.options import parse_packages

if TYPE_CHECKING:
    from distributed import Client
    from pydrake.geometry import Meshcat

    from drake_pose.jobs.live.scene import LiveScene
    from drake_pose.person.date.walk_commands import WalkSettings
    from drake_pose.systems.person.live_capture import LiveSensors


ResultArgument = Annotated[
    Path | None,
    typer.Argument(
        help="Result folder of capture that is played. Default: none, the arrow keys walk."
    ),
]
SimulateOption = Annotated[
    bool, typer.Option("--simulate", help="Play a simulated person's motion.")
]
LiveOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="Walk as the person before live cameras: folder with sources.yaml.",
    ),
]
ResultModelOption = Annotated[
    Path | None, typer.Option(help="The result's model, if it is not a bundled one.")
]
WalkMethodOption = Annotated[
    str,
    typer.Option(
        help="stance: standing ahead or behind walks; paper: only while walking on the spot."
    ),
]
RateOption = Annotated[
    float | None,
    typer.Option(
        callback=finite,
        help="Frame rate of the result [Hz]. Default: that of its summary.json.",
    ),
]
WalkSecondsOption = Annotated[
    float | None,
    typer.Option(min=0.01, callback=finite, help=r"Stop after this time of the walk \[s]."),
]
SpeedOption = Annotated[
    float,
    typer.Option(
        min=0.0, callback=finite, help="Speed relative to real time; 0: as fast as possible."
    ),
]
PortOption = Annotated[
    int | None,
    typer.Option(min=1024, max=65535, help="Port of the page. Default: a free one."),
]
BrowserOption = Annotated[
    bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")
]
WaitOption = Annotated[
    bool | None,
    typer.Option(
        "--wait/--no-wait",
        help="Start a result or --simulate when a browser shows the page, and again when its "
        "button is pressed, until Ctrl-C or --seconds; or start at once and play once. "
        "Default: --wait with --browser, else --no-wait.",
    ),
]


def walk(
    result: ResultArgument = None,
    simulate: SimulateOption = False,
    live: LiveOption = None,
    shape: ShapeOption = None,
    workers: WatchersOption = 0,
    scheduler: SchedulerOption = None,
    method: WalkMethodOption = "stance",
    model: ResultModelOption = None,
    package: PackageOption = None,
    rate: RateOption = None,
    seconds: WalkSecondsOption = None,
    speed: SpeedOption = 1.0,
    port: PortOption = None,
    browser: BrowserOption = True,
    wait: WaitOption = None,
    json: JsonOption = False,
) -> None:
    """See help_texts.WALK."""
    if sum([simulate, result is not None, live is not None]) > 1:
        raise typer.BadParameter("give a result, --simulate or --live, not two of them")
    if workers and scheduler is not None:
        raise typer.BadParameter("give --workers or --scheduler, not both")
    if live is None and (workers or scheduler is not None or shape is not None):
        raise typer.BadParameter("--shape, --workers and --scheduler are for --live")
    if result is None and live is None and model is not None:
        raise typer.BadParameter("--model is for a result or --live")
    if package and model is None:
        raise typer.BadParameter("--package is for --model")
    if method not in ("stance", "paper"):
        raise typer.BadParameter("must be stance or paper", param_hint="--method")
    _check_rate(rate, result)
    with usage_errors():
        packages = parse_packages(package or ())
    with errors_as_messages():
        from drake_pose.jobs.live import walk as walking
        from drake_pose.person.date.walk_commands import WalkSettings

        settings = WalkSettings(on_spot=method == "paper")
        if live is not None:
            with workers_of(workers, scheduler) as client:
                walked = _walk_live(
                    live, model, shape, seconds, port, browser, client, packages, settings
                )
            _print(walked, json)
            return
        if result is not None:
            player = walking.recorded_player(result, model, rate, packages)
        else:
            player = walking.simulated_player() if simulate else walking.key_player()
        waits = player.q is not None and (browser if wait is None else wait)
        page = _open_page(port, browser, waits)
        again = _asker(page) if waits and seconds is None else None
        _print(walking.walk(player, page, seconds, speed, _say_command, again, settings), json)


def _check_rate(rate: float | None, result: Path | None) -> None:
    """Refuses a rate that cannot be, or that is the rate of nothing."""
    if rate is None:
        return
    if result is None:
        raise typer.BadParameter("--rate is for a result")
    if rate <= 0.0:
        raise typer.BadParameter("must be above 0", param_hint="--rate")


def _asker(page: Meshcat) -> Callable[[], bool]:
    """What waits at the end of a recording until it is to be played again."""
    from drake_pose.jobs.live.walk import wait_for_replay

    def ask() -> bool:
        say("drake-pose: the end; space or the page's button plays it again, Ctrl-C ends")
        return wait_for_replay(page)

    return ask


def _walk_live(
    folder: Path,
    model: Path | None,
    shape: Path | None,
    seconds: float | None,
    port: int | None,
    browser: bool,
    client: Client | None,
    packages: Mapping[str, Path],
    settings: WalkSettings,
) -> dict[str, Any]:
    """Walks with the cameras of a folder; what it is to walk with is read before the page opens."""
    from drake_pose.jobs.live.live_walk import walk_live
    from drake_pose.jobs.live.scene import hush_opencv, load_live_scene

    hush_opencv()
    # Workers may have another working folder.
    scene = load_live_scene(folder if client is None else folder.absolute())
    page = _open_page(port, browser)

    def report(text: str) -> None:
        say(f"drake-pose: {text}")

    open_sensors = None if client is None else _opener(client, scene)
    walked = walk_live(
        scene, page, model, shape, seconds, open_sensors, _say_command, report, packages, settings
    )
    for text in walked["warnings"]:
        warn(text)
    return walked


def _opener(client: Client, scene: LiveScene) -> Callable[[], LiveSensors]:
    """What opens the sensors on the workers."""
    from drake_pose.jobs.cluster.remote_views import opener

    # A recording cannot be skipped from afar as fast as its moments pass, so that it is waited for.
    return lambda: opener(client)(scene)


def _open_page(port: int | None, browser: bool, waits: bool = False) -> Meshcat:
    """The page, shown in the browser where there is one; waits until it is, or says it is not."""
    from drake_pose.jobs.live import walk as walking

    page = walking.open_page(port)
    say(f"drake-pose: {page.web_url()} - arrow keys walk and turn, Ctrl-C ends")
    shown = browser and walking.show(page)
    if waits and not shown:
        say("drake-pose: waiting until a browser shows the page")
        walking.wait_for_browser(page)
    elif browser and not shown:
        warn("no browser has opened the page yet")
    return page


def _say_command(words: str) -> None:
    say(f"drake-pose: {words or 'stand'}")


def _print(walked: dict[str, Any], json: bool) -> None:
    """A walk's result."""
    from drake_pose.jobs.live.walk import summary_line

    if json:
        print_json(walked)
    else:
        say(f"drake-pose: {summary_line(walked)}")
