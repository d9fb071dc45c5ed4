"""The stores that obstore reads, as a part of mcaptrack."""

from __future__ import annotations

from mcaptrack.extensions.stores import objects
from mcaptrack.location import Url
from mcaptrack.objects import Version

__all__ = ["ObjectStore"]


class ObjectStore:
    """Amazon S3, Google Cloud Storage or Azure Blob Storage. Raises McaptrackError if the library isn't installed."""

    find = staticmethod(objects.find)
    read_end = staticmethod(objects.read_end)
    read_ranges = staticmethod(objects.read_ranges)
    replace = staticmethod(objects.replace)
    delete = staticmethod(objects.delete)
    why_absent = staticmethod(objects.why_absent)
    check = staticmethod(objects.check_store)

    def __init__(self, url: Url) -> None:
        objects.library(url)

    def list_objects(self, prefix: Url) -> list[tuple[Url, Version]]:
        """The objects below a prefix of whole parts."""
        return list(objects.list_objects(prefix))
