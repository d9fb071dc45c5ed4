"""Cases of players for the tests of the core."""

import mcaptrack


def _views(path, topic, _) -> tuple[str, ...]:
    with mcaptrack.open(path) as recording:
        return recording.show(0.2, topic=topic).views


TOPICS_OF_RECORDINGS = {"show": ("tracks", _views)}
#: Modules of the core that aren't public, and why it needs them.
DEEP = {
    "notebook": (
        "the player shows what `view` shows",
        "foxglove.messages viewing.links",
    )
}
