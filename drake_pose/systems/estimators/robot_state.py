"""Estimated positions as LCM messages."""

from collections.abc import Sequence

from drake import lcmt_robot_state
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem


class RobotStateMessage(LeafSystem):
    """Names positions in an lcmt_robot_state, for an LcmPublisherSystem.

    .. pydrake_system::

        name: RobotStateMessage
        input_ports: [positions]
        output_ports: [lcmt_robot_state]

    A message holds 32 bit floats, and the context's time in microseconds.

    Args:
        names: (nq) a name for each position, ``model.position_names``.
    """

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self._names = list(names)
        self._positions = self.DeclareVectorInputPort("positions", len(names))
        self.DeclareAbstractOutputPort(
            "lcmt_robot_state", lambda: AbstractValue.Make(lcmt_robot_state()), self._calc
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        message = lcmt_robot_state()
        message.utime = round(1e6 * context.get_time())
        message.num_joints = len(self._names)
        message.joint_name = self._names
        message.joint_position = self._positions.Eval(context).tolist()
        output.set_value(message)
