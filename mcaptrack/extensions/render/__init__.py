"""Videos and pictures of logs: annotated, compared side by side, with people hidden; where people spend their time."""
