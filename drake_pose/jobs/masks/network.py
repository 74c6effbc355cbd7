"""Masks by a user's network."""

from __future__ import annotations

from pathlib import Path

from drake_pose.errors import SettingsError
from drake_pose.jobs.masks.found import FoundMask, FoundMasks
from drake_pose.jobs.masks.settings import MaskSettings
from drake_pose.jobs.masks.sources import Source
from drake_pose.silhouette.segmentation.network import NetworkInput, SegmentationNetwork


def segment_by_network(source: Source, file: Path, settings: MaskSettings) -> FoundMasks:
    """The masks that a network finds in all pictures.

    Raises:
        SettingsError: the network cannot be read, or does not take the pictures.
    """
    taken = NetworkInput(
        settings.network_size, settings.network_mean, settings.network_std, settings.network_bgr
    )
    network = SegmentationNetwork(file, taken, settings.classes)
    for camera in source.names:
        for frame, where, picture in source.read(camera):
            try:
                mask = network.find(picture)
            except SettingsError as error:
                raise SettingsError(f"{where}: {error}") from error
            yield FoundMask(camera, frame, where, mask, picture)
