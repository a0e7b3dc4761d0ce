"""Immutable, validated value objects: pydantic does the checking, our errors do the talking."""

from __future__ import annotations

from typing import Any

import pydantic

from .checks import input_error
from .errors import InputError

__all__ = ["Record"]

_EXPECTED = {
    "greater_than": "a value > {gt:g}",
    "greater_than_equal": "a value >= {ge:g}",
    "less_than": "a value < {lt:g}",
    "less_than_equal": "a value <= {le:g}",
    "finite_number": "a finite number",
    "literal_error": "{expected}",
    "float_type": "a number",
    "float_parsing": "a number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "a text",
    "missing": "a value",
    "extra_forbidden": "one of its own fields",
}


class Record(pydantic.BaseModel):
    """A frozen pydantic model whose validation errors are `InputError`s in the package's own words.

    A field's description ends in its unit in brackets; `json_schema_extra={"mend": ...}` adds the mend.
    `replace(**changes)` returns a validated copy.
    """

    model_config = pydantic.ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True, use_attribute_docstrings=True
    )

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except pydantic.ValidationError as error:
            raise self._translate(error) from None

    def __setattr__(self, name: str, value: Any) -> None:
        raise InputError(
            f"{type(self).__name__}.{name}: expected no assignment (the object is immutable), got {value!r}; "
            f"make a changed copy with .replace({name}=...)"
        )

    def replace(self, **changes: Any) -> Any:
        """Return a validated copy with some fields changed."""
        return type(self)(**{name: getattr(self, name) for name in self.model_fields_set} | changes)

    @classmethod
    def _translate(cls, error: pydantic.ValidationError) -> InputError:
        first = error.errors()[0]
        location = [str(part) for part in first["loc"]]
        name = ".".join([cls.__name__, *location])
        kind, context = first["type"], first.get("ctx", {})
        if kind == "value_error" and isinstance(context.get("error"), InputError):
            return context["error"]
        expected = _EXPECTED.get(kind, "").format(**context) if kind in _EXPECTED else first["msg"]
        field = cls.model_fields.get(location[0]) if location else None
        mend = ""
        if field is not None:
            description = field.description or ""
            if "[" in description and "]" in description:
                expected += " " + description[description.index("[") : description.index("]") + 1]
            mend = (field.json_schema_extra or {}).get("mend", "") if isinstance(field.json_schema_extra, dict) else ""
        if kind == "extra_forbidden":
            mend = "known fields: " + ", ".join(cls.model_fields)
        if kind == "missing":
            return input_error(name, expected, "<nothing>", mend or f"pass {location[-1]}=...")
        return input_error(name, expected, first["input"], mend)
