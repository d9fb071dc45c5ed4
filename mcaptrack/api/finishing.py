"""Finishers and makers of scenes of installed packages: their options, which ``run`` has, too, and their objects."""

from __future__ import annotations

import inspect
import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from mcaptrack.api.declared import hints_of, parameter_of
from mcaptrack.contracts import Finished
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import warn
from mcaptrack.registry import Entry, Kind, blamed, find, of_type, others, titled

if TYPE_CHECKING:
    from mcaptrack.geometry.plane import Planes
    from mcaptrack.log import Log
    from mcaptrack.pipeline.runner import Finish
    from mcaptrack.pipeline.write import Made, RunState

#: The option of ``run`` that a finisher gets, if it has a parameter of this name.
FORCE: Final = "force"


class PartsOfRun:
    """Functions of installed packages that take options of ``run`` and return a part of it: finishers, scene makers.

    One that can't be imported, or has an option that ``run`` has, gives no options; each run says why it is left out.
    ``entries`` are these functions; by default all that are installed now.
    """

    def __init__(self, entries: Iterable[Entry] | None = None) -> None:
        self._entries: dict[Entry, dict[str, inspect.Parameter]] = {}
        self._options: dict[Entry, dict[str, inspect.Parameter]] = {}
        self.faults: list[str] = []
        self._names = _installed()
        for part in self._names if entries is None else entries:
            try:
                entry = part if isinstance(part, Entry) else find(*part)
                self._entries[entry] = _options_of(entry)
            except McaptrackError as error:
                self.faults.append(str(error))

    @property
    def most_used(self) -> tuple[str, ...]:
        """The options that come first in the help."""
        return tuple(option for entry in self._entries for option in getattr(entry.cls, "most_used", ()))

    def options(self, taken: Collection[str]) -> dict[str, inspect.Parameter]:
        """Return the options by name; ``taken`` are the names that they can't have."""
        out: dict[str, inspect.Parameter] = {}
        for entry, own in self._entries.items():
            if name := next((name for name in own if name in taken or name in out), ""):
                self.faults.append(f"{entry} can't have the option {name}: run has one of this name")
            else:
                self._options[entry] = own
                out |= own
        return out

    def finishers(self, values: Mapping[str, object], force: bool) -> list[Finish]:
        """Return the steps of finishers with these values of options. Warn of what is left out."""
        from mcaptrack.api.running import OF_JSON, RunResult

        late = [
            f"{titled(*name)} was installed after run was imported" for name in _installed() if name not in self._names
        ]
        for fault in (*self.faults, *late):
            _leave_out(fault)
        steps: list[Finish] = []
        for entry in self._of("finisher"):
            if not entry.is_built_in and entry.name in {*dir(RunResult), *RunResult.__dataclass_fields__, *OF_JSON}:
                _leave_out(f"{entry} can't have its name: the result of run has {entry.name}")
                continue
            step = self._made(entry, values, force)
            steps.append(step if entry.is_built_in else _OfPackage(entry, step))
        return steps

    def scene_makers(self, values: Mapping[str, object]) -> list[tuple[Entry, Any]]:
        """Return the makers of scenes with these values of options, each with its entry.

        One that can't be made is left out, with a warning, unless one of its options has a value.
        """
        makers = []
        for entry in self._of("scene"):
            try:
                makers.append((entry, self._made(entry, values)))
            except McaptrackError as error:
                if entry.is_built_in or any(self.chosen("scene", values).values()):
                    raise
                _leave_out(str(error))
        return makers

    def chosen(
        self, kind: Kind, values: Mapping[str, object], entries: Collection[Entry] | None = None
    ) -> dict[str, bool]:
        """Return whether each option of a kind, or of these ``entries``, has another value than by default."""
        every = self._of(kind) if entries is None else entries
        options = [option for entry in every for option in self._options[entry].values()]
        return {option.name: values.get(option.name, option.default) != option.default for option in options}

    def _of(self, kind: Kind) -> list[Entry]:
        return [entry for entry in self._options if entry.kind == kind]

    def _made(self, entry: Entry, values: Mapping[str, object], force: bool = False) -> Any:
        """Return what a function makes of these values of options."""
        own = {name: values[name] for name in self._options[entry] if name in values}
        own |= {FORCE: force} if FORCE in inspect.signature(entry.cls).parameters else {}
        with blamed(entry, "failed"):
            return entry.cls(**own)


def _installed() -> list[tuple[Kind, str]]:
    """Return kind and name of all that are installed now."""
    kinds: tuple[Kind, ...] = ("finisher", "scene")
    return [(kind, name) for kind in kinds for name in others(kind)]


def _leave_out(fault: str) -> None:
    warn(f"{fault}; it is left out", "left-out")


def _options_of(entry: Entry) -> dict[str, inspect.Parameter]:
    """Return the options of a finisher. Raises McaptrackError for one that has no default, or no type of options."""
    with blamed(entry, "has annotations that can't be read"):
        hints, parameters = hints_of(entry.cls), inspect.signature(entry.cls).parameters
        tuple(getattr(entry.cls, "most_used", ()))
    own = {
        name: parameter.replace(kind=parameter.KEYWORD_ONLY, annotation=hints.get(name, Any))
        for name, parameter in parameters.items()
        if name != FORCE
    }
    for name, parameter in own.items():
        if parameter.default is parameter.empty:
            raise McaptrackError(f"{entry} can't have the option {name}: it has no default")
        with blamed(entry, f"can't have the option {name}"):
            parameter_of(name, parameter.annotation, parameter.default)
    return own


@dataclass(frozen=True)
class _OfPackage:
    """A step of another package: errors name it, and it replaces only what it made itself."""

    entry: Entry
    step: Any

    @property
    def name(self) -> str:
        return self.entry.name

    def make(self, state: RunState, planes: Planes, stamps: Mapping[str, Sequence[int]]) -> dict[str, Made]:
        from mcaptrack.pipeline.checks import may_add
        from mcaptrack.pipeline.staleness import is_finished
        from mcaptrack.schema.provenance import VIEW

        with blamed(self.entry, "failed"):
            made: dict[str, Made] = dict(self.step.make(state, planes, stamps))
            hows = {topic: channel.provenance for topic, channel in made.items()}
        for topic, how in hows.items():
            is_own = how.transform == self.name and is_finished(topic, how)
            if not is_own and not (how.transform == VIEW and how.input in made):
                raise McaptrackError(
                    f"{self.entry} makes {topic}, which is not below its input, or not of this name: its provenance is "
                    f"Provenance({self.name!r}, parameters, input, digest of the input)"
                )
        may_add(state.opened, [*made], self.name, f"results of {self.entry}", is_asked=True)
        return made

    def report(self, opened: Log, prefixes: Sequence[str]) -> Finished | None:
        if not hasattr(self.step, "report"):
            return None
        with blamed(self.entry, "failed"):
            report = self.step.report(opened, prefixes)
        if report is None:
            return None
        finished = of_type(self.entry, report, Finished, "report")
        with blamed(self.entry, "gave what is no Finished"):
            json.dumps(finished.data)
            return finished._replace(value={**finished.value}, text=str(finished.text))
