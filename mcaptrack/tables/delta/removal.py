"""Remove logs from Delta tables, so that a kill in between leaves nothing that counts as complete."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location
from mcaptrack.tables.delta.commit import Batch, Committed, predicate
from mcaptrack.tables.delta.opening import CATALOGUE, DIGESTS, DeltaFolder


def remove(where: Location, recordings: Sequence[str]) -> Committed:
    """Remove logs from Delta tables, by their names or patterns of them; older versions still have them.

    Raises McaptrackError if there is no such log, or if the tables can't be written.
    """
    folder = DeltaFolder(where)
    job = Batch(folder, Committed())
    there = folder.recordings()
    found: dict[str, None] = {}
    for wanted in recordings:
        names = [wanted] if wanted in there else [name for name in there if fnmatchcase(name, wanted)]
        if not names:
            near = get_close_matches(wanted, there, 3) or there[:3]
            raise McaptrackError(f"{where} has no log {wanted}; it has {', '.join(near) or 'none'}{_more(there, near)}")
        found.update(dict.fromkeys(names))
    only = predicate(list(found))
    # Without digests the logs count as incomplete until their rows are gone, and an export writes all of them again.
    job.change(CATALOGUE, lambda table, how: table.update({DIGESTS: "'{}'"}, predicate=only, commit_properties=how))
    for name in folder.names():
        job.change(name, lambda table, how: table.delete(only, commit_properties=how))
    job.done.replaced += found
    return job.done


def _more(there: Sequence[str], named: Sequence[str]) -> str:
    left = len(there) - len(named)
    return f" and {left} more" if left else ""
