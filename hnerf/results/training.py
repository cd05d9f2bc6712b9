"""The report of training."""

from typing import Any

from typing_extensions import TypedDict


class ChosenSetting(TypedDict):
    """A setting whose value was chosen from the scene, and the reason."""

    setting: str
    value: Any
    reason: str


class TrainingReport(TypedDict):
    """report.json of training. seconds: duration of the steps of both phases; field_seconds: of the field's own steps;
    setup_seconds: of the preparation before the first step, included in neither. mean_turn_deg, mean_move_mm: mean
    change of all poses since the body fit."""

    device: str
    processes: int
    setup_seconds: float
    seconds: float
    field_seconds: float
    steps: int
    peak_memory_gib: float
    parameters: int
    model_mib: float
    mean_turn_deg: float
    mean_move_mm: float
    decisions: list[ChosenSetting]
