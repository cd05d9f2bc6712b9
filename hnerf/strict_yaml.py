"""YAML without the parts by which a small file becomes large or says two things: aliases, deep nesting, a key twice."""

from typing import Any

import yaml

from hnerf.errors import InputError

MAX_DEPTH = 32  # of nested lists and dictionaries
# What PyYAML raises on tags without their value ("x: !!int", "x: !!timestamp"), beside its own.
ERRORS = (yaml.YAMLError, AttributeError, ArithmeticError, LookupError, RecursionError, TypeError, ValueError)
_EVENTS = getattr(yaml, "CBaseLoader", yaml.BaseLoader)  # written in C, ten times as fast, where it was built


class _Strict:
    """A composer that refuses what the module says, for a loader of PyYAML."""

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


def parse_yaml(text: str | bytes, source: object) -> Any:
    """Return what YAML text says, as numbers, text, lists and dictionaries. Raises InputError, one line that begins
    with `source`, where it is not YAML or not strict."""
    try:
        return yaml.load(text, Loader=_SafeLoader)
    except ERRORS as error:
        raise InputError(f"{source}: is not YAML ({' '.join(str(error).split())}); correct it") from None


def parse_yaml_strings(text: str) -> Any:
    """Return what YAML text says, every scalar as a string, whatever its tag. Raises ValueError where it is not YAML or
    not strict. Events are read one at a time, so that neither depth nor repetition costs more than the text does."""
    root: list[Any] = []
    open_nodes: list[tuple[Any, list[str]]] = [(root, [])]  # a container, and its key that waits for a value

    def add(value: Any) -> None:
        container, waiting = open_nodes[-1]
        if isinstance(container, list):
            container.append(value)
        elif waiting:
            container[waiting.pop()] = value
        elif not isinstance(value, str) or value in container:
            raise ValueError("a key is no text, or is there twice")
        else:
            waiting.append(value)

    try:
        for event in yaml.parse(text, Loader=_EVENTS):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("aliases are not read")
            if isinstance(event, yaml.ScalarEvent):
                add(event.value)
            elif isinstance(event, yaml.SequenceStartEvent | yaml.MappingStartEvent):
                node: Any = [] if isinstance(event, yaml.SequenceStartEvent) else {}
                add(node)
                open_nodes.append((node, []))
                if len(open_nodes) > MAX_DEPTH:
                    raise ValueError(f"nested more than {MAX_DEPTH} deep")
            elif isinstance(event, yaml.SequenceEndEvent | yaml.MappingEndEvent):
                open_nodes.pop()
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(str(error)) from None
    if len(root) > 1:
        raise ValueError("several documents")
    return root[0] if root else None
