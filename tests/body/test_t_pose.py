"""The T pose: arms level, legs straight down, everything else as at rest."""

import torch

from hnerf.body.anny import anny_rig
from hnerf.body.rig import joint_transforms, shortest_rotation
from hnerf.body.t_pose import t_pose


def test_arms_point_to_the_sides_and_legs_down() -> None:
    rig = anny_rig().to(dtype=torch.float64)
    names, root = rig.joint_names, torch.eye(4, dtype=torch.float64)[None]
    placed = joint_transforms(rig, t_pose(rig)[None], root)[0]

    def along(a: str, b: str) -> torch.Tensor:
        start, end = (placed[names.index(name), :3, 3] for name in (a, b))
        return torch.nn.functional.normalize(end - start, dim=0)

    for side, x in (("L", 1.0), ("R", -1.0)):
        out, down = torch.tensor([x, 0, 0]).double(), torch.tensor([0, 0, -1.0]).double()
        for a, b in (("upperarm01", "lowerarm01"), ("lowerarm01", "wrist"), ("wrist", "finger3-1")):
            torch.testing.assert_close(along(f"{a}.{side}", f"{b}.{side}"), out, atol=1e-6, rtol=0)
        for a, b in (("upperleg01", "lowerleg01"), ("lowerleg01", "foot")):
            torch.testing.assert_close(along(f"{a}.{side}", f"{b}.{side}"), down, atol=1e-6, rtol=0)
        for name in (f"foot.{side}", f"clavicle.{side}", "head"):
            torch.testing.assert_close(placed[names.index(name), :3, :3], torch.eye(3).double(), atol=1e-6, rtol=0)


def test_the_shortest_rotation_by_hand() -> None:
    """x into y: 90 degrees about z."""
    turn = shortest_rotation(torch.tensor([2.0, 0, 0]), torch.tensor([0, 3.0, 0]))
    torch.testing.assert_close(turn, torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
