"""What loading has to tell: errors with the file's name, notes for the scene, and one warning for all repairs.

A file is forgiven where a repair is harmless; every repair is counted here, noted on the scene, and all of them come
out as a single Python warning when the file is done. What cannot be repaired is a `LoadError`.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from .errors import InputError, LoadError

__all__ = ["LoadReport", "LoadWarning", "load_error"]

#: What badly typed or missing fields raise while a file's own structure is read.
_MALFORMED = (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError)


class LoadWarning(UserWarning):
    """A file was repaired while it was loaded, or lost something: the text says what and how often."""


def load_error(what: str, expected: str, got: object, mend: str = "") -> LoadError:
    """Build the one message shape for files: what, expectation, what came, and the mend."""
    found = str(got)
    text = f"{what}: expected {expected}, got {found if len(found) <= 160 else found[:157] + '...'}"
    return LoadError(f"{text}; {mend}" if mend else text)


class LoadReport:
    """Notes and repairs of one file.

    Attributes:
        file: The file as the caller named it.
        notes: Remarks for `Scene.notes`, each once.
    """

    def __init__(self, file: str) -> None:
        self.file = file
        self.notes: list[str] = []
        self._repairs: list[str] = []

    def note(self, text: str) -> None:
        """Remark on something that is not rendered as the file asks; said once."""
        if text not in self.notes:
            self.notes.append(text)

    def repair(self, text: str) -> None:
        """Remark on something that was mended or lost; it is noted, and warned of by `finish`."""
        if text not in self._repairs:
            self._repairs.append(text)
        self.note(text)

    def adopt(self, other: LoadReport) -> None:
        """Take over the notes and repairs of a file that this one names."""
        for text in other._repairs:
            self.repair(f"{other.file}: {text}")
        for text in other.notes:
            if text not in other._repairs:
                self.note(f"{other.file}: {text}")

    def finish(self) -> None:
        """Warn once of all repairs, if there were any."""
        if self._repairs:
            shown = "; ".join(self._repairs[:8])
            rest = len(self._repairs) - 8
            warnings.warn(
                f"{self.file}: {shown}" + (f"; and {rest} more" if rest > 0 else ""), LoadWarning, stacklevel=4
            )
            self._repairs.clear()

    def error(self, where: str, expected: str, got: object, mend: str = "") -> LoadError:
        """Build an error about a place in this file (a JSON pointer, or a line)."""
        return load_error(f"{self.file} {where}".rstrip(), expected, got, mend)

    @contextmanager
    def at(self, where: str, expected: str = "fields of the right kind", *, foreign: bool = False) -> Iterator[None]:
        """Turn errors raised while reading that place of the file into a `LoadError` that names it.

        Args:
            where: JSON pointer or line; empty for the whole file.
            expected: What was expected there.
            foreign: Whether another library's reader runs inside: damaged bytes may make it raise anything at all.
        """
        try:
            yield
        except InputError as error:
            raise LoadError(f"{self.file} {where}".rstrip() + f": {error}") from None
        except LoadError:
            raise
        except Exception as error:
            if isinstance(error, MemoryError) or not (foreign or isinstance(error, _MALFORMED)):
                raise
            got = " ".join(f"{type(error).__name__}: {error}".split())
            raise self.error(where, expected, got, "correct the file or export it again") from None
