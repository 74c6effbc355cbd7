"""The command `drake-pose walk`."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from drake_pose.commands.common import (
    SPREAD,
    Browser,
    Json,
    UsageError,
    print_json,
    say,
    warn,
    within,
)
from drake_pose.errors import SettingsError
from drake_pose.files.settings import Packages
from drake_pose.jobs.live.settings import LiveSettings, Seconds, Shape

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat


@dataclass(frozen=True, kw_only=True)
class WalkOptions:
    """Who walks, and how it is shown.

    Raises:
        SettingsError: options do not go together.
    """

    simulate: bool = False
    """Play a simulated person's motion."""
    live: Annotated[Path | None, Parameter(metavar="FOLDER")] = None
    """Walk as the person before live cameras: folder with sources.yaml."""
    shape: Shape = None
    method: Literal["stance", "paper"] = "stance"
    """stance: standing ahead or behind walks; paper: only while walking on the spot."""
    model: Path | None = None
    """The result's model, if it is not a bundled one."""
    package: Packages = field(default_factory=dict)
    rate: Annotated[float | None, within(0.0)] = None
    """Frame rate of the result [Hz]. Default: that of its summary.json."""
    seconds: Seconds = None
    """Stop after this time of the walk [s]."""
    speed: Annotated[float, within(0.0)] = 1.0
    """Speed relative to real time; 0: as fast as possible."""
    port: Annotated[int | None, within(1024, 65535)] = None
    """Port of the page. Default: a free one."""
    browser: Browser = True
    wait: Annotated[bool | None, Parameter(negative="--no-wait")] = None
    """Start a result or --simulate when a browser shows the page, and again when its button is
    pressed, until Ctrl-C or --seconds; or start at once and play once. Default: --wait with
    --browser, else --no-wait."""

    def __post_init__(self) -> None:
        if self.live is None and self.shape:
            raise SettingsError("--shape is for --live")
        if self.package and self.model is None:
            raise SettingsError("--package is for --model")
        if self.rate == 0.0:
            raise SettingsError("--rate must be above 0")


def walk(
    result: Path | None = None,
    /,
    *,
    options: Annotated[WalkOptions | None, SPREAD] = None,
    json: Json = False,
) -> None:
    """Walk through a garden in the browser as an avatar that moves like the captured person.

    The person's place and direction are commands: facing right or left turns the view, standing
    ahead of or behind the place of the first frame walks forward or backward. The page can be
    opened on this machine only.

        drake-pose walk results/person

    Args:
        result: Result folder of capture that is played. Default: none, the arrow keys walk.
    """
    options = options or WalkOptions()
    if sum([options.simulate, result is not None, options.live is not None]) > 1:
        raise UsageError("give a result, --simulate or --live, not two of them")
    if result is None and options.live is None and options.model is not None:
        raise UsageError("--model is for a result or --live")
    if options.rate is not None and result is None:
        raise UsageError("--rate is for a result")
    from drake_pose.jobs.live import walk as walking

    if options.live is not None:
        from drake_pose.jobs.live.scene import hush_opencv, load_live_scene

        hush_opencv()
        settings = LiveSettings(shape=options.shape, packages=options.package)
        player = walking.live_player(load_live_scene(options.live), options.model, settings)
    elif result is not None:
        player = walking.recorded_player(result, options.model, options.rate, options.package)
    else:
        player = walking.simulated_player() if options.simulate else walking.Player()
    waits = player.q is not None and (options.browser if options.wait is None else options.wait)
    page = _open_page(options, waits)

    def ask() -> bool:
        if waits and options.seconds is None:
            say("drake-pose: the end; space or the page's button plays it again, Ctrl-C ends")
            return walking.wait_for_replay(page)
        return False

    walked = walking.walk(
        player, page, options.seconds, options.speed,
        lambda words: say(f"drake-pose: {words or 'stand'}"), ask, options.method == "paper",
        lambda text: say(f"drake-pose: {text}"),
    )  # fmt: skip
    for text in walked.get("warnings", ()):
        warn(text)
    if json:
        print_json(walked)
        return
    followed = [f"{name} {value:.1f} s" for name, value in walked["commands"].items() if value]
    say(
        f"drake-pose: walked {walked['seconds']:.1f} s to x = {walked['x']:.2f} m, "
        f"y = {walked['y']:.2f} m, heading {walked['heading_deg']:.0f} degrees; commands: "
        f"{', '.join(followed) or 'none'}"
    )


def _open_page(options: WalkOptions, waits: bool) -> Meshcat:
    """The page, shown in the browser where there is one; waits until it is, or says it is not."""
    from drake_pose.jobs.live.walk import open_page, wait_for_browser

    page = open_page(options.port)
    say(f"drake-pose: {page.web_url()} - arrow keys walk and turn, Ctrl-C ends")
    shown = options.browser and webbrowser.open(page.web_url()) and wait_for_browser(page, 10.0)
    if waits and not shown:
        say("drake-pose: waiting until a browser shows the page")
        wait_for_browser(page)
    elif options.browser and not shown:
        warn("no browser has opened the page yet")
    return page
