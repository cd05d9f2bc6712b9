"""Small, unambiguous YAML is read; everything else is refused quickly."""

import time

import pytest

from hnerf.errors import InputError
from hnerf.strict_yaml import parse_yaml, parse_yaml_strings

TEXT = 'K: !!opencv-matrix\n   rows: 3\n   data: [ 1.5, 0., .Nan ]\nnames:\n   - "01"\nnone:\n'
HOSTILE = {
    "aliases": "a: &a [x]\nb: *a\n",
    "depth": "a: " + "[" * 20_000,
    "depth in small pieces": "a: " + "[1, " * 20_000,
    "a key twice": "a: 1\na: 2\n",
    "a key twice, deep down": "a:\n  - b: 1\n    b: 2\n",
    "a control character": "a: \x00",
    "a key that is a list": "? [a]\n: b\n",
    "two documents": "a: 1\n---\nb: 2\n",
}


def test_scalars_are_strings_whatever_their_tags() -> None:
    found = {"K": {"rows": "3", "data": ["1.5", "0.", ".Nan"]}, "names": ["01"], "none": ""}
    assert parse_yaml_strings(TEXT) == found
    assert parse_yaml_strings("") is None
    assert parse_yaml_strings("[a, {b: [c]}]") == ["a", {"b": ["c"]}]


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_text_is_refused_quickly(case: str) -> None:
    began = time.monotonic()
    with pytest.raises(ValueError, match=r"."):
        parse_yaml_strings(HOSTILE[case])
    with pytest.raises(InputError, match=r"^fast\.yaml: is not YAML \(") as refusal:
        parse_yaml(HOSTILE[case], "fast.yaml")
    assert len(str(refusal.value)) < 400 and time.monotonic() - began < 5


@pytest.mark.parametrize("text", ["x: !!int", "x: !!float", "x: !!timestamp", "x: 2026-13-01", "x: !!python/none"])
def test_tags_without_a_value_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"^fast\.yaml: is not YAML"):
        parse_yaml(text, "fast.yaml")


def test_values_keep_their_types() -> None:
    assert parse_yaml("a: 1\nb: [1.5, true, null, text]", "here") == {"a": 1, "b": [1.5, True, None, "text"]}
