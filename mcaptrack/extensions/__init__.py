"""Extensions, the parts that mcaptrack can do without: the core works when the folder of one is deleted.

An extension registers itself by entry points in ``pyproject.toml``, as packages of strangers do.
"""
