import mcaptrack

video: mcaptrack.RenderResult = mcaptrack.render("log.mcap", "walk.mp4", max_fps=5.0, compare=False)
