"""The names of this extension in Python, as the script of a user has them: type checkers read it, and it is never run."""

import mcaptrack

video: mcaptrack.RenderResult = mcaptrack.render("log.mcap", "walk.mp4", max_fps=5.0, compare=False)
