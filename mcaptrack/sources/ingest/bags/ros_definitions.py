"""Definitions of standard ROS messages, from rosbags, for recordings that don't contain them."""

from __future__ import annotations

from functools import cache


@cache
def known_definition(kind: str, distro: str, digest: str) -> tuple[str, str]:
    """The definition of a message type, and the ROS distribution that it is from.

    That is the given distribution, or else the newest one with the same type hash; ("", "") if there is none.
    """
    from rosbags.typesys import Stores, get_typestore

    all_stores = {store.value.removeprefix("ros2_"): store for store in Stores if store.value.startswith("ros2_")}
    named = {distro: all_stores[distro]} if distro in all_stores else {}
    for name, store in (named or dict(reversed(all_stores.items()))).items():
        types = get_typestore(store)
        try:
            if digest.startswith("RIHS01_") and types.hash_rihs01(kind) != digest:
                continue
            return types.generate_msgdef(kind, ros_version=2)[0], f"ROS 2 {name.capitalize()}"
        except Exception:  # noqa: BLE001, PERF203, S112, RUF100  # it raises various exceptions for unknown types
            continue
    return "", ""
