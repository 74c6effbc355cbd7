"""Which workers may look through which cameras."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.camera.sources.frame_source import SourceSpecification
from drake_pose.errors import ClusterError


@dataclass(frozen=True)
class CameraAssignment:
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

    Recordings and cameras in a network can be opened anywhere. A camera that hangs on a machine
    is looked through by the workers there: where workers run on several machines, those that were
    started with a resource of the camera's name.

    Args:
        specifications: of the cameras' sources.
        workers: by address, the names of the resources that the worker was started with.

    Raises:
        ClusterError: there is no worker, or nobody says where a camera is.
    """
    if not workers:
        raise ClusterError("there are no workers to watch cameras; start some")
    hosts = sorted({host_of(address) for address in workers})
    bound: dict[frozenset[str], list[SourceSpecification]] = {}
    free = []
    for one in specifications:
        if len(hosts) == 1 or not one.live or "://" in one.location:
            free.append(one)
            continue
        homes = frozenset(host_of(a) for a, names in workers.items() if one.camera in names)
        if not homes:
            raise ClusterError(
                f"camera '{one.camera}' hangs on one of {', '.join(hosts)}, and nobody says on "
                f'which: start a worker there with --resources "{one.camera}=1"'
            )
        bound.setdefault(homes, []).append(one)
    assignments = []
    for homes, group in bound.items():
        assignments += _split(group, sum(host_of(address) in homes for address in workers), homes)
    return assignments + _split(free, len(workers), frozenset())


def _split(
    group: Sequence[SourceSpecification], count: int, hosts: frozenset[str]
) -> list[CameraAssignment]:
    """Neighbours stay together."""
    parts = np.array_split(np.arange(len(group)), max(1, min(count, len(group))))
    return [CameraAssignment(tuple(group[k] for k in part), hosts) for part in parts if len(part)]


def host_of(address: str) -> str:
    """The machine of a worker's address."""
    return address.split("://")[-1].rsplit(":", 1)[0]
