"""What the systems here are made of: ports by name, and what they know, renewed once a period."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    CacheEntry,
    Context,
    DependencyTicket,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
    State,
    System,
    ValueProducer,
)

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError

T = TypeVar("T")


def require_period(whose: str, period: float) -> None:
    """Refuse (SettingsError) a time between two updates that is not positive [s]."""
    if not 0.0 < period < math.inf:
        raise SettingsError(f"the {whose}'s period must be positive, not {period}")


def require_different(cameras: Sequence[Camera], fewest: int, said: str) -> None:
    """Refuse (SettingsError) fewer cameras, or two of one name; `said` of those that are given."""
    names = [camera.name for camera in cameras]
    if len(names) < fewest or len(set(names)) != len(names):
        raise SettingsError(f"{said}: {names}")


def require_time_forward(system: LeafSystem, context: Context, last: float) -> None:
    """Refuse (SettingsError) an update before the last one, whose filter knows the future."""
    now = context.get_time()
    if now < last:
        raise SettingsError(
            f"{system.get_name()}: time ran backwards, from {last:g} s to {now:g} s; to begin "
            "anew, set the context to its defaults (SetDefaultContext)"
        )


def camera_port(kind: str, camera: Camera, cameras: Sequence[Camera]) -> str:
    """Name of the port that carries a camera's image of a kind, where there are ``cameras``."""
    return kind if len(cameras) == 1 else f"{kind}_{camera.name}"


def connect_same(builder: DiagramBuilder, giver: System, taker: System) -> None:
    """Connect all outputs of a system to inputs of the same names of another, where there are."""
    for index in range(giver.num_output_ports()):
        port = giver.get_output_port(index)
        if taker.HasInputPort(port.get_name()):
            builder.Connect(port, taker.GetInputPort(port.get_name()))


def export_outputs(builder: DiagramBuilder, system: System) -> None:
    """Make all outputs of a system the diagram's, under their names."""
    for index in range(system.num_output_ports()):
        port = system.get_output_port(index)
        builder.ExportOutput(port, port.get_name())


def evaluate(port: OutputPort, context: Context) -> Any:
    """What an output port of a system inside a diagram gives; context: the diagram's."""
    return port.Eval(port.get_system().GetMyContextFromRoot(context))


@dataclass(frozen=True, eq=False)
class StagedDiagram(Generic[T]):
    """A diagram with an estimator, and what is computed in it before its state is updated.

    Args:
        stages: the output ports of each stage, in their order: whoever evaluates one after the
            other sees what each costs.
    """

    diagram: Diagram
    stages: Mapping[str, tuple[OutputPort, ...]]
    estimator: T

    def evaluate(self, context: Context, stage: str) -> None:
        """Have a stage, one of stages, compute what it has not computed yet."""
        for port in self.stages[stage]:
            evaluate(port, context)


class PortedSystem(LeafSystem):
    """A system whose ports are declared by what is like their values: an int is a vector's size."""

    def add_input(self, name: str, like: Any) -> InputPort:
        """An input port."""
        if isinstance(like, int):
            return self.DeclareVectorInputPort(name, like)
        return self.DeclareAbstractInputPort(name, AbstractValue.Make(like))

    def add_output(
        self,
        name: str,
        like: Any,
        calc: Callable[[Context], Any],
        tickets: set[DependencyTicket] | None = None,
    ) -> OutputPort:
        """An output port that a function of the context gives, and what of; None: all inputs."""
        of = {self.all_input_ports_ticket()} if tickets is None else tickets
        if isinstance(like, int):
            return self.DeclareVectorOutputPort(
                name, like, lambda context, output: output.SetFromVector(calc(context)), of
            )
        return self.DeclareAbstractOutputPort(
            name,
            AbstractValue.Make(like).Clone,
            lambda context, output: output.set_value(calc(context)),
            of,
        )

    def add_cache(self, name: str, calc: Callable[[Context], Any]) -> CacheEntry:
        """What a function makes of the inputs, for several outputs."""
        return self.DeclareCacheEntry(
            name,
            ValueProducer(
                AbstractValue.Make(None).Clone,
                lambda context, output: output.set_value(calc(context)),
            ),
            {self.all_input_ports_ticket()},
        )

    def add_camera_inputs(
        self, ports: Mapping[str, str], like: Callable[[str], Any] = lambda _: None
    ) -> Callable[[Context], dict[str, Any]]:
        """Input ports by camera, and what is like a camera's values.

        Returns:
            What gives, by camera, what comes in; without those that are not connected, or None.
        """
        for name, port in ports.items():
            self.add_input(port, like(name))

        def given(context: Context) -> dict[str, Any]:
            found = {name: self.given(context, port) for name, port in ports.items()}
            return {name: value for name, value in found.items() if value is not None}

        return given

    def add_parameter(self, first: Any) -> Callable[[Context], Any]:
        """An abstract parameter of the context, the next by index; what reads it."""
        index = self.DeclareAbstractParameter(AbstractValue.Make(first))
        return lambda context: context.get_abstract_parameter(int(index)).get_value()

    def given(self, context: Context, name: str) -> Any:
        """What comes in at a port, a vector as a copy; None: it is not connected."""
        port = self.GetInputPort(name)
        value = port.Eval(context) if port.HasValue(context) else None
        return np.array(value) if isinstance(value, np.ndarray) else value


class SharedValue:
    """A value that nobody changes: Drake would copy abstract state twice in every update."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return self


class BeliefSystem(PortedSystem, Generic[T]):
    """Renews a value, its belief, once a period; outputs read it.

    The update is an unrestricted one, as abstract state needs.
    """

    def keep_belief(self, first: T, period: float) -> None:
        """Declares the belief, and the time between two renewals [s]."""
        self._belief = self.DeclareAbstractState(AbstractValue.Make(first))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._renew)
        self.DeclareForcedUnrestrictedUpdateEvent(self._renew)

    def show(self, name: str, like: Any, read: Callable[[T], Any]) -> OutputPort:
        """An output port that reads the belief."""
        ticket = {self.abstract_state_ticket(self._belief)}
        return self.add_output(name, like, lambda context: read(self.belief(context)), ticket)

    def belief(self, context: Context) -> T:
        """What is known in a context."""
        known: T = context.get_abstract_state(int(self._belief)).get_value()
        return known

    def next_belief(self, context: Context, last: T) -> T:
        """What is known after an update."""
        raise NotImplementedError

    def _renew(self, context: Context, state: State) -> EventStatus:
        last = self.belief(context)
        known = self.next_belief(context, last)
        if known is last:
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(int(self._belief)).set_value(known)
        return EventStatus.Succeeded()


class MemorySystem(PortedSystem):
    """Renews named vectors once a period.

    The update is a discrete one: it sees what unrestricted ones of the same time have changed.
    """

    def keep_vectors(
        self, starts: Mapping[str, Array], shown: Collection[str], period: float
    ) -> None:
        """Declares vectors, which of them are outputs, and when they are renewed [s]."""
        self._vectors = {name: self.DeclareDiscreteState(first) for name, first in starts.items()}
        for name in shown:
            self.DeclareStateOutputPort(name, self._vectors[name])
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._renew)
        self.DeclareForcedDiscreteUpdateEvent(self._renew)

    def vectors(self, context: Context) -> dict[str, Array]:
        """Copies of what is known in a context."""
        return {
            name: np.array(context.get_discrete_state(index).value())
            for name, index in self._vectors.items()
        }

    def set_vectors(self, state: DiscreteValues, known: Mapping[str, Array]) -> None:
        """Writes what is known from now on."""
        for name, value in known.items():
            state.set_value(self._vectors[name], np.ravel(value))

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """What is known after an update, and was not before; may change ``known``."""
        raise NotImplementedError

    def _renew(self, context: Context, state: DiscreteValues) -> EventStatus:
        changed = self.next_vectors(context, self.vectors(context))
        self.set_vectors(state, changed)
        return EventStatus.Succeeded() if changed else EventStatus.DidNothing()
