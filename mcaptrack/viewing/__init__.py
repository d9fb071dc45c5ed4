"""What people look at: the report, videos with drawings, and logs served to viewers."""
