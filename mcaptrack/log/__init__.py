"""Logs: MCAP files. No other package knows their format.

with read(path) as log:                 channels, messages, frames
    with extend(log) as writer: ...     add channels to the same file, or drop some
with create(path) as writer: ...        a new one
check(path)                             find damage
recover(path, output)                   write what is intact to a new log
"""

from mcaptrack.log.check import CheckResult, check
from mcaptrack.log.check_summary import Finding
from mcaptrack.log.extend import extend, refuse_to_replace_recorded
from mcaptrack.log.jumps import ClockJump, clock_jumps, jumps_text
from mcaptrack.log.messages import ChannelRows, Message, MessageLocations
from mcaptrack.log.opening import find_results, read, topics_with_schema
from mcaptrack.log.paths import results_path
from mcaptrack.log.reader import Channel, Log
from mcaptrack.log.recording_files import refuse_non_mcap, split_files_in
from mcaptrack.log.recover import RecoverResult, recover
from mcaptrack.log.stream import copy_attachments_and_metadata, header, stream
from mcaptrack.log.writer import LIBRARY, LogWriter, create

__all__ = [
    "LIBRARY",
    "Channel",
    "ChannelRows",
    "CheckResult",
    "ClockJump",
    "Finding",
    "Log",
    "LogWriter",
    "Message",
    "MessageLocations",
    "RecoverResult",
    "check",
    "clock_jumps",
    "copy_attachments_and_metadata",
    "create",
    "extend",
    "find_results",
    "header",
    "jumps_text",
    "read",
    "recover",
    "refuse_non_mcap",
    "refuse_to_replace_recorded",
    "results_path",
    "split_files_in",
    "stream",
    "topics_with_schema",
]
