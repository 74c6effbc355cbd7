"""The command `drake-pose walk`."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

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


@dataclass(frozen=True, kw_only=True)
class WalkOptions:
    """Settings of the walk: the source of the motion, and the page.

    Raises:
        SettingsError: options exclude each other.
    """

    simulate: bool = False
    """Play the motion of a simulated person."""
    live: Annotated[Path | None, Parameter(metavar="FOLDER")] = None
    """Folder with sources.yaml: the avatar walks as the person before these live cameras."""
    shape: Shape = None
    method: Literal["stance", "paper"] = "stance"
    """stance: standing ahead of or behind the start walks; paper: walking on the spot does."""
    model: Path | None = None
    """Model file of the result. Default: the bundled model of that name."""
    package: Packages = field(default_factory=dict)
    rate: Annotated[float | None, within(0.0)] = None
    """Frame rate of the result [Hz]. Default: that of its summary.json."""
    seconds: Seconds = None
    """Stop after this time of the walk [s]."""
    speed: Annotated[float, within(0.0)] = 1.0
    """Playback speed relative to real time; 0: as fast as possible."""
    port: Annotated[int | None, within(1024, 65535)] = None
    """Port of the page. Default: any free port."""
    browser: Browser = True
    wait: Annotated[bool | None, Parameter(negative="--no-wait")] = None
    """--wait: start playing when a browser shows the page, and again when its button is pressed,
    until Ctrl-C or --seconds. --no-wait: start at once and play once. Default: --wait with
    --browser, else --no-wait."""

    def __post_init__(self) -> None:
        if self.live is None and self.shape:
            raise SettingsError("--shape needs --live")
        if self.package and self.model is None:
            raise SettingsError("--package needs --model")
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

    The person's position and direction are commands: facing right or left turns the view, standing
    ahead of or behind the position in the first frame walks forward or backward. Only browsers on
    this machine can open the page.

        drake-pose walk results/person

    Args:
        result: Result folder of capture to play. Default: none, the arrow keys move the avatar.
    """
    options = options or WalkOptions()
    if sum([options.simulate, result is not None, options.live is not None]) > 1:
        raise UsageError("give only one of a result, --simulate and --live")
    if result is None and options.live is None and options.model is not None:
        raise UsageError("--model needs a result or --live")
    if options.rate is not None and result is None:
        raise UsageError("--rate needs a result")
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
    page = walking.open_page(options.port)
    say(f"drake-pose: {page.web_url()} - arrow keys walk and turn, Ctrl-C quits")
    shown = (
        options.browser and webbrowser.open(page.web_url()) and walking.wait_for_browser(page, 10.0)
    )
    if waits and not shown:
        say("drake-pose: waiting until a browser shows the page")
        walking.wait_for_browser(page)
    elif options.browser and not shown:
        warn("no browser has opened the page yet")

    def ask() -> bool:
        if waits and options.seconds is None:
            say("drake-pose: end; space or the page's button plays again, Ctrl-C quits")
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
