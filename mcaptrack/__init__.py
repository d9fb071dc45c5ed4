"""Find people in a video or a log, track them, repair the tracks, predict where they go, and write it all back."""

__version__ = "0.1.0"
