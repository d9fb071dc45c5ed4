"""What people look at: the report, pictures with what was found on them, and logs served to viewers."""
