"""Scenes of live cameras or recorded sources, and the loop that simulates their diagrams."""

import math
import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import cv2
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, EventStatus

from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.models import Camera
from drake_pose.camera.sources import (
    CAMERAS,
    SOURCES,
    FrameSource,
    Picture,
    SourceSpecification,
    load_background_pictures,
    load_sources,
    open_source,
)
from drake_pose.errors import OutputError, SceneError
from drake_pose.files.folder import write_file
from drake_pose.silhouette.segmentation import Background, learn_background
from drake_pose.systems.picture_capture import PictureCapture


@dataclass(frozen=True, eq=False)
class LiveScene:
    """Calibrated cameras, the sources of their pictures, and their background models."""

    path: Path  # The scene's folder.
    cameras: Mapping[str, Camera]  # Cameras by name.
    specifications: Mapping[str, SourceSpecification]  # Sources by camera.
    # Background models by camera, without cameras whose sources deliver masks.
    backgrounds: Mapping[str, Background]

    def open_sensors(self, tolerance: float | None) -> PictureCapture:
        """Open the sources and return their sensor system.

        ``tolerance``: as in ``LiveSettings``.

        Raises:
            SceneError: a source cannot be opened; sources opened before are closed.
            SettingsError: the tolerance is out of range.
        """
        with ExitStack() as opened:
            sources = _open_sources(self.specifications, opened)
            sensors = PictureCapture(sources, self.cameras, tolerance=tolerance)
            opened.pop_all()
        return sensors


def _open_sources(
    given: Mapping[str, SourceSpecification], opened: ExitStack
) -> dict[str, FrameSource]:
    """Return the opened sources by camera; ``opened`` closes them.

    Raises SceneError: a source cannot be opened.
    """
    return {name: opened.enter_context(closing(open_source(one))) for name, one in given.items()}


def hush_opencv() -> None:
    """Silence OpenCV, which logs every attempt to open a camera."""
    # Read when the first camera or video is opened; -8 means silent.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def load_live_scene(path: Path) -> LiveScene:
    """Return the live scene of a folder with cameras.yaml, sources.yaml and background pictures.

    Raises SceneError, CameraError: the message names a missing or damaged file.
    """
    if not path.is_dir():
        raise SceneError(f"{path}: no such folder; it needs {CAMERAS} and {SOURCES}")
    if not (path / SOURCES).is_file():
        raise SceneError(
            f"{path}: has no {SOURCES}, which names the sources of its cameras' pictures"
        )
    cameras = load_cameras(path / CAMERAS)
    if len(cameras) < 2:
        raise SceneError(f"{path}: the capture of a person needs two or more calibrated cameras")
    specifications = load_sources(path / SOURCES, cameras)
    backgrounds = {
        name: learn_background(load_background_pictures(one))
        for name, one in specifications.items()
        if not one.gives_masks
    }
    return LiveScene(path, cameras, specifications, backgrounds)


def take_empty_room(folder: Path, count: int, patience: float = 30.0) -> dict[str, Path]:
    """Write each camera's first pictures to its background folder; return the folders by camera.

    Args:
        folder: folder with cameras.yaml and sources.yaml.
        count: number of pictures of each camera.
        patience: timeout for the pictures [s].

    Raises SceneError: a camera gives too few pictures, or no camera needs a background;
    OutputError: a background folder is not empty, or cannot be written.
    """
    specifications = {
        name: one for name, one in load_sources(folder).items() if one.background is not None
    }
    if not specifications:
        raise SceneError(f"{folder}: no source needs a background, as all deliver masks")
    places = {name: Path(str(one.background)) for name, one in specifications.items()}
    for name, place in places.items():
        if place.exists() and (not place.is_dir() or any(place.iterdir())):
            raise OutputError(
                f"{place}: the background of camera '{name}' exists already; remove it first"
            )
    pictures: dict[str, list[Picture]] = {name: [] for name in places}
    with ExitStack() as opened:
        sources = _open_sources(specifications, opened)
        end = time.monotonic() + patience
        while slow := [name for name, some in pictures.items() if len(some) < count]:
            for name in slow:
                if (taken := sources[name].read()) is not None:
                    pictures[name].append(taken.picture.astype("uint8"))
                elif sources[name].ended or time.monotonic() > end:
                    reasons = "; ".join(sources[name].problems)
                    raise SceneError(
                        f"camera '{name}' gave {len(pictures[name])} of {count} pictures"
                        f"{': ' if reasons else ''}{reasons}"
                    )
            time.sleep(0.005)
    for name, place in places.items():
        for k, picture in enumerate(pictures[name]):
            _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            write_file(place, f"{k:03d}.png", data.tobytes())
    return places


def run_live(
    diagram: Diagram,
    sensors: PictureCapture,
    seconds: float | None,
    on_report: Callable[[str], None],
    monitor: Callable[[Context], EventStatus | None],
    largest_lag: float = 0.2,
) -> bool:
    """Simulate a diagram until its recordings end, the time is over, or Ctrl-C.

    Recordings are simulated as fast as possible, live cameras by the computer's clock.

    Args:
        diagram: the diagram.
        sensors: its sensor system.
        seconds: duration [s], of the clock if the sensors are live, else simulated; None:
            unlimited.
        on_report: called with messages about cameras and pictures.
        monitor: called with the diagram's context after every step; ends the run by returning
            ReachedTermination.
        largest_lag: delay to the clock beyond which a simulation skips ahead [s].

    Returns whether Ctrl-C ended the run.
    """
    simulator = Simulator(diagram)
    simulator.set_monitor(monitor)
    is_live = sensors.live
    simulator.set_target_realtime_rate(float(is_live))
    context = simulator.get_context()
    end = math.inf if seconds is None else seconds
    try:
        simulator.Initialize()
        begin = start = time.monotonic()
        while (time.monotonic() - start if is_live else context.get_time()) < end:
            goal = context.get_time() + sensors.period
            status = simulator.AdvanceTo(goal if is_live else min(goal, end))
            for report in sensors.take_reports():
                on_report(report)
            if status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
                break
            lag = time.monotonic() - begin - context.get_time()
            if is_live and lag > largest_lag:
                simulator.ResetStatistics()
                begin += lag
    except KeyboardInterrupt:
        return True
    return False


def look_until(
    diagram: Diagram,
    sensors: PictureCapture,
    looks: Callable[[Context], bool],
    on_report: Callable[[str], None],
    patience: float = 60.0,
) -> None:
    """Simulate a diagram until ``looks`` returns True, then close the sensors.

    The simulation also ends when its recordings end, or with live cameras after ``patience``.

    Args:
        diagram: the diagram.
        sensors: its sensor system.
        looks: called with the diagram's context after every step.
        on_report: called with messages about live cameras.
        patience: timeout with live cameras [s].

    Raises KeyboardInterrupt: Ctrl-C ended the run.
    """

    def look(context: Context) -> EventStatus:
        ended = EventStatus.ReachedTermination(diagram, "")
        return ended if looks(context) else EventStatus.DidNothing()

    # Recorded pictures are read again in the capture, which reports their problems.
    report = on_report if sensors.live else lambda _: None
    waited = patience if sensors.live else None
    try:
        if run_live(diagram, sensors, waited, report, look):
            raise KeyboardInterrupt
    finally:
        sensors.close()
