"""Estimated positions as LCM messages."""

from collections.abc import Sequence

from drake import lcmt_robot_state
from pydrake.systems.framework import Context

from drake_pose.systems.ports import PortedSystem


class RobotStateMessage(PortedSystem):
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
        self.add_input("positions", len(names))
        self.add_output(
            "lcmt_robot_state", lcmt_robot_state(), self._calc, {self.all_sources_ticket()}
        )

    def _calc(self, context: Context) -> lcmt_robot_state:
        message = lcmt_robot_state()
        message.utime = round(1e6 * context.get_time())
        message.num_joints = len(self._names)
        message.joint_name = self._names
        message.joint_position = self.GetInputPort("positions").Eval(context).tolist()
        return message
