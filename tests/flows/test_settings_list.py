import pytest
from pydantic import BaseModel

from flows.cli import main
from flows.settings_list import settings_list
from hnerf.config import Settings, SyntheticSettings, load_settings, overridden


def test_a_line_has_key_value_type_bounds_and_comment(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "--preset", "paper"]) == 0
    found = {line.split("=")[0]: " ".join(line.split()) for line in capsys.readouterr().out.splitlines()}
    assert found["capture.max_side_px"] == (
        "capture.max_side_px=1024 int >= 16 images with a longer side are shrunk when they are ingested"
    )
    assert found["calibration.min_improvement"].startswith("calibration.min_improvement=0.02 float >= 0 < 1 share")
    assert found["segmentation.model"].startswith("segmentation.model=null Path | null ONNX file")
    assert found["training.field.kind"].startswith('training.field.kind="paper" fast | paper | nerf | ')
    assert found["training.losses.geometry_roles"].startswith(
        'training.losses.geometry_roles="surface_leads" surface_leads | print whether'
    )
    assert found["training.snapshots_s"].startswith("training.snapshots_s=[] list of float times")
    assert found["test_cameras"] == "test_cameras=2 int >= 0 each half-way between two of those, evenly spaced"


@pytest.mark.parametrize("settings", [load_settings("fast"), load_settings("paper"), SyntheticSettings()])
def test_every_setting_is_listed_as_set_takes_it(settings: Settings | SyntheticSettings) -> None:
    assigned = [line.split()[0] for line in settings_list(settings)]
    assert len(assigned) == _leaves(settings)
    assert overridden(settings, assigned) == settings
    assert overridden(type(settings)(), assigned) == settings


def _leaves(settings: BaseModel) -> int:
    return sum(_leaves(v) if isinstance(v, BaseModel) else 1 for v in dict(settings).values())
