"""The result of an evaluation: its scores, by name, as rows and as curves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final

from mcaptrack.api.checked import checked
from mcaptrack.api.common import as_path
from mcaptrack.api.options import PathLike
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import COMBINED, EvaluationRow
from mcaptrack.files import publish_bytes, refuse_overwrite
from mcaptrack.notices import Notice

#: What notebooks show of a result: what was compared, and its scores.
_KEYS: Final = ("sequence", "tracks", "similarity", "gate")
_SHOWN: Final = ("HOTA", "MOTA", "IDF1")


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of tracks and predictions against ground truth.

    Attributes
    ----------
    results : tuple of mcaptrack.evaluation.EvaluationRow
        One for each sequence, channel of tracks, similarity and gate; with several sequences also one for all of them
        together, with the ``sequence`` "COMBINED". Where ground truth and tracks have several classes, each is followed
        by one for each class, with the name of the class in ``of_class``.
    notes : tuple of str
        How files were paired and read.
    warnings : tuple of mcaptrack.Notice
        What was assumed, and what could not be compared.

    """

    results: tuple[EvaluationRow, ...]
    notes: tuple[str, ...]
    warnings: tuple[Notice, ...]

    def __repr__(self) -> str:
        return f"Scores({len(self.results)} results; `rows` returns them)"

    def _repr_html_(self) -> str:
        """Return the main scores as a table, for notebooks."""
        cells = [
            [str(row[name]) for name in _KEYS] + [f"{row.get(name, float('nan')):.4f}" for name in _SHOWN]
            for row in self.rows()
        ]
        lines = ["".join(f"<td>{escape(cell)}</td>" for cell in line) for line in cells]
        head = "".join(f"<th>{name}</th>" for name in (*_KEYS, *_SHOWN))
        return f"<table><tr>{head}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"

    def rows(self) -> list[dict[str, Any]]:
        """Return the results as dictionaries, for a ``pandas.DataFrame``.

        Returns
        -------
        list of dict
            One for each result: scores as shares from 0 to 1, counts, lengths in metres.

        Examples
        --------
        >>> import mcaptrack
        >>> mcaptrack.evaluate("log.mcap", gate_m=1.0).rows()[0]["sequence"]
        'log'

        """
        return [result.to_json() for result in self.results]

    def score(
        self,
        name: str,
        tracks: str = "",
        similarity: str = "",
        gate: float | None = None,
        of_class: str | None = None,
    ) -> float:
        """Return one score, of the only result that fits.

        Parameters
        ----------
        name : str
            The score, such as "IDF1".
        tracks : str, optional
            Topic of the tracks, or its end: "retracks" for /camera/retracks.
        similarity : {"iou", "metres", "bev-iou", "3d-iou"}, optional
            How ground truth and tracks were matched.
        gate : float, optional
            Largest distance of a match in metres, or least overlap.
        of_class : str, optional
            Name of a class; by default all classes together.

        Returns
        -------
        float
            The score; with several sequences that of all together.

        Raises
        ------
        McaptrackError
            If no result fits, or more than one.

        Examples
        --------
        >>> import mcaptrack
        >>> scores = mcaptrack.evaluate("log.mcap", gate_m=1.0)
        >>> 0.5 < scores.score("IDF1", "retracks", "metres") <= 1.0
        True

        """
        final = self.final(of_class)
        rows = [row for row in final if row["tracks"].endswith(tracks) and row["similarity"].startswith(similarity)]
        rows = [row for row in rows if gate in (None, row["gate"])]
        whole = [row for row in rows if row["tracks"] == tracks or row["tracks"].endswith(f"/{tracks}")]
        rows = whole or rows
        if len(rows) != 1:
            there = ", ".join(f"{row['tracks']} {row['similarity']} {row['gate']:g}" for row in rows or final)
            raise McaptrackError(
                f"{len(rows) or 'no'} results fit `tracks={tracks!r}`, `similarity={similarity!r}` and `gate={gate}`; "
                f"choose one of: {there}"
            )
        _check_name(name, rows[0])
        return float(rows[0][name])

    def final(self, of_class: str | None = None) -> list[dict[str, Any]]:
        """Return the rows of all sequences together.

        Parameters
        ----------
        of_class : str, optional
            Name of a class; by default all classes together.

        Returns
        -------
        list of dict
            Of ``rows``, those of all sequences together, or of the only sequence.

        Raises
        ------
        McaptrackError
            If no such class was scored.

        Examples
        --------
        >>> import mcaptrack
        >>> scores = mcaptrack.evaluate("log.mcap", gate_m=1.0)
        >>> scores.final() == scores.rows()
        True

        """
        rows = [row for row in self.rows() if row["class"] == of_class]
        if not rows and of_class is not None:
            there = ", ".join(dict.fromkeys(one.of_class for one in self.results if one.of_class is not None))
            raise McaptrackError(f"no class {of_class!r:.60} was scored by itself; there are {there or 'none'}")
        return [row for row in rows if row["sequence"] == COMBINED] or rows

    @checked()
    def draw_curves(self, output: PathLike, force: bool = False) -> Path:
        """Draw the error of predictions (ADE) over recall, in metres and squared, as an SVG.

        Parameters
        ----------
        output : path
            The file to write.
        force : bool, default False
            Replace the file if it exists.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        McaptrackError
            If no predictions were scored, or if the file exists.

        Examples
        --------
        >>> import mcaptrack
        >>> scores = mcaptrack.evaluate("log.mcap", smoothed=True)
        >>> scores.draw_curves("curves.svg").name
        'curves.svg'

        """
        from mcaptrack.viewing.curves import curves_svg

        whole = [one for one in self.results if one.of_class is None and one.displacement is not None]
        whole = [one for one in whole if one.sequence == COMBINED] or whole
        found = {one.tracks: one.displacement for one in whole if one.displacement is not None}
        if not found:
            raise McaptrackError("no predictions were scored; there are no curves to draw")
        path = as_path(output)
        refuse_overwrite(path, force)
        publish_bytes(path, curves_svg(found).encode())
        return path

    def below(self, limits: Mapping[str, float]) -> list[str]:
        """Return the scores that are below a limit.

        Parameters
        ----------
        limits : mapping of str to float
            Least scores by name.

        Returns
        -------
        list of str
            A line for each score of ``final`` that is lower.

        Examples
        --------
        >>> import mcaptrack
        >>> mcaptrack.evaluate("log.mcap").below({"IDF1": 0.0})
        []

        """
        for name in limits:
            _check_name(name, *self.final()[:1])
        return [
            f"{row['sequence']} {row['tracks']} {row['similarity']} {row['gate']:g}: "
            f"{name} {row[name]:.4f} is under {least:g}"
            for name, least in limits.items()
            for row in self.final()
            if row[name] < least
        ]


def _check_name(name: str, row: Mapping[str, Any]) -> None:
    """Raise McaptrackError if a row has no score of this name."""
    scores = [key for key, value in row.items() if isinstance(value, int | float) and key != "gate"]
    if name not in scores:
        raise McaptrackError(f"there is no score {name}; there are {', '.join(scores)}")
