"""Messages of robots as Arrow columns: a batch of messages is read field by field, all messages at once.

``cdr`` reads ROS 2 (CDR) and ROS 1, ``protobuf`` protobuf. Both give the same form, by the path of each field: numbers
and texts as they are typed, times as timestamps in UTC, durations as whole numbers of nanoseconds (``..._ns``), lists
as lists, messages in lists as structs, bytes as binary, enumerations of protobuf by name. Columns are not written back
to messages: bags take over recorded messages as they are, and those of ours are few.
"""

from mcaptrack.columns.cdr import Malformed as Malformed
from mcaptrack.columns.cdr import RosColumns as RosColumns
from mcaptrack.columns.cdr import Unsupported as Unsupported
from mcaptrack.columns.protobuf import ProtobufColumns as ProtobufColumns
