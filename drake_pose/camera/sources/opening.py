"""Opens the source of a camera's pictures, of whatever kind it is."""

import time

from drake_pose.camera.sources.frame_source import Clock, FrameSource, SourceSpecification
from drake_pose.camera.sources.live import DeviceSource
from drake_pose.camera.sources.recorded import FolderSource, VideoSource


def open_source(specification: SourceSpecification, clock: Clock = time.monotonic) -> FrameSource:
    """Opens a source.

    Args:
        specification: where the pictures come from.
        clock: gives the time stamps of a live camera's pictures [s].

    Raises:
        SceneError: a folder or video that cannot be read, is empty, or whose pictures are not of
            the calibrated size. A live camera that cannot be opened is tried again and again.
    """
    if specification.kind == "folder":
        return FolderSource(specification)
    if specification.kind == "video":
        return VideoSource(specification)
    return DeviceSource(specification, clock)
