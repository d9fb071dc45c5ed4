import mcaptrack

weights: mcaptrack.TrainResult = mcaptrack.train(["tracks.parquet"], "weights.safetensors", epochs=1)
