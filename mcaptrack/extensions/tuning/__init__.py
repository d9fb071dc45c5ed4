"""Search for the options of a stage that score best."""
