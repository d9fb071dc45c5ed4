"""The error of a broken law."""

from __future__ import annotations


class LawError(AssertionError):
    """A transform or a predictor breaks a law; the message says which one, and where."""
