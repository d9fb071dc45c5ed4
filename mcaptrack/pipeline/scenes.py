"""Scenes of several cameras: an extension, or another package, makes one of cameras that see the same ground.

A scene is a camera without pictures. The provenance of its detections has the transform ``FUSE``, and the names of its
cameras in the parameter ``cameras``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple, TypeVar

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import Planes
from mcaptrack.installed import missing_extension
from mcaptrack.notices import Progress, Say, warn
from mcaptrack.pipeline.pictures import PictureClock
from mcaptrack.pipeline.staleness import is_stale
from mcaptrack.pipeline.write import Made, RunState
from mcaptrack.registry import Entry, blamed, find, names, of_type
from mcaptrack.schema import Frame, Schema
from mcaptrack.schema.provenance import FUSE, Provenance
from mcaptrack.sources.cameras import detections_topic, provenance_of
from mcaptrack.transforms import Stage, Transform

__all__ = ["Member", "Progress", "Say", "SceneMaker"]

T = TypeVar("T")


class Member(NamedTuple):
    """A camera with pictures on which a scene is drawn, and the times of these.

    ``drawn`` takes the schema and the frames of tracks or forecasts of the scene, and whether they are ground truth. It
    returns them at times of the camera, with boxes in its pictures, and its ground planes.

    ``clock`` gives these times.
    """

    clock: PictureClock
    drawn: Callable[[Schema, Sequence[Frame], bool], tuple[Sequence[Frame], Planes]]


class SceneMaker:
    """A maker of scenes: the object that the function of an entry point in ``mcaptrack.scenes`` returns.

    The function is ``declared``; its parameters are options of ``run``. ``off`` says why it does nothing, if it does.
    """

    off: str = ""

    def joinable(self, opened: log.Log, cameras: Sequence[str]) -> tuple[list[str], str]:
        """Return the names of those of these cameras that can be joined; and why others, or all, can't be."""
        raise NotImplementedError

    def join(self, opened: log.Log, cameras: Sequence[str], prefix: str, progress: Progress) -> Mapping[str, Made]:
        """Return the channels of a scene by topic. Raises McaptrackError if the cameras don't fit together."""
        raise NotImplementedError

    def join_again(
        self, opened: log.Log, prefix: str, force: bool, adds: bool, say: Say, progress: Progress
    ) -> Mapping[str, Made] | None:
        """Return channels of a scene that is out of date, or with ``force``; {} if it isn't, None if others made it.

        With ``adds`` it gets cameras that can be joined now, too.
        """
        return None

    def maker_of(self, how: Provenance) -> tuple[Stage, Transform] | None:
        """Return the transform that made a scene, and what finds it; None if it isn't known."""
        return None

    def members(self, state: RunState) -> Sequence[Member]:
        """Return the cameras with pictures on which a scene is drawn."""
        return ()


def _usual() -> Iterator[tuple[Entry, SceneMaker]]:
    for name in names("scene"):
        with suppress(McaptrackError):  # which a run has said
            entry = find("scene", name)
            with blamed(entry, "failed"):
                maker = entry.cls()
            yield entry, maker


def _nothing() -> str:
    return missing_extension("fuse") or "nothing that is installed makes such a scene"


def _joinable(maker: SceneMaker, opened: log.Log, cameras: Sequence[str]) -> tuple[list[str], str]:
    return ([], maker.off) if maker.off else maker.joinable(opened, cameras)


class Scenes:
    """All makers of scenes, with the options of a run, or without any. Each is asked in turn."""

    def __init__(self, makers: Sequence[tuple[Entry, SceneMaker]] | None = None) -> None:
        every = _usual() if makers is None else makers
        self._makers = [(entry, of_type(entry, maker, SceneMaker, "its function")) for entry, maker in every]
        self._used = list[SceneMaker]()

    def _answers(self, question: Callable[[SceneMaker], T]) -> Iterator[T]:
        for entry, maker in self._makers:
            with blamed(entry, "failed"):
                answer = question(maker)
            yield answer

    def _first(self, make: Callable[[SceneMaker], Mapping[str, Made] | None]) -> Mapping[str, Made]:
        """Return the channels of the first maker that doesn't give None, and note that it was used; {} if all do."""
        for (_, maker), channels in zip(self._makers, self._answers(make), strict=False):
            if channels is not None:
                self._used.append(maker)
                return channels
        return {}

    @property
    def unused(self) -> list[Entry]:
        """The makers of other packages that have made no scene so far, and don't say why (``off``)."""
        return [e for e, maker in self._makers if not (e.is_built_in or maker.off or maker in self._used)]

    @property
    def off(self) -> str:
        """The reason why scenes are neither made nor run; "" if there is none."""
        reasons = [maker.off for _, maker in self._makers]
        return "" if "" in reasons else "; ".join(reasons)

    def joinable(self, opened: log.Log, cameras: Sequence[str]) -> tuple[list[str], str]:
        """Return the names of those of these cameras that can be joined; and why others, or all, can't be."""
        reasons = []
        for joined, why in self._answers(lambda maker: _joinable(maker, opened, cameras)):
            if joined:
                return joined, why
            reasons.append(why)
        return [], "; ".join(reasons) or _nothing()

    def join(self, opened: log.Log, cameras: Sequence[str], prefix: str, progress: Progress) -> Mapping[str, Made]:
        """Return the channels of a scene of cameras that can be joined, by topic."""
        return self._first(
            lambda maker: (
                maker.join(opened, cameras, prefix, progress) if _joinable(maker, opened, cameras)[0] else None
            )
        )

    def join_again(
        self, opened: log.Log, prefix: str, force: bool, adds: bool, say: Say, progress: Progress
    ) -> Mapping[str, Made]:
        """Return the channels of a scene that is out of date; {} if there is none, or if what made it isn't there.

        ``force`` and ``adds`` as for ``SceneMaker``.
        """
        how = provenance_of(opened, topic := detections_topic(prefix))
        if how is None or how.transform != FUSE:
            return {}
        count = len(self._used)
        channels = self._first(lambda maker: maker.join_again(opened, prefix, force, adds, say, progress))
        if len(self._used) == count and is_stale(opened, topic):
            warn(f"{topic} is out of date, and stays as it is: {_nothing()}", "out-of-date")
        return channels

    def maker_of(self, how: Provenance) -> tuple[Stage, Transform] | None:
        """Return the transform that made a scene, and what finds it; None if it isn't known."""
        return next(filter(None, self._answers(lambda maker: maker.maker_of(how))), None)

    def members(self, state: RunState) -> list[Member]:
        """Return the cameras with pictures on which a scene is drawn; none if it is a camera itself."""
        how = state.provenance(detections_topic(state.prefix))
        is_scene = how is not None and how.transform == FUSE
        answers = self._answers(lambda maker: maker.members(state)) if is_scene else ()
        return [member for members in answers for member in members]
