import mcaptrack

square = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]], "units": "metres"}
counted: mcaptrack.RunResult = mcaptrack.zones("log.mcap", zones=square, max_gap_s=1.0)
later: mcaptrack.RunResult = mcaptrack.run("log.mcap", zones="zones.geojson", tables=False)
most: list[int] = [total.most_inside for result in (counted, later) for total in result.zones["/camera/tracks"]]
print(mcaptrack.draw_zones("log.mcap").name, most)
