"""The metadata.yaml of a rosbag2 folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mcaptrack.errors import McaptrackError

METADATA: Final = "metadata.yaml"


@dataclass
class Bag:
    """What a metadata.yaml says of a bag."""

    text: bytes = b""
    distro: str = ""
    #: Whether each message is compressed by itself.
    packed: bool = False
    #: Topic, type, serialization, quality of service, type hash, and how many messages the bag holds.
    topics: Sequence[tuple[str, str, str, str, str, int]] = ()


def read_metadata(path: Path) -> tuple[Bag, list[str]]:
    """A metadata.yaml, and the files that it names. Raises McaptrackError if it is none."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        text = path.read_bytes()
        said = YAML(typ="safe", pure=True).load(text.decode("utf-8"))["rosbag2_bagfile_information"]
        mode, compression = str(said.get("compression_mode") or ""), str(said.get("compression_format") or "")
        topics = []
        for entry in said.get("topics_with_message_count") or []:
            topic = entry["topic_metadata"]
            encoding, qos = (
                str(topic.get("serialization_format", "cdr")),
                _yaml(topic.get("offered_qos_profiles") or ""),
            )
            digest = str(topic.get("type_description_hash") or "")
            topics.append((str(topic["name"]), str(topic["type"]), encoding, qos, digest, int(entry["message_count"])))
        names = [str(name) for name in said["relative_file_paths"]]
        bag = Bag(text, str(said.get("ros_distro") or ""), mode.lower() == "message", topics)
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None
    except (YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        why = " ".join(str(error).split())[:120]
        raise McaptrackError(f"{path} is no metadata of a rosbag2 bag ({why})") from None
    if mode.lower() not in ("", "none") and compression.lower() != "zstd":
        raise McaptrackError(f"{path}: the bag is compressed with {compression!r}; zstd is read")
    return bag, names


def _yaml(value: Any) -> str:
    """Words as they are; anything else, as it is since ROS 2 Jazzy, as YAML."""
    if isinstance(value, str):
        return value
    from io import StringIO

    from ruamel.yaml import YAML

    out = StringIO()
    YAML(typ="safe", pure=True).dump(value, out)
    return out.getvalue()
