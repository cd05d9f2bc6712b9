import numpy as np
import pytest
import torch
import trimesh

from hnerf.body.fit_result import BodyFit
from hnerf.study.surface import check_pose, check_surface
from tests.body.boxes import box_faces, box_rig, box_vertices

BODY_M, FACES = box_vertices().numpy(), box_faces().numpy()  # the unit box


def test_a_surface_of_the_bodys_size_is_good() -> None:
    check = check_surface(trimesh.creation.box((1.1, 1.1, 1.1)), BODY_M, FACES)
    assert (check.volume, check.length) == pytest.approx((1.331, 1.1))
    assert check.fault is None


@pytest.mark.parametrize(
    ("extents_m", "fault"),
    [
        ((1.0, 1.0, 0.5), "surface has 0.50 of the body's volume"),
        ((1.3, 1.3, 1.2), "surface has 2.03 of the body's volume"),
        ((1.4, 0.9, 0.9), "surface has 1.40 of the body's length"),
    ],
)
def test_a_surface_that_is_too_small_or_too_large_is_faulty(extents_m: tuple[float, ...], fault: str) -> None:
    assert check_surface(trimesh.creation.box(extents_m), BODY_M, FACES).fault == fault


def test_a_surface_with_a_hole_is_faulty() -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.update_faces(np.arange(12) > 0)
    assert check_surface(box, BODY_M, FACES).fault == "surface is not watertight"


class Ball:
    """An avatar whose surface is a ball about the middle of the unit box, whatever the pose."""

    body = BodyFit(box_rig(), (0,), torch.zeros(1, 2, 3), torch.eye(4)[None])

    def __init__(self, radius_m: float):
        self.radius_m = radius_m

    def signed_distance(self, points_m: torch.Tensor, theta: torch.Tensor, root: torch.Tensor) -> torch.Tensor:
        return (points_m - 0.5).norm(dim=-1) - self.radius_m


def test_the_surface_of_a_pose_is_compared_with_the_body_in_that_pose() -> None:
    theta, root = Ball.body.theta[0], Ball.body.root[0]
    good = check_pose(Ball(0.6), theta, root)  # type: ignore[arg-type]
    assert (good.volume, good.length) == pytest.approx((4 / 3 * np.pi * 0.6**3, 1.2), rel=0.01)
    assert good.fault is None
    none = check_pose(Ball(-1.0), theta, root)  # type: ignore[arg-type]
    assert none.fault is not None
    assert none.fault.startswith("signed distance field: no surface in its box")
    assert none.volume is None
