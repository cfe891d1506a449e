"""What ground stations ask for and a Floaty does not have: missions, fences, rally points, logs, selectable modes.

Each question is answered with "none", because a client that gets no answer asks again and again. The end of a
transaction, MISSION_ACK or LOG_REQUEST_END, is not answered.
"""

from firmware_py.links.mavlink_stack import MavlinkStack
from firmware_py.wire import mavlink
from firmware_py.wire.mavlink_frames import Message
from firmware_py.wire.mavlink_numbers import Result

DO_SET_MODE = 176  # the command that took SET_MODE's place


def answer_for_what_is_not_there(stack: MavlinkStack) -> None:
    """Add the answers to the link."""

    def refuse_mode(message: Message) -> None:
        source = message.get_srcSystem(), message.get_srcComponent()
        stack.reply(mavlink.command_ack(DO_SET_MODE, Result.UNSUPPORTED, *source))

    def refuse_mission(message: Message) -> None:
        stack.reply(mavlink.refused_mission(message))

    for number in mavlink.MISSION_MESSAGES:
        stack.handle(number, refuse_mission)
    stack.handle(mavlink.MSG_MISSION_REQUEST_LIST, lambda request: stack.reply(mavlink.no_mission(request)))
    stack.handle(mavlink.MSG_LOG_REQUEST_LIST, lambda request: stack.reply(mavlink.no_logs()))
    stack.handle(mavlink.MSG_LOG_REQUEST_DATA, lambda request: stack.reply(mavlink.no_log_data(request)))
    stack.handle(mavlink.MSG_SET_MODE, refuse_mode)
