"""The names of this extension in Python, as the script of a user has them: type checkers read it, and it is never run."""

import mcaptrack

with mcaptrack.open("log.mcap") as recording:
    player: mcaptrack.Player = recording.show(end_s=1.0)
    print(player.pictures)
