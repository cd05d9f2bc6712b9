import re
from pathlib import Path
from typing import Literal

import pytest
from pydantic import BaseModel, Field, PositiveInt

from flows.cli import main
from flows.settings_list import settings_list
from hnerf import config
from hnerf.config import Section, Settings, SyntheticSettings, load_settings, overridden


class Shape(Section):
    edge_m: float = Field(default=0.5, gt=0)  # of any shape


class Cube(Shape):
    kind: Literal["cube"] = "cube"
    levels: tuple[PositiveInt, ...] = (4, 8)


class Ball(Shape):
    kind: Literal["ball"] = "ball"  # round
    drawn: Literal["wire", "solid"] = "wire"


class Scene(Section):
    shape: Cube | Ball = Field(default=Cube(), discriminator="kind")
    share: float = Field(default=0.25, ge=0, lt=1)
    floor: Path | None = None  # a picture; None: grey


def test_every_setting_has_its_comment_on_its_first_line() -> None:
    """`settings_list` reads the comment from the first line of the setting."""
    wrapped = re.findall(r"^    (\w+): .*\($", Path(config.__file__).read_text(), re.MULTILINE)
    assert wrapped == []


def test_a_line_has_key_value_type_bounds_and_comment() -> None:
    lines = [" ".join(line.split()) for line in settings_list(Scene(shape=Ball()))]
    assert lines == [
        "shape.edge_m=0.5 float > 0 of any shape",
        'shape.kind="ball" cube | ball round',
        'shape.drawn="wire" wire | solid',
        "share=0.25 float >= 0 < 1",
        "floor=null Path | null a picture; None: grey",
    ]
    assert "shape.levels=[4, 8] list of int" in [" ".join(line.split()) for line in settings_list(Scene())]


@pytest.mark.parametrize("preset", ["fast", "paper", "nerf", "idr", "neural-body", "nerfies", None])
def test_every_setting_says_what_it_means(preset: str | None) -> None:
    """Each kind of field has its own settings."""
    lines = settings_list(SyntheticSettings() if preset is None else load_settings(preset))
    assert [line for line in lines if len(re.split(" {2,}", line)) < 3] == []


def test_the_command_lists_a_preset(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "--preset", "paper"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith('training.field.kind="paper" ') for line in lines)
    assert any(line.startswith("train_cameras=4 ") for line in lines)


@pytest.mark.parametrize("settings", [load_settings("fast"), load_settings("paper"), SyntheticSettings()])
def test_every_setting_is_listed_in_the_syntax_of_set(settings: Settings | SyntheticSettings) -> None:
    assigned = [line.partition("  ")[0] for line in settings_list(settings)]
    assert len(assigned) == _leaves(settings)
    assert overridden(settings, assigned) == settings
    assert overridden(type(settings)(), assigned) == settings


def _leaves(settings: BaseModel) -> int:
    return sum(_leaves(v) if isinstance(v, BaseModel) else 1 for v in dict(settings).values())
