from mcaptrack.api import Recording as Recording
from mcaptrack.api import open as open  # noqa: A004
from mcaptrack.errors import McaptrackError as McaptrackError

__version__: str
SCHEMA_VERSION: int
