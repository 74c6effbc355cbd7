"""A system by itself on the bench: what it is given, its updates, and what it says."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator


class Bench:
    """A system or diagram with a context; what is given at its ports stays given."""

    def __init__(self, system, context=None):
        self.system = system
        self.context = system.CreateDefaultContext() if context is None else context
        self._simulator = None

    def give(self, **inputs):
        """Fixes inputs by name; anything but an array of numbers is an abstract value."""
        for name, value in inputs.items():
            if not isinstance(value, np.ndarray | list):
                value = AbstractValue.Make(value)
            self.system.GetInputPort(name).FixValue(self.context, value)
        return self

    def update(self, at=None, /, **inputs):
        """Inputs, then an update by force, at a time."""
        self.give(**inputs)
        if at is not None:
            self.context.SetTime(at)
        self.system.ExecuteForcedEvents(self.context)
        return self

    def advance(self, until, /, **inputs):
        """Inputs, then a simulation up to a time."""
        self.give(**inputs)
        if self._simulator is None:
            self._simulator = Simulator(self.system, self.context)
            self.context = self._simulator.get_mutable_context()
        self._simulator.AdvanceTo(until)
        return self

    def __getitem__(self, name):
        """What an output says; numbers as a copy."""
        value = self.system.GetOutputPort(name).Eval(self.context)
        return np.array(value) if isinstance(value, np.ndarray) else value
