"""Names of types of messages, which writers spell in several ways: normalised here, for everything that asks for one.

``sensor_msgs/Image`` is also ``sensor_msgs/msg/Image`` (ROS 2), ``sensor_msgs::msg::Image`` (IDL),
``sensor_msgs::msg::dds_::Image_`` (DDS) and ``sensor_msgs.msg.Image`` (Python); ``foxglove.RawImage`` is also
``foxglove_msgs/msg/RawImage`` and ``foxglove::RawImage``.
"""

from __future__ import annotations

import re
from itertools import takewhile
from typing import Final

_SEPARATOR: Final = re.compile(r"::|[/.]")
_PART: Final = re.compile(r"[A-Za-z]\w*", re.ASCII)
#: Parts of names that say only where a type is defined.
_PLACES: Final = ("msg", "dds_")
_FOXGLOVE: Final = ("foxglove", "foxglove_msgs")


def parts_of(name: str) -> tuple[str, ...]:
    """The package and the type in a name, ("sensor_msgs", "Image"), or more parts, or fewer; () for a text that is
    no name.
    """
    written = [part for part in _SEPARATOR.split(name.strip()) if part]
    parts = [part for part in written if part not in _PLACES]
    if not parts or not all(map(_PART.fullmatch, parts)):
        return ()
    return (*parts[:-1], parts[-1].rstrip("_"))  # of DDS; names in ROS don't end so


def plain_name(name: str) -> str:
    """The normalised name of a type: as in ROS 1, sensor_msgs/Image, or as in Foxglove, foxglove.RawImage.

    Names that are neither stay as they are.
    """
    parts = parts_of(name)
    if len(parts) != 2:
        return name
    package, kind = parts
    if package in _FOXGLOVE:
        return f"foxglove.{kind}"
    is_ros = any(mark in name for mark in ("/", "::", ".msg.")) or package.endswith("_msgs")
    return f"{package}/{kind}" if is_ros else name


def ros_type(name: str) -> str:
    """The name of a type as ROS 2 has it: sensor_msgs/msg/Image; those of IDL may have other parts. "" for none."""
    parts = parts_of(name)
    return "{}/msg/{}".format(*parts) if len(parts) == 2 else "/".join(parts)


def shared_parts(topic: str, other: str) -> int:
    """Return the number of parts that the names of two topics begin with together."""
    pairs = zip(topic.split("/"), other.split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
