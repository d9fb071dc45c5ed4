"""The names of this extension in Python, as the script of a user has them: type checkers read it, and it is never run."""

import mcaptrack

page: mcaptrack.ReportResult = mcaptrack.report("log.mcap")
