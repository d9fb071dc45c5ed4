"""Run stages on a log: plan them, check their inputs and outputs, run their transforms, and write the results.

A stage reads a channel of an existing log and adds its own channels to the log, with their provenance: the input, the
transform and its parameters. Names are imported when they are first used, so that asking whether a channel is out of
date loads neither transforms nor views.
"""

from mcaptrack import _lazily, _listed

__getattr__ = _lazily(__name__, _listed(__file__))
