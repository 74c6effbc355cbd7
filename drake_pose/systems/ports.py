"""Base classes of the systems in this subpackage, and helpers for ports and diagrams.

``PortedSystem`` declares ports from model values. ``BeliefSystem`` keeps an abstract value,
``MemorySystem`` named vectors, as state that a periodic update replaces and output ports read.
"""

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
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


def require_period(owner: str, period: float) -> None:
    """Raise SettingsError, which names ``owner``, unless a period [s] is positive and finite."""
    if not 0.0 < period < math.inf:
        raise SettingsError(f"the {owner}'s period must be positive, not {period}")


def require_distinct_cameras(cameras: Sequence[Camera], fewest: int, message: str) -> None:
    """Raise SettingsError (``message``, names): fewer than ``fewest``, or equal names."""
    names = [camera.name for camera in cameras]
    if len(names) < fewest or len(set(names)) != len(names):
        raise SettingsError(f"{message}: {names}")


def require_time_forward(system: LeafSystem, context: Context, last: float) -> None:
    """Raise SettingsError, which names ``system``, if the context's time precedes ``last`` [s]."""
    now = context.get_time()
    if now < last:
        raise SettingsError(
            f"{system.get_name()}: time ran backwards, from {last:g} s to {now:g} s; to start "
            "again, set the context to its defaults (SetDefaultContext)"
        )


def camera_port(kind: str, camera: Camera, cameras: Sequence[Camera]) -> str:
    """Return a camera's port name: ``kind`` if it is the only one, else ``<kind>_<camera>``."""
    return kind if len(cameras) == 1 else f"{kind}_{camera.name}"


def connect_matching_ports(builder: DiagramBuilder, source: System, target: System) -> None:
    """Connect outputs of ``source`` to the inputs of ``target`` that have the same name."""
    for index in range(source.num_output_ports()):
        port = source.get_output_port(index)
        if target.HasInputPort(port.get_name()):
            builder.Connect(port, target.GetInputPort(port.get_name()))


def export_outputs(builder: DiagramBuilder, system: System) -> None:
    """Export all output ports of a system from the diagram, under their names."""
    for index in range(system.num_output_ports()):
        port = system.get_output_port(index)
        builder.ExportOutput(port, port.get_name())


def evaluate(port: OutputPort, context: Context) -> Any:
    """Evaluate an output port of a subsystem in the root diagram's context."""
    return port.Eval(port.get_system().GetMyContextFromRoot(context))


@dataclass(frozen=True, eq=False)
class StagedDiagram(Generic[T]):
    """A diagram with an estimator whose computation can be timed by stages."""

    diagram: Diagram  # The diagram.
    # Output ports by name of the stage, in the order of computation.
    stages: Mapping[str, tuple[OutputPort, ...]]
    estimator: T  # The system that computes the pose.

    def evaluate(self, context: Context, stage: str) -> None:
        """Evaluate all ports of the stage of this name; ``context`` is the diagram's."""
        for port in self.stages[stage]:
            evaluate(port, context)


class PortedSystem(LeafSystem):
    """A LeafSystem that declares ports from model values; an int n is a vector of size n.

    Each port has a getter, named as a MultibodyPlant's: ``get_<name>_input_port()`` or
    ``get_<name>_output_port()``.
    """

    def __getattr__(self, name: str) -> Any:
        """Return the getter of a port; raise AttributeError for any other name."""
        found = re.fullmatch("get_(.+)_(input|output)_port", name)
        if found and getattr(self, f"Has{found[2].title()}Port")(found[1]):
            return partial(getattr(self, f"Get{found[2].title()}Port"), found[1])
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        """Return the names of all attributes, the ports' getters included."""
        kinds = {"input": self.num_input_ports(), "output": self.num_output_ports()}
        return sorted([*super().__dir__(), *(
            f"get_{getattr(self, f'get_{kind}_port')(index).get_name()}_{kind}_port"
            for kind, count in kinds.items() for index in range(count)
        )])  # fmt: skip

    def add_input(self, name: str, model_value: Any) -> InputPort:
        """Declare an input port for values as ``model_value``, or for vectors of this size."""
        if isinstance(model_value, int):
            return self.DeclareVectorInputPort(name, model_value)
        return self.DeclareAbstractInputPort(name, AbstractValue.Make(model_value))

    def add_output(
        self,
        name: str,
        model_value: Any,
        function: Callable[[Context], Any],
        tickets: set[DependencyTicket] | None = None,
    ) -> OutputPort:
        """Declare an output port that a function of the context computes.

        Args:
            name: name of the port.
            model_value: a value of the port's type, or the size of its vector.
            function: maps this system's context to the port's value.
            tickets: what the value depends on; None: all input ports.
        """
        prerequisites = {self.all_input_ports_ticket()} if tickets is None else tickets
        if isinstance(model_value, int):
            return self.DeclareVectorOutputPort(
                name,
                model_value,
                lambda context, output: output.SetFromVector(function(context)),
                prerequisites,
            )
        return self.DeclareAbstractOutputPort(
            name,
            AbstractValue.Make(model_value).Clone,
            lambda context, output: output.set_value(function(context)),
            prerequisites,
        )

    def add_reading(
        self, name: str, size: int, source: OutputPort, unknown: float, read: Callable[[Any], Any]
    ) -> None:
        """Declare an output ``read`` of the output ``source``, ``unknown`` where it is None."""

        def value(context: Context) -> Any:
            known = source.Eval(context)
            return np.full(size, unknown) if known is None else read(known)

        self.add_output(name, size, value)

    def add_cache(self, name: str, function: Callable[[Context], Any]) -> CacheEntry:
        """Declare a cache entry ``name``; ``function`` computes it from a context's input ports."""
        return self.DeclareCacheEntry(
            name,
            ValueProducer(
                AbstractValue.Make(None).Clone,
                lambda context, output: output.set_value(function(context)),
            ),
            {self.all_input_ports_ticket()},
        )

    def add_camera_inputs(
        self, ports: Mapping[str, str], model_value: Callable[[str], Any] = lambda _: None
    ) -> Callable[[Context], dict[str, Any]]:
        """Declare ports by camera's name; return a function of a context: values by camera.

        None and unconnected ports are left out. ``model_value``: maps a camera's name to its port's
        model value; None: a port of any value.
        """
        for name, port in ports.items():
            self.add_input(port, model_value(name))

        def eval_inputs(context: Context) -> dict[str, Any]:
            found = {name: self.eval_input(context, port) for name, port in ports.items()}
            return {name: value for name, value in found.items() if value is not None}

        return eval_inputs

    def add_images(
        self,
        kind: str,
        image: Callable[[int, int], Any],
        cameras: Sequence[Camera],
        names: Collection[str] | None = None,
    ) -> Callable[[Context], dict[str, Any]]:
        """Declare a port for the image of each camera, or of those in ``names``; return as above.

        ``kind``: see ``camera_port``. ``image``: makes an image of a width and a height.
        """
        chosen = {one.name: one for one in cameras if names is None or one.name in names}
        return self.add_camera_inputs(
            {name: camera_port(kind, one, cameras) for name, one in chosen.items()},
            lambda name: image(chosen[name].width, chosen[name].height),
        )

    def add_parameter(self, initial: Any) -> Callable[[Context], Any]:
        """Declare the next abstract parameter; return a function that reads it from a context."""
        index = self.DeclareAbstractParameter(AbstractValue.Make(initial))
        return lambda context: context.get_abstract_parameter(int(index)).get_value()

    def eval_input(self, context: Context, name: str) -> Any:
        """Return the value at the input port ``name``, vectors as a copy; None: not connected."""
        port = self.GetInputPort(name)
        value = port.Eval(context) if port.HasValue(context) else None
        return np.array(value) if isinstance(value, np.ndarray) else value


class ImmutableValue:
    """Base class of immutable values: Drake's deep copies in each update are the value itself."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return self


class BeliefSystem(PortedSystem, Generic[T]):
    """A system whose state is an abstract belief, replaced by an unrestricted periodic update."""

    def declare_belief(
        self,
        initial: T,
        period: float,
        offset: float = 0.0,
        **outputs: tuple[Any, Callable[[T], Any]],
    ) -> None:
        """Declare the belief and its initial value; it is updated at offset + k period [s].

        ``outputs``: model value and ``read`` of ``add_belief_output``, by name of the port.
        """
        self._belief = self.DeclareAbstractState(AbstractValue.Make(initial))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, offset, self._update)
        self.DeclareForcedUnrestrictedUpdateEvent(self._update)
        for name, (model_value, read) in outputs.items():
            self.add_belief_output(name, model_value, read)

    def add_belief_output(
        self, name: str, model_value: Any, read: Callable[[T], Any]
    ) -> OutputPort:
        """Declare an output ``read`` of the belief, of the model value's type or size."""
        ticket = {self.abstract_state_ticket(self._belief)}
        return self.add_output(
            name, model_value, lambda context: read(self.belief(context)), ticket
        )

    def belief(self, context: Context) -> T:
        """Return the belief in a context."""
        known: T = context.get_abstract_state(int(self._belief)).get_value()
        return known

    def next_belief(self, context: Context, last: T) -> T:
        """Return the belief after an update, ``last`` itself if nothing changes; for subclasses."""
        raise NotImplementedError

    def _update(self, context: Context, state: State) -> EventStatus:
        """Write ``next_belief`` to the state."""
        last = self.belief(context)
        known = self.next_belief(context, last)
        if known is last:
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(int(self._belief)).set_value(known)
        return EventStatus.Succeeded()


class MemorySystem(PortedSystem):
    """A system whose state is named vectors, replaced by a periodic update.

    The update is discrete: it sees the results of unrestricted updates at the same time.
    """

    def declare_vectors(
        self, initial: Mapping[str, Array], output_names: Collection[str], period: float
    ) -> None:
        """Declare state vectors, with initial values by name, and their update.

        ``output_names``: of vectors with an output port. ``period``: between two updates [s].
        """
        self._vectors = {name: self.DeclareDiscreteState(value) for name, value in initial.items()}
        for name in output_names:
            self.DeclareStateOutputPort(name, self._vectors[name])
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareForcedDiscreteUpdateEvent(self._update)

    def vectors(self, context: Context) -> dict[str, Array]:
        """Return copies of the state vectors in a context, by name."""
        return {
            name: np.array(context.get_discrete_state(index).value())
            for name, index in self._vectors.items()
        }

    def set_vectors(self, state: DiscreteValues, known: Mapping[str, Array]) -> None:
        """Write arrays of any shape to the state vectors of their names; others stay unchanged."""
        for name, value in known.items():
            state.set_value(self._vectors[name], np.ravel(value))

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """Return the vectors that an update changes, of copies ``known``; for subclasses."""
        raise NotImplementedError

    def _update(self, context: Context, state: DiscreteValues) -> EventStatus:
        """Write ``next_vectors`` to the state."""
        changed = self.next_vectors(context, self.vectors(context))
        self.set_vectors(state, changed)
        return EventStatus.Succeeded() if changed else EventStatus.DidNothing()
