"""A helper that gives a system inputs, updates it and reads its outputs."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator


class Bench:
    """A system or diagram with a context; inputs stay fixed until they are given again."""

    def __init__(self, system, context=None):
        self.system = system
        self.context = system.CreateDefaultContext() if context is None else context
        self._simulator = None

    def give(self, **inputs):
        """Fix inputs by name; values other than arrays and lists are abstract."""
        for name, value in inputs.items():
            if not isinstance(value, np.ndarray | list):
                value = AbstractValue.Make(value)
            self.system.GetInputPort(name).FixValue(self.context, value)
        return self

    def update(self, at=None, /, **inputs):
        """Fix inputs, and force an update at a time [s]."""
        self.give(**inputs)
        if at is not None:
            self.context.SetTime(at)
        self.system.ExecuteForcedEvents(self.context)
        return self

    def advance(self, until, /, **inputs):
        """Fix inputs, and simulate up to a time [s]."""
        self.give(**inputs)
        if self._simulator is None:
            self._simulator = Simulator(self.system, self.context)
            self.context = self._simulator.get_mutable_context()
        self._simulator.AdvanceTo(until)
        return self

    def __getitem__(self, name):
        """Return an output's value, vectors as a copy."""
        value = self.system.GetOutputPort(name).Eval(self.context)
        return np.array(value) if isinstance(value, np.ndarray) else value
