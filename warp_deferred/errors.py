"""The few kinds of error the package raises, all of them `Error`.

Every message has one shape: *what (qualified name): expected …, got …; how to mend it.*
"""

from __future__ import annotations

__all__ = ["CapacityError", "DeviceError", "Error", "InputError", "LoadError"]


class Error(Exception):
    """Base of every error the package raises on purpose."""


class InputError(Error, ValueError):
    """A value handed in from Python is not acceptable; names the field, the expectation and the mend."""


class LoadError(Error):
    """A file cannot be read or written; names the file, the expectation and the mend."""


class DeviceError(Error):
    """A compute device is missing or refused the work."""


class CapacityError(Error):
    """A count exceeds what ids, arrays or the stated memory can hold; raised before anything is allocated."""
