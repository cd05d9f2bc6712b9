"""Settings as a list for people: what --set takes, its type, and the comment next to it in hnerf/config.py."""

import inspect
import json
import re
from collections.abc import Iterator
from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from hnerf.config import Section

BOUNDS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
FIELD = re.compile(r"^    (\w+): .*?  # (.+)$", re.MULTILINE)


def settings_list(settings: Section, prefix: str = "", kinds: str = "") -> Iterator[str]:
    """Yield a line for each setting, `key=value  type  description`; settings of nested sections have their section's
    key as prefix. kinds: the available kinds, for a section that can be one of several."""
    bases = [base for base in reversed(type(settings).__mro__) if issubclass(base, Section)]
    about = {name: text for base in bases for name, text in _comments(base).items()}
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if isinstance(value, Section):
            sections = get_args(field.annotation) if field.discriminator else ()
            others = " | ".join(section.model_fields["kind"].default for section in sections)
            yield from settings_list(value, f"{prefix}{name}.", others)
        else:
            assigned = f"{prefix}{name}={json.dumps(value, default=str)}"
            yield f"{assigned:<45}  {kinds if name == 'kind' else _type(field):<20}  {about.get(name, '')}".rstrip()


@cache  # Python parses a class's whole file to find its source
def _comments(kind: type) -> dict[str, str]:
    """Return the comments next to the settings that a class itself defines."""
    return dict(FIELD.findall(inspect.getsource(kind)))


def _type(field: FieldInfo) -> str:
    bounds = [f"{sign} {getattr(limit, name)}" for limit in field.metadata for name, sign in BOUNDS.items()
              if hasattr(limit, name)]  # fmt: skip
    return " ".join([_name(field.annotation), *bounds])


def _name(annotation: Any) -> str:
    """Return a type's name in a form for people."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _name(arguments[0])
    if origin is Literal:
        return " | ".join(arguments)
    if origin is tuple:
        return f"list of {_name(arguments[0])}"
    if arguments:
        return " | ".join(map(_name, arguments))
    return "null" if annotation is NoneType else str(annotation.__name__)
