"""The names of this extension in Python, as the script of a user has them: type checkers read it, and it is never run."""

import mcaptrack

joined: mcaptrack.RunResult = mcaptrack.fuse(
    "log.mcap", cameras=["east", "west"], clock_offset_s={"east": 0.3}, progress=lambda *_: None
)
moved: mcaptrack.CalibrateResult = mcaptrack.calibrate(joined.log, cameras=("east", "west"), dry_run=True)
corrections: dict[str, mcaptrack.CameraCorrection] = dict(moved.cameras)
print(joined.channels, corrections)
