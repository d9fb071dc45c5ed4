"""Detect and track people in a video or a log, repair the tracks, predict where people go, and write the results."""

from collections.abc import Callable, Mapping

__version__ = "0.3.0.dev0"
#: Version of the shape of everything that is printed, or put into a page, as JSON.
SCHEMA_VERSION = 1

_PARTS = {
    "calibrating": ["CalibrateResult", "CameraCorrection", "calibrate"],
    "catalogue": ["Model", "get_model", "models"],
    "contents": ["ChannelInfo", "FrameInfo", "LogInfo", "info"],
    "cutting": ["CutResult", "cut"],
    "demonstration": ["DemoResult", "demo"],
    "events": ["events"],
    "exporting": ["ExportResult", "export"],
    "fusing": ["fuse"],
    "health": ["DoctorResult", "doctor"],
    "ingesting": ["IngestResult", "ingest"],
    "messages": ["DecodedMessage"],
    "notebook": ["Player"],
    "outputs": ["ReportResult", "report"],
    "querying": ["ColumnInfo", "TableInfo", "TableList", "list_tables", "query"],
    "recording": ["Recording", "open"],
    "rendering": ["RenderResult", "render"],
    "rows": ["detections", "schema_of"],
    "run": ["run"],
    "running": ["RunResult"],
    "scoring": ["Scores", "evaluate"],
    "reading": ["FetchedMessage"],
    "stages": ["detect", "motion", "predict", "retrack", "sample", "stage", "track"],
    "training": ["train"],
    "tuning": ["TuneResult", "tune"],
    "upkeep": ["DropResult", "LogCheck", "LogRecovery", "check", "drop", "recover"],
    "viewing": ["LogServer", "view"],
    "zones": ["draw_zones", "zones"],
}
#: Where the names of the package are defined; each is imported when it is first used.
_MODULES = {name: f"mcaptrack.api.{module}" for module, names in _PARTS.items() for name in names} | {
    "McaptrackError": "mcaptrack.errors",
    "McaptrackWarning": "mcaptrack.notices",
    "Notice": "mcaptrack.notices",
    "TrainResult": "mcaptrack.training.result",
}
__all__ = sorted(_MODULES)  # noqa: PLE0605  # __init__.pyi lists them for tools


def _lazily(package: str, modules: Mapping[str, str]) -> Callable[[str], object]:
    """Return the ``__getattr__`` of a package: it imports a name from its module when the name is first used."""

    def imported(name: str) -> object:
        if name not in modules:
            from mcaptrack.errors import did_you_mean

            meant = f"; {did_you_mean(name, modules)}".rstrip("; ")
            raise AttributeError(f"module {package!r} has no attribute {name!r}{meant}")
        from importlib import import_module

        return getattr(import_module(modules[name]), name)

    return imported


__getattr__ = _lazily(__name__, _MODULES)  # `import mcaptrack` stays light


def __dir__() -> list[str]:
    """List the names of the package, also those that were not imported yet."""
    return sorted({*globals(), *__all__})
