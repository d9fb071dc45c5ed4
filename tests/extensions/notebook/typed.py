import mcaptrack

with mcaptrack.open("log.mcap") as recording:
    player: mcaptrack.Player = recording.show(end_s=1.0)
    print(player.pictures)
