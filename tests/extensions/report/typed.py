import mcaptrack

page: mcaptrack.ReportResult = mcaptrack.report("log.mcap")
