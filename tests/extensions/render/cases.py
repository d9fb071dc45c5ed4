"""Cases of ``render`` for the tests of the core."""

import mcaptrack

READING = {"render": lambda log, out: [log, "-o", out / "rendered.gif", "--width", "64", "--end-s", "0.2"]}
EFFECTS = {
    "render": (
        "render a.mcap",
        {
            "topic": "--topic /camera/detections/view/image",
            "compare": "--compare",
            "heatmap": "--heatmap",
            "blur": "--blur people",
            "width": "--width 32",
            "max_fps": "--max-fps 5",
            "start_s": "--start-s 1",
            "end_s": "--end-s 1",
            "gif": "--gif",
            "camera": "--camera other",
            "output": "-o b.mp4",
            "force": ("render a.mcap -o clip.mp4", "--force"),
        },
    )
}
USES = {
    "render": [
        "render a.mcap -o b.mp4",
        "render a.mcap --blur people -o c.mcap",
        "render a.mcap --compare --end-s 0.2",
        "render a.mcap --heatmap",
    ]
}
TOPICS = {"render": ("tracks", lambda p, t, f: mcaptrack.render(p, f / "a.mp4", topic=t, end_s=0.3).views)}
UNUSED = {"render": ("render", {"log": "log.mcap", "output": "a.gif", "gif": True, "end_s": 0.2}, "gif")}
REFUSED = {"a folder for a video": (lambda: mcaptrack.render("."), ". is a folder, not an MCAP file")}
WRITTEN = {name: lambda path, output: mcaptrack.render(path, output=output) for name in ("a.mp4", "a.gif")}
PROPOSALS = {
    "extensions/render/blur/recording.py:blurrable:run": lambda s: s.ingested("clip.mp4").says(
        "render", "LOG", "--blur", "people", "-o", "c.mcap"
    ),
    "extensions/render/comparing.py:find_panels:run": lambda s: s.untracked().says("render", "LOG", "--compare"),
    "extensions/render/heat_map.py:_channel:run": lambda s: s.ingested("clip.mp4").says("render", "LOG", "--heatmap"),
}
#: Modules of the core that aren't public, and why it needs them.
DEEP = {
    "render": (
        "it writes pictures as their channel says, and draws what views draw",
        "cli.many foxglove.views.ground foxglove.views.people foxglove.views.projected foxglove.views.styles geometry.pinhole "
        "schema.resampling sources.calibrations sources.fixed_frame sources.foreign.definitions "
        "sources.video.pixels",
    )
}
