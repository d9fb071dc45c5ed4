"""``mcaptrack review``: what it prints while it asks, and after the log was solved again."""

from __future__ import annotations

import webbrowser
from typing import TYPE_CHECKING, Annotated, Any

from mcaptrack.api.common import warn_unused
from mcaptrack.api.declared import Option
from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.text import show
from mcaptrack.errors import command

if TYPE_CHECKING:
    from mcaptrack import Review


class ReviewCommand(Once["Review"]):
    """Ask on a page, and solve the log again."""

    class More:
        """Options that the function has no use for."""

        print: Annotated[bool, Option("What is asked", help="Print the questions, and serve no page.")] = False
        open: Annotated[bool, Option("Page", help="Open the page in the browser.")] = False

    def print_result(self, done: Review, talk: common.Talk) -> None:
        """Serve the page until all is answered, or until Ctrl-C; then solve the log again."""
        if done.result is None and done.questions and not self.values["print"]:
            with done:
                show(f"Open {done.address}")
                try:
                    if self.values["open"]:
                        webbrowser.open(done.address)
                    while not done.is_done.wait(0.2):
                        pass
                except KeyboardInterrupt:
                    talk.detail("no more questions")
                done.finish(talk.progress)
            talk.clear()
        else:
            warn_unused("no page is served", open=True, port=True, host=True)
            if done.result is not None:
                warn_unused("answers are taken, and no questions are printed", print=True)
        super().print_result(done, talk)

    def data(self, done: Review) -> dict[str, Any]:
        """Return the questions, their answers and what these changed as values of JSON."""
        data: dict[str, Any] = {"log": str(done.log), "camera": done.camera, "questions": done.described()}
        if done.result is not None:
            before, after = done.result.identities
            data |= {"identities_before": before, "identities_after": after, "rows_changed": done.result.rows}
            data["warnings"] = [str(notice) for notice in (done.result.run.warnings if done.result.run else ())]
        return data

    def show(self, done: Review, talk: common.Talk) -> None:
        """Print the questions, or what the answers changed."""
        if done.result is None and not done.questions:
            show(f"{done.log}: no answer would change anything that re-tracking isn't sure of")
        elif done.result is None:
            for asked in done.described():
                text = "one person" if "-" in asked["name"] else "a person"
                show(f"{asked['name']:<26} {text}? {asked['probability']:.0%} yes, decided {asked['decided']}, "
                     f"{asked['rows']} rows")  # fmt: skip
        else:
            before, after = done.result.identities
            count, rows = len(done.result.answers), done.result.rows
            show(f"{done.log}: answered {count}; {before} identities, now {after}; {rows} samples have "
                 "another one")  # fmt: skip
            if count:
                talk.say(f"more questions: {command('review', done.log)}")
