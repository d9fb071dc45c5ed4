"""Commands of declared functions (``api.declared``): a class for each command says what it prints.

``Once`` calls the function once, ``many.EachLog`` with each of many. ``command`` makes the function that Typer takes.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Final, Generic, TypeVar, get_type_hints

import typer

import mcaptrack
from mcaptrack.api.declared import (
    Argument,
    OneOfMany,
    Option,
    Parameter,
    arguments_of,
    bare,
    hints_of,
    on_command_line,
    options_of,
    parameter_of,
    with_dashes,
    words_of,
)
from mcaptrack.api.options import FILES, Force, PathLike
from mcaptrack.choices import limits
from mcaptrack.cli import common
from mcaptrack.cli.command import Settable, set_option, values_set
from mcaptrack.cli.help import LAST_PANELS, arranged
from mcaptrack.cli.settings import Elsewhere
from mcaptrack.cli.text import stdout_to_stderr
from mcaptrack.registry import blamed, find

__all__ = ["Once", "Printed"]

T = TypeVar("T")
#: Heading of the options of all commands.
COMMON: Final = LAST_PANELS[-1]


class OfAll:
    """The options of all commands."""

    json: Annotated[bool, Option(COMMON, help="Print JSON for programs.")] = False
    quiet: Annotated[bool, Option(COMMON, short="q", help="Say nothing but errors and warnings.")] = False
    verbose: Annotated[bool, Option(COMMON, short="v", help="Print more, such as where each option was set.")] = False


class Printed:
    """Options of commands that print their results to stdout: the file to write them to."""

    output: Annotated[PathLike | None, Option(FILES, short="o", help="Write to this file instead of stdout.")] = None
    force: Force = False


@dataclass(frozen=True)
class OfPackage:
    """The function of a command of another package. Workers get it by its name; its errors name the package."""

    name: str

    @property
    def __signature__(self) -> inspect.Signature:
        return inspect.signature(find("command", self.name).cls)

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Call the function."""
        entry = find("command", self.name)
        with blamed(entry, "failed"):
            return entry.cls(*arguments, **options)


class Called(Generic[T]):
    """A command that calls its function: how options become arguments, and how it prints what this returns.

    ``values`` are the options of the call, by name. Subclasses override what differs.
    """

    #: A class with the options that the function has no use for, as attributes.
    More: ClassVar[type] = object
    #: The options that come first in the help, if there are any of these among them.
    most_used: ClassVar[tuple[str, ...]] = ()

    def __init__(self, name: str, values: Mapping[str, Any]) -> None:
        self.name: str = name
        self.values: Mapping[str, Any] = values

    @classmethod
    def declaration(cls, name: str) -> Callable[..., T]:
        """Return the function that declares the command: that of the library, of an extension or of a package."""
        function: Callable[..., T] = find("command", name).cls
        return function

    @property
    def function(self) -> Callable[..., T]:
        """The function that is called. It is looked up when the command runs, because another one may stand for it."""
        entry = find("command", self.name)
        own: Callable[..., T] = getattr(mcaptrack, self.name, entry.cls)
        return own if entry.is_built_in else OfPackage(self.name)

    @classmethod
    def options(cls, name: str) -> list[Parameter]:
        """Return the options of a command that its function has no use for."""
        return parameters_of(cls.More)

    @classmethod
    def function_of(cls, name: str) -> Callable[..., None]:
        """Return the function of the command: with its options as Typer takes them."""
        declared = cls.declaration(name)
        names = {option.name: option.name for option in options_of(declared)}
        placed = arguments_of(declared).items()
        names |= {parameter: about.name for parameter, about in placed if not isinstance(about, OneOfMany)}
        return command(name, declared, lambda values: cls(name, values).run(names), cls.options(name), cls.most_used)

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function; ``names`` has the name on the command line of each."""
        return {parameter: self.values[name] for parameter, name in names.items()}

    def data(self, done: T) -> dict[str, Any]:
        """Return a result as values of JSON."""
        raise NotImplementedError

    def run(self, names: Mapping[str, str]) -> None:
        """Call the function with its ``arguments``, and print what it returns."""
        raise NotImplementedError

    def printed(self) -> AbstractContextManager[None]:
        """Write to the file that is named for it, if there is one, what the block prints to stdout."""
        file = self.values["output"] if issubclass(self.More, Printed) else None
        return common.printed_to(file, self.values.get("force", False))


class Once(Called[T]):
    """A command that calls its function once."""

    def show(self, done: T, talk: common.Talk) -> None:
        """Print the result for people."""
        raise NotImplementedError

    def code(self, done: T) -> int:
        """Return the exit code."""
        return common.DONE

    def run(self, names: Mapping[str, str]) -> None:
        """Call the function with its ``arguments``, and print what it returns."""
        with common.Talk(self.values["quiet"], self.values["verbose"]).open() as talk:
            arguments = self.arguments(names)
            with stdout_to_stderr():
                done = common.with_progress(self.function, talk.progress)(**arguments)
            talk.clear()
            self.print_result(done, talk)
        if code := self.code(done):
            raise typer.Exit(code)

    def print_result(self, done: T, talk: common.Talk) -> None:
        """Print the result: for people, or as JSON."""
        with self.printed():
            if self.values["json"]:
                common.print_json(self.data(done))
            else:
                self.show(done, talk)


def command(
    name: str,
    declared: Callable[..., Any],
    run: Callable[[Mapping[str, Any]], None],
    more: Iterable[Parameter],
    most_used: tuple[str, ...] = (),
    settable: Mapping[str, Settable] = MappingProxyType({}),
) -> Callable[..., None]:
    """Return the function of a command, with the signature of a declared function as Typer takes it.

    ``more`` are options that the function lacks, ``settable`` such parameters of ``--set``. ``run`` gets the values of
    all, and of ``set`` by parameter.
    """
    hints, signature = hints_of(declared), inspect.signature(declared).parameters
    every = {option.name: option for option in (*options_of(declared), *more, *parameters_of(OfAll))}
    own = {name: each for name, each in every.items() if each.is_set}
    parameters = {name: option for name, option in every.items() if name not in own}
    settable = {**settable, **{name: Settable(e.kind, e.many, tuning=e.option.tuning) for name, e in own.items()}}
    if settable:
        parameters["set"] = set_option(settable)
    most_used = most_used or getattr(declared, "most_used", ())
    options = arranged(most_used, parameters.values())
    arguments = [
        (about, *argument_annotation(about, hints[parameter], signature[parameter].default))
        for parameter, about in arguments_of(declared).items()
    ]
    annotations = {about.name: (hint, default) for about, _, hint, default in arguments}
    annotations |= {option.name: (annotation_of(option), option.default) for option in options}

    def call(**values: Any) -> None:
        defaults = {parameter: each.default for parameter, each in own.items()}
        texts = values_set(name, values["set"], settable) if settable else {}
        run(values | defaults | {each: texts[each] for each in own if each in texts} | {"set": texts})

    keyword = inspect.Parameter.KEYWORD_ONLY
    function: Any = common.one_line(call)
    function.__signature__ = inspect.Signature(
        [inspect.Parameter(n, keyword, default=default, annotation=hint) for n, (hint, default) in annotations.items()]
    )
    function.__name__, function.__annotations__ = name, {n: hint for n, (hint, _) in annotations.items()}
    in_python = [
        parameter_of(each, hints[each], signature[each].default) for each in getattr(declared, "python_only", ())
    ]
    flagless = [parameter_of(each, about.kind, None) for each, about in settable.items() if each not in parameters]
    function.parameters, function.settable, function.set_parameters = tuple(options), settable, [*own.values()]
    function.elsewhere = dict(
        [*_elsewhere([*flagless, *own.values()], is_set=True), *_elsewhere(in_python, is_set=False)]
    )
    function.help, function.most_used = help_of(declared), most_used
    function.places = [(usage, about.metavar, about.text) for about, usage, *_ in arguments]
    return function  # type: ignore[no-any-return]


def _elsewhere(parameters: Iterable[Parameter], *, is_set: bool) -> Iterator[tuple[str, Elsewhere]]:
    """Yield the flags that parameters would have as options, and how they are given instead."""
    on, off = ("true", "false") if is_set else ("True", "False")
    for each in parameters:
        flag, _, negative = each.flags[0].partition("/")
        yield flag, Elsewhere(each.name, on if each.kind is bool else "VALUE" if is_set else "...", is_set)
        if negative:
            yield negative, Elsewhere(each.name, off, is_set)


def parameters_of(options: type) -> list[Parameter]:
    """Return the options that the attributes of a class declare."""
    hints = get_type_hints(options, include_extras=True)
    return [parameter_of(name, hint, getattr(options, name)) for name, hint in hints.items()]


def argument_annotation(about: Argument, hint: Any, default: Any) -> tuple[str, Any, Any]:
    """Return how the usage shows an argument, and its annotation and default, as Typer takes them.

    ``hint`` is its type in Python.
    """
    kind, many = (str, True) if about.words else on_command_line(bare(hint))
    many = many or (isinstance(about, OneOfMany) and not about.is_one)
    is_needed = default is inspect.Parameter.empty and not about.words
    kind = list[kind] if many else kind  # type: ignore[valid-type]
    usage = f"{about.metavar}{'...' if many else ''}"
    annotation: Any = Annotated[
        kind if is_needed else kind | None, typer.Argument(metavar=about.metavar, help=about.text)
    ]
    return usage if is_needed else f"[{usage}]", annotation, default if is_needed else None


def annotation_of(parameter: Parameter) -> Any:
    """Return the annotation of an option, as Typer takes it. The help names the range."""
    about, text = parameter.option, parameter.help
    if ends := limits(about.least, about.most):
        text += f" {ends[0].upper()}{ends[1:]}."
    info = typer.Option(
        *parameter.flags,
        help=text,
        metavar=about.metavar,
        show_default=parameter.shown if parameter.shown is not None else True,
        show_envvar=False,
        rich_help_panel=about.panel or None,
        case_sensitive=False,
        autocompletion=about.names,
    )
    kind: Any = list[parameter.kind] if parameter.many else parameter.kind  # type: ignore[name-defined]
    return Annotated[kind | None if parameter.default is None else kind, info]


def help_of(declared: Callable[..., Any]) -> str:
    """Return the help of a command: the docstring of its function, with options as the command line writes them."""
    doc = words_of(declared)
    flags = {option.name: option.flags[0] for option in options_of(declared)}
    examples = [f"Example: {line}" for line in doc.examples]
    return "\n\n".join([with_dashes(doc.text, flags), *examples])
