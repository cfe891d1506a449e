"""What ground stations ask for and a Floaty does not have: missions, fences, rally points, logs, sole control.

Each question is answered with "none", because a client that gets no answer asks again and again. The end of a
transaction, MISSION_ACK or LOG_REQUEST_END, is not answered.
"""

from firmware_py.links.mavlink_stack import MavlinkStack
from firmware_py.wire import mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_frames import Message


def answer_for_what_is_not_there(stack: MavlinkStack) -> None:
    """Add the answers to the link."""

    def refuse_control(request: Message) -> None:
        stack.reply(services.no_control(request))
        stack.notice(request, "no client gets control for itself alone")

    def refuse_mission(message: Message) -> None:
        stack.reply(services.refused_mission(message))

    for name in mavlink.MISSION_MESSAGES:
        stack.handle(name, refuse_mission)
    stack.handle("MISSION_REQUEST_LIST", lambda request: stack.reply(services.no_mission(request)))
    stack.handle("LOG_REQUEST_LIST", lambda request: stack.reply(services.no_logs()))
    stack.handle("LOG_REQUEST_DATA", lambda request: stack.reply(services.no_log_data(request)))
    stack.handle("CHANGE_OPERATOR_CONTROL", refuse_control)
