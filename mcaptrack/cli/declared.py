"""Commands of declared functions (``api.declared``): their options, their help, and calls on each of many logs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeVar

import typer

import mcaptrack
from mcaptrack.api.declared import Parameter, one_of_many, options_of, with_dashes, words_of
from mcaptrack.cli import common
from mcaptrack.cli.many import LogWork, process, takes_many
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack.fleet import NamedLog

T = TypeVar("T")
_OF_ALL: dict[str, Any] = {"json": common.Json, "quiet": common.Quiet, "verbose": common.Verbose}


class EachLog(Generic[T]):
    """A command that calls its function with each log: how it prints what this returns.

    ``given`` has the options of the call. Subclasses override what differs.
    """

    #: As in ``LogWork``.
    names_output = False

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.given = values

    @classmethod
    def function_of(cls, name: str) -> Callable[..., None]:
        """Return the function of the command: with its options as Typer takes them."""
        declared = getattr(mcaptrack, name)
        names = [option.name for option in options_of(declared) if option.name != "output"]

        def run(values: Mapping[str, Any]) -> None:
            cls(values)._run(name, names)

        return command(name, declared, run)

    def logs(self) -> Sequence[NamedLog]:
        """Return the inputs."""
        from mcaptrack.fleet import find_logs

        return find_logs(self.given["logs"])

    def arguments(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the arguments of the function, of these names."""
        return {name: self.given[name] for name in names}

    def suffix(self) -> str:
        """Return the end of the names of outputs in ``--output-dir``."""
        return ".mcap"

    def line(self, done: T) -> str:
        """Return a result as a line of text."""
        raise NotImplementedError

    def data(self, done: T) -> dict[str, Any]:
        """Return a result as values of JSON."""
        raise NotImplementedError

    def show(self, log: Location, done: T, talk: common.Talk) -> None:
        """Print the result of one log alone."""
        talk.say(f"{log}: {self.line(done)}")

    def code(self, results: Sequence[T]) -> int:
        """Return the exit code."""
        return common.DONE

    def _run(self, name: str, names: Sequence[str]) -> None:
        values = self.given
        with common.Talk(values["quiet"], values["verbose"]).open() as talk:
            logs, arguments = self.logs(), self.arguments(names)
            work: LogWork[T] = LogWork(
                name,
                getattr(mcaptrack, name),
                arguments,
                show=lambda log, done: self.show(log, done, talk),
                data=self.data,
                line=self.line,
                suffix=self.suffix(),
                names_output=self.names_output,
            )
            results, totals = process(logs, work, talk, values["output"])
        if values["json"]:
            common.print_json({"results": [self.data(result) for result in results], **totals})
        if code := self.code(results):
            raise typer.Exit(code)


def command(
    name: str,
    declared: Callable[..., Any],
    run: Callable[[Mapping[str, Any]], None],
    more: Mapping[str, Any] | None = None,
) -> Callable[..., None]:
    """Return the function of a command, with the signature of a declared function as Typer takes it.

    ``more`` are options in the place of ``**options``. ``run`` gets the values of all.
    """
    annotations: dict[str, tuple[Any, Any]] = {}
    if each := one_of_many(declared):
        argument = typer.Argument(metavar=each.metavar, help=each.help, show_default=False)
        annotations[each.name] = Annotated[list[Path], argument], inspect.Parameter.empty
    annotations |= {parameter.name: (annotation_of(parameter), parameter.default) for parameter in options_of(declared)}
    annotations |= dict(more or {})
    annotations |= {option: (hint, False) for option, hint in _OF_ALL.items()} | {"config": (common.Config, None)}

    def call(**values: Any) -> None:
        run(values)

    keyword = inspect.Parameter.KEYWORD_ONLY
    call.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(n, keyword, default=default, annotation=hint) for n, (hint, default) in annotations.items()]
    )
    call.__name__, call.__annotations__ = name, {n: hint for n, (hint, _) in annotations.items()}
    function: Any = common.one_line(takes_many()(call) if each else call)
    function.settable = ()
    function.help, function.most_used = help_of(declared), getattr(declared, "most_used", ())
    return function  # type: ignore[no-any-return]


def annotation_of(parameter: Parameter) -> Any:
    """Return the annotation of an option, as Typer takes it."""
    about = parameter.option
    settings: dict[str, Any] = {"help": parameter.help, "metavar": about.metavar}
    if parameter.shown is not None:
        settings["show_default"] = parameter.shown
    if about.names is not None:
        settings["autocompletion"] = about.names
    info = common.option(
        *parameter.flags,
        panel=about.panel,
        tuning=about.tuning,
        least=about.least,
        most=about.most,
        **settings,
    )
    kind: Any = list[parameter.kind] if parameter.many else parameter.kind  # type: ignore[name-defined]
    return Annotated[kind | None if parameter.default is None else kind, info]


def help_of(declared: Callable[..., Any]) -> str:
    """Return the help of a command: the docstring of its function, with options as the command line writes them."""
    doc = words_of(declared)
    flags = {option.name: option.flags[0] for option in options_of(declared)}
    examples = [f"Example: {line}" for line in doc.examples]
    return "\n\n".join([with_dashes(doc.text, flags), *examples])
