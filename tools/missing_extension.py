"""Import this before parts of extensions: a program that lacks one of them then ends with a line that names it."""

import sys

from mcaptrack.installed import missing_extensions

#: The advice about each extension that isn't there.
_MISSING = {name: advice for name, advice in missing_extensions().items() if advice}


class Finder:
    """Is asked for the modules that nothing else finds."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        extension = name.removeprefix("mcaptrack.extensions.")
        if extension in _MISSING:
            sys.exit(f"{extension} is an extension that {_MISSING[extension]}")


sys.meta_path.append(Finder)  # type: ignore[arg-type]
