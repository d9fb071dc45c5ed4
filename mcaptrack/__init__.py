"""Find people in a video or a log, track them, repair the tracks, predict where they go, and write it all back."""

from typing import Final

__version__: Final = "0.1.0"
