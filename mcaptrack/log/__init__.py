"""Logs: MCAP files, and nothing else here knows what is in them.

with read(path) as log:                 channels, messages, frames
    with extend(log) as writer: ...     the same file with channels added or left out
with create(path) as writer: ...        a new one
check(path)                             is it sound
recover(path, output)                   what is whole in it, as a new one
"""

from mcaptrack.log.change import extend, refuse_recorded
from mcaptrack.log.check import Checked, check
from mcaptrack.log.check_summary import Finding
from mcaptrack.log.messages import Columns, Message, Places
from mcaptrack.log.names import results_of
from mcaptrack.log.other_kinds import parts_in, refuse_other_kinds
from mcaptrack.log.reader import Channel, Log, read, topics_with_schema
from mcaptrack.log.recover import Recovered, recover
from mcaptrack.log.stream import header, pass_on_extras, stream
from mcaptrack.log.writer import LIBRARY, LogWriter, create

__all__ = [
    "LIBRARY",
    "Channel",
    "Checked",
    "Columns",
    "Finding",
    "Log",
    "LogWriter",
    "Message",
    "Places",
    "Recovered",
    "check",
    "create",
    "extend",
    "header",
    "parts_in",
    "pass_on_extras",
    "read",
    "recover",
    "refuse_other_kinds",
    "refuse_recorded",
    "results_of",
    "stream",
    "topics_with_schema",
]
