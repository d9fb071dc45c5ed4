"""Which layout a network has: by its inputs and outputs, or where several fit, by what each finds in pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from mcaptrack.errors import McaptrackError
from mcaptrack.transforms.detect.onnx.layouts import LAYOUTS, Layout, NetworkSignature, possible, recognised
from mcaptrack.transforms.detect.onnx.nms import Boxes
from mcaptrack.transforms.detect.onnx.outputs import SURE, MisreadError

#: What a layout finds in a picture, or why the outputs can't be read by it.
Found = Boxes | MisreadError
#: A layout is taken if its evidence is so many times that of each other one.
_CLEAR: Final = 2.0
#: After so many pictures with evidence for several layouts it can't be told.
_PATIENCE: Final = 25


def evidence(boxes: Boxes) -> float:
    """The amount of certain evidence: the sum of high scores."""
    return float(boxes.score[boxes.score >= SURE].sum())


def choose(path: Path, name: str, seen: NetworkSignature) -> list[Layout]:
    """The layouts that a network may have: the one of this name, or for "auto" all that fit.

    Raises McaptrackError if the outputs fit none, or not this one.
    """
    fitting = possible(seen)
    if name == "auto":
        if found := recognised(seen):
            return found
        if fitting:
            names = ", ".join(layout.name for layout in fitting)
            raise McaptrackError(f"{path} {_outputs(seen)}; its layout may be one of {names}: choose with `layout=`")
        raise McaptrackError(f"{path} {_outputs(seen)}, as no detector of a known layout does ({_all()})")
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

    def see(self, found: Mapping[str, Found]) -> None:
        """Judge by what each layout finds in a picture.

        Raises McaptrackError if none is left, or if it can't be told.
        """
        if self.is_settled:
            return
        boxes = {name: one for name, one in found.items() if isinstance(one, Boxes)}
        if not any(layout.name in boxes for layout in self.layouts):
            why = "; ".join(f"read as {layout.name}, {found[layout.name]}" for layout in self.layouts)
            raise McaptrackError(f"{self._path} fits no layout: {why}")
        self._keep([layout for layout in self.layouts if layout.name in boxes])
        for layout in self.layouts:
            self._sums[layout.name] += evidence(boxes[layout.name])
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
    path: Path, layout: Layout, pictures: int, found: Mapping[str, Sequence[Found]], is_chosen: bool
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
    found : mapping of str to sequence of Boxes or MisreadError
        What each other layout that fits finds in some of the pictures.
    is_chosen : bool
        Whether the layout was named.

    """
    for name, boxes in found.items():
        with_boxes = [one for one in boxes if isinstance(one, Boxes) and evidence(one) > 0]
        if with_boxes:
            count = sum(int((one.score >= SURE).sum()) for one in with_boxes)
            instead = f"choose `layout={name!r}`" if is_chosen else "choose with `layout=`"
            raise McaptrackError(
                f"{path}, read as {layout.name}, finds nothing in {pictures} pictures, and read as {name} finds "
                f"{count} boxes in {len(with_boxes)} of {len(boxes)}; {instead}"
            )


def _outputs(seen: NetworkSignature) -> str:
    some = [f"{name} {' x '.join(map(str, array.shape)) or 'a number'}" for name, array in seen.outputs.items()]
    more = f" and {len(some) - 6} more" if len(some) > 6 else ""
    names = f", with {seen.names} names of classes" if seen.names else ""
    size = f"{seen.size[0]}x{seen.size[1]}"
    return f"takes {', '.join(seen.inputs)} and gives {', '.join(some[:6])}{more} at {size}{names}"


def _all() -> str:
    return ", ".join(LAYOUTS)
