"""Forced updates equal periodic ones, and each port has a getter."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_pose.systems.ports import BeliefSystem, MemorySystem


class Counter(MemorySystem):
    def __init__(self) -> None:
        super().__init__()
        self.add_input("step", 1)
        self.declare_vectors({"count": np.zeros(1)}, ["count"], 0.5)

    def next_vectors(self, context, known):
        return {"count": known["count"] + self.eval_input(context, "step")}


class Abstract(BeliefSystem[int]):
    def __init__(self) -> None:
        super().__init__()
        self.add_input("step", 1)
        self.declare_belief(0, 0.5)
        self.add_belief_output("count", 1, lambda known: [known])

    def next_belief(self, context, last):
        return last + int(self.eval_input(context, "step")[0])


@pytest.mark.parametrize("make", [Counter, Abstract])
def test_forced_updates_equal_periodic_ones(make):
    system = make()
    assert {"get_step_input_port", "get_count_output_port"} <= {*dir(system)}
    assert system.get_count_output_port().get_name() == "count"
    with pytest.raises(AttributeError, match="get_count_input_port"):
        system.get_count_input_port()
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_step_input_port().FixValue(context, [2.0])
    simulator.AdvanceTo(0.6)
    count = system.GetOutputPort("count")
    assert count.Eval(context) == [4.0]
    if make is Counter:
        state = context.Clone().get_mutable_discrete_state()
        system.CalcForcedDiscreteVariableUpdate(context, state)
        assert state.value() == [6.0]
    else:
        after = context.Clone()
        system.CalcForcedUnrestrictedUpdate(context, after.get_mutable_state())
        assert count.Eval(after) == [6.0]
    assert count.Eval(context) == [4.0]
    system.ExecuteForcedEvents(context)
    assert count.Eval(context) == [6.0]
