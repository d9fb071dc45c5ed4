"""Players of logs for notebooks and for `mcaptrack view`: pictures with what was found in them, as HTML."""
