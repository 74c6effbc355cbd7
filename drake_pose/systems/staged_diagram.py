"""A diagram whose stages can be evaluated, and so timed, one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pydrake.systems.framework import Context, Diagram, OutputPort

from drake_pose.systems.ports import evaluate


@dataclass(frozen=True, eq=False)
class StagedDiagram:
    """A diagram, and what is computed in it before its state is updated.

    Args:
        stages: the output ports of each stage, in their order: whoever evaluates one after the
            other sees what each costs.
    """

    diagram: Diagram
    stages: Mapping[str, tuple[OutputPort, ...]]

    def evaluate(self, context: Context, stage: str) -> None:
        """Have a stage, one of stages, compute what it has not computed yet."""
        for port in self.stages[stage]:
            evaluate(port, context)
