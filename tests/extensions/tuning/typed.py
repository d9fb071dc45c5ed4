import mcaptrack

best: mcaptrack.TuneResult = mcaptrack.tune(["log.mcap"], search={"min_iou": (0.1, 0.4)}, trials=2)
tracked: mcaptrack.RunResult = mcaptrack.track("log.mcap", output="tuned.mcap", **best.settings)
