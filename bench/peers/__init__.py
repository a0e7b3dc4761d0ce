"""Bench `peers`: other renderers beside this one; each is one file here, behind the protocol of `base.py`."""

from .measure import run

__all__ = ["run"]
