"""The names of this extension in Python, as the script of a user has them: type checkers read it, and it is never run."""

import mcaptrack

review: mcaptrack.Review = mcaptrack.review("log.mcap", questions=3)
changes: mcaptrack.ReviewResult = review.finish()
print(changes.rows)
