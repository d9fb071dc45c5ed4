"""The names of this extension in Python, as the script of a user has them: type checkers read it, and it is never run."""

import mcaptrack

weights: mcaptrack.TrainResult = mcaptrack.train(["tracks.parquet"], "weights.safetensors", epochs=1)
