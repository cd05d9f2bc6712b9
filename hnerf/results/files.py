"""JSON files that stages write: a file with a key that its type lacks is refused, and each type has a schema."""

import json
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, with_config

from hnerf.results.asset import AssetReport
from hnerf.results.preparation import CalibrationCheck, CamerasReport, DetectionReport, FitReport, SegmentationReport
from hnerf.results.scores import HeldOutCamera, Metrics, Scores
from hnerf.results.training import TrainingReport

FILES: dict[str, Any] = {
    "cameras-report": CamerasReport,
    "detection": DetectionReport,
    "calibration-report": CalibrationCheck,
    "segmentation-report": SegmentationReport,
    "fit-report": FitReport,
    "training-report": TrainingReport,
    "metrics": Metrics,
    "holdout": HeldOutCamera,
    "scores": Scores,
    "asset-report": AssetReport,
}


def _closed(kind: Any) -> TypeAdapter[Any]:
    """Return a validator of a kind of result that forbids other keys, also in nested parts."""
    return TypeAdapter(with_config(ConfigDict(extra="forbid"))(kind))


def write_result(path: Path, kind: Any, result: Any) -> None:
    """Write a result as JSON. Raise ValidationError if it has a key that its kind does not define, or a value of
    another type."""
    _closed(kind).validate_python(result)
    path.write_text(json.dumps(result, indent=1, allow_nan=False))


def write_schemas(folder: Path) -> None:
    """Write `<name>.json`, the JSON schema of each kind of result, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, kind in FILES.items():
        (folder / f"{name}.json").write_text(json.dumps(_closed(kind).json_schema(), indent=1) + "\n")
