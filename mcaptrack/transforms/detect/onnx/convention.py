"""Which layout a network has: by its inputs and outputs, or where several fit, by what each finds in pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.transforms.detect.onnx.layouts import LAYOUTS, Layout, NetworkSignature, possible
from mcaptrack.transforms.detect.onnx.nms import Boxes

#: A box with such a score is evidence that a network was read as it was trained: a wrong reading gives lower ones.
_EVIDENCE: Final = 0.4
#: A layout is taken if its evidence is so many times that of each other one.
_CLEAR: Final = 2.0
#: After so many pictures with evidence for several layouts it can't be told.
_PATIENCE: Final = 25


def evidence(boxes: Boxes) -> float:
    """The amount of certain evidence: the sum of high scores."""
    return float(boxes.score[boxes.score >= _EVIDENCE].sum())


def choose(path: Path, name: str, seen: NetworkSignature) -> list[Layout]:
    """The layouts that a network may have: the one of this name, or for "auto" all that fit.

    Raises McaptrackError if the outputs fit none, or not this one.
    """
    fitting = possible(seen)
    if name == "auto":
        if not fitting:
            raise McaptrackError(f"{path} {_outputs(seen)}, as no detector of a known layout does ({_all()})")
        return fitting
    if not LAYOUTS[name].fits(seen):
        others = ", ".join(layout.name for layout in fitting)
        fits = f"that fits {others}" if others else f"that fits no layout ({_all()})"
        raise McaptrackError(f"{path} {_outputs(seen)}, which a detector of layout {name} does not; {fits}")
    return [LAYOUTS[name]]


class Contest:
    """Which of several layouts a network has, by what each finds in pictures that are seen in order.

    ``layouts`` are those that are still possible, one once it is settled.
    """

    def __init__(self, path: Path, layouts: Sequence[Layout]) -> None:
        self._path = path
        self.layouts = list(layouts)
        self._sums = {layout.name: 0.0 for layout in layouts}
        self._pictures = 0

    @property
    def is_settled(self) -> bool:
        """Whether one layout is left."""
        return len(self.layouts) == 1

    def see(self, found: Mapping[str, Boxes | None]) -> None:
        """Judge by what each layout finds in a picture; None where the outputs make no sense.

        Raises McaptrackError if none is left, or if it can't be told.
        """
        if self.is_settled:
            return
        self._keep([layout for layout in self.layouts if found.get(layout.name) is not None])
        if not self.layouts:
            raise McaptrackError(f"{self._path}: its scores are no likelihoods from 0 to 1 in any layout that fits")
        for layout in self.layouts:
            boxes = found[layout.name]
            self._sums[layout.name] += evidence(boxes) if boxes else 0.0
        ordered = sorted(self.layouts, key=lambda layout: -self._sums[layout.name])
        best, second = (self._sums[layout.name] for layout in (ordered * 2)[:2])
        self._pictures += best > 0
        if len(ordered) == 1 or (best > 0 and best >= _CLEAR * second):
            self._keep(ordered[:1])
        elif self._pictures >= _PATIENCE:
            raise McaptrackError(self._unclear())

    def end(self) -> None:
        """Settle on what is left, after the last picture. Raises McaptrackError if it can't be told."""
        if not self.is_settled and self._pictures:
            raise McaptrackError(self._unclear())
        self._keep(self.layouts[:1])

    def _keep(self, layouts: list[Layout]) -> None:
        self.layouts = layouts

    def _unclear(self) -> str:
        names = " and ".join(layout.name for layout in self.layouts)
        return f"{self._path} finds much the same read as {names}; choose with `layout=`"


def refuse_if_misread(
    path: Path, layout: Layout, pictures: int, found: Mapping[str, Sequence[Boxes | None]], is_chosen: bool
) -> None:
    """Refuse a network that found nothing in any picture though another layout finds boxes in some of them.

    Parameters
    ----------
    path : Path
        Of the network.
    layout : Layout
        The layout by which it found nothing.
    pictures : int
        How many pictures there were.
    found : mapping of str to sequence of Boxes or None
        What each other layout that fits finds in some of the pictures.
    is_chosen : bool
        Whether the layout was named.

    """
    for name, boxes in found.items():
        with_boxes = [one for one in boxes if one is not None and evidence(one) > 0]
        if with_boxes:
            count = sum(int((one.score >= _EVIDENCE).sum()) for one in with_boxes)
            instead = f"choose `layout={name}`" if is_chosen else "choose with `layout=`"
            raise McaptrackError(
                f"{path}, read as {layout.name}, finds nothing in {pictures} pictures, and read as {name} finds "
                f"{count} boxes in {len(with_boxes)} of {len(boxes)}; {instead}"
            )


def _outputs(seen: NetworkSignature) -> str:
    some = [f"{name} {' x '.join(map(str, array.shape)) or 'a number'}" for name, array in seen.outputs.items()]
    more = f" and {len(some) - 6} more" if len(some) > 6 else ""
    return f"takes {', '.join(seen.inputs)} and gives {', '.join(some[:6])}{more} at {seen.size[0]}x{seen.size[1]}"


def _all() -> str:
    return ", ".join(LAYOUTS)
