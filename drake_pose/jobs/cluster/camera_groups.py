"""Which workers look through which cameras, and what they saw of one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.camera.frame_source import FrameSource, SourceSpecification, TimedPicture
from drake_pose.errors import ClusterError
from drake_pose.jobs.cluster.camera_worker import host_of


class CameraAssignment(NamedTuple):
    """Cameras that one worker looks through. hosts: where; empty: anywhere."""

    specifications: tuple[SourceSpecification, ...]
    hosts: frozenset[str] = frozenset()

    def allows(self, address: str) -> bool:
        """Whether the worker of an address can look through them."""
        return not self.hosts or host_of(address) in self.hosts


def assign_cameras(
    specifications: Sequence[SourceSpecification], workers: Mapping[str, Collection[str]]
) -> list[CameraAssignment]:
    """Shares cameras out among workers.

    Recordings and cameras in a network can be opened anywhere. A camera that hangs on a machine is
    looked through by the workers there: where workers run on several machines, those that were
    started with a resource of the camera's name (``workers``: those names by address).

    Raises:
        ClusterError: there is no worker, or nobody says where a camera is.
    """
    if not workers:
        raise ClusterError("there are no workers to watch cameras; start some")
    all_hosts = sorted({host_of(address) for address in workers})
    groups: dict[frozenset[str], list[SourceSpecification]] = {}
    for one in specifications:
        hosts: frozenset[str] = frozenset()
        if len(all_hosts) > 1 and one.live and "://" not in one.location:
            hosts = frozenset(host_of(a) for a, names in workers.items() if one.camera in names)
            if not hosts:
                raise ClusterError(
                    f"camera '{one.camera}' hangs on one of {', '.join(all_hosts)}, and nobody "
                    f'says on which: start a worker there with --resources "{one.camera}=1"'
                )
        groups.setdefault(hosts, []).append(one)
    assignments = []
    for hosts, group in groups.items():
        count = sum(not hosts or host_of(address) in hosts for address in workers)
        # Neighbours stay together.
        for part in np.array_split(np.arange(len(group)), min(count, len(group))):
            assignments.append(CameraAssignment(tuple(group[k] for k in part), hosts))
    return assignments


class WatchedSource(FrameSource):
    """A camera whose pictures stay where they are: gives packed views in their place.

    Attributes:
        queue: what came and was not read yet.
        is_over: whether the worker has said that nothing will come any more.
        rate: pictures a second, where known.
    """

    def __init__(self, specification: SourceSpecification, look: Callable[[], None]) -> None:
        super().__init__(specification)
        self.queue: deque[TimedPicture] = deque()
        self.is_over = False
        self.rate: float | None = None
        self._look = look

    @property
    def ended(self) -> bool:
        """Whether nothing will come any more."""
        return self.is_over and not self.queue

    @property
    def rate_hz(self) -> float | None:
        """As the source says where it is open."""
        return self.rate

    def close(self) -> None:
        """Nothing is held open here."""

    def _read(self) -> TimedPicture | None:
        self._look()
        return self.queue.popleft() if self.queue else None
