from dataclasses import replace
from pathlib import Path

import pytest

from hnerf.evaluation.columns import avatar_for_split, reason_unavailable
from hnerf.evaluation.views import SPLITS
from tests.evaluation.ball import BallAvatar, ball_fit, write_settings


def test_the_animated_column_uses_the_trained_shape() -> None:
    fit = ball_fit()
    rig = replace(fit.rig, vertices_m=1.1 * fit.rig.vertices_m)
    assert avatar_for_split("novel_pose", BallAvatar(replace(fit, rig=rig)), fit).body.rig is rig


@pytest.mark.parametrize(
    ("kind", "nodes", "steps", "lacks"),
    [
        ("fast", 8, 80, []),
        ("fast", 0, 80, ["novel_pose_tracked"]),
        ("fast", 8, 0, ["novel_pose_posed", "novel_pose_tracked"]),
        ("neural_body", 0, 80, ["novel_pose_posed", "novel_pose_tracked"]),
        ("nerf", 0, 80, ["novel_pose", "novel_pose_posed", "novel_pose_tracked"]),
    ],
)
def test_untuned_novel_pose_columns_are_unavailable(
    tmp_path: Path, kind: str, nodes: int, steps: int, lacks: list[str]
) -> None:
    write_settings(tmp_path, kind, nodes, steps)
    assert [split for split in SPLITS if reason_unavailable(split, tmp_path)] == lacks
