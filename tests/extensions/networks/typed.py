from pathlib import Path

import mcaptrack

network: Path = mcaptrack.get_model("yolox-nano")
catalogue: tuple[mcaptrack.Model, ...] = mcaptrack.models()
print(network, [model.name for model in catalogue])
