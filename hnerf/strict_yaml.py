"""YAML without what lets a small file become large or contradict itself: aliases, deep nesting, duplicate keys."""

from typing import Any

import yaml
from yaml.composer import Composer

from hnerf.errors import InputError

MAX_DEPTH = 32  # of nested lists and dictionaries
# What PyYAML raises, in addition to its own errors, on tags without their value ("x: !!int", "x: !!timestamp").
ERRORS = (yaml.YAMLError, AttributeError, ArithmeticError, LookupError, RecursionError, TypeError, ValueError)


class _Strict:
    """A composer for a PyYAML loader that refuses the features that the module's docstring lists."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):  # type: ignore[attr-defined]
            raise yaml.YAMLError("aliases are not read")
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise yaml.YAMLError(f"nested more than {MAX_DEPTH} deep")
        node = super().compose_node(parent, index)  # type: ignore[misc]
        self.depth -= 1
        if isinstance(node, yaml.MappingNode):
            names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            if len(set(names)) < len(names):
                raise yaml.YAMLError(f"{max(names, key=names.count)[:80]} is there twice")
        return node


class _SafeLoader(_Strict, yaml.SafeLoader):
    pass


class _StringLoader(_Strict, getattr(yaml, "CBaseLoader", yaml.BaseLoader), Composer):  # type: ignore[misc]
    """Parses in C, which is faster, if PyYAML was built with it; composes in Python, which is strict."""

    get_single_node = Composer.get_single_node

    def __init__(self, text: str) -> None:
        super().__init__(text)  # type: ignore[call-arg]
        Composer.__init__(self)


def parse_yaml(text: str | bytes, source: object) -> Any:
    """Return the content of YAML text, as numbers, text, lists and dictionaries. Raises InputError, one line that
    begins with `source`, if it is not YAML or not strict."""
    try:
        return yaml.load(text, Loader=_SafeLoader)
    except ERRORS as error:
        raise InputError(f"{source}: is not YAML ({' '.join(str(error).split())}); correct it") from None


def parse_yaml_strings(text: str) -> Any:
    """Return the content of YAML text, every scalar as a string, whatever its tag. Raises ValueError if it is not YAML
    or not strict."""
    try:
        return yaml.load(text, Loader=_StringLoader)
    except ERRORS as error:
        raise ValueError(str(error)) from None
