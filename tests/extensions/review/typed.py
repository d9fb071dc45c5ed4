import mcaptrack

review: mcaptrack.Review = mcaptrack.review("log.mcap", questions=3)
changes: mcaptrack.ReviewResult = review.finish()
print(changes.rows)
