"""The one exception for faults that a user can mend."""


class McaptrackError(Exception):
    """A fault in the input, the options or the machine that its reader can mend.

    The message is one line: what is wrong, where, what there is instead, and what to do. Every other exception is a
    fault of the program and keeps its traceback.
    """


class DamagedError(McaptrackError):
    """A file whose bytes are not what was written; what can be saved of it, `mcaptrack recover` saves."""
