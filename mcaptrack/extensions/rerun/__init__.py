"""A log as a recording of Rerun, which `mcaptrack view` opens, too."""
