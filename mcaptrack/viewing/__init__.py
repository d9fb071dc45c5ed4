"""Output for people: the report, videos with drawings, and logs served to viewers."""
