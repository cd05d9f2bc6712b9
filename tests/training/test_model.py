"""Subjects that another version left, none of them trained."""

import json
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file

from hnerf.errors import CaptureError
from hnerf.training.model import build_field, load_avatar
from hnerf.training.model_file import write_field
from tests.training.scene import TINY, record


@pytest.fixture
def subject(tmp_path: Path) -> Path:
    body = record(tmp_path / "capture")[2]
    body.save(tmp_path)
    write_field(build_field(TINY, body, False), tmp_path / "model.safetensors")
    (tmp_path / "settings.json").write_text(json.dumps({"static": False, "training": TINY.model_dump()}))
    return tmp_path


@pytest.mark.parametrize(
    "stored",
    [
        {"static": False, "training": TINY.model_dump() | {"momentum": 1}},
        {"static": False},
        {"training": TINY.model_dump()},
    ],
)
def test_other_settings_are_refused(subject: Path, stored: dict[str, object]):
    (subject / "settings.json").write_text(json.dumps(stored))
    with pytest.raises(CaptureError, match=r"settings\.json: of another version; train the subject again$"):
        load_avatar(subject)


def test_a_field_without_its_body_is_refused(subject: Path):
    path = subject / "model.safetensors"
    load_avatar(subject)
    save_file({name: tensor for name, tensor in load_file(path).items() if name != "canonical_m"}, path)
    with pytest.raises(CaptureError, match=r"model\.safetensors: of another version; train the subject again$"):
        load_avatar(subject)
