import dataclasses

import numpy as np
import torch
import trimesh
from torch import Tensor

from hnerf.asset.rig_transfer import clothed_rig
from hnerf.asset.texture import UvLayout, field_colours, rasterise, texture_image, unwrap
from tests.asset.figure import bending_body, upright_column
from tests.asset.stand_in import StandInAvatar, rest_colour


def test_texels_of_one_triangle() -> None:
    # Half of a 4 x 4 image: corners at the bottom left, bottom right and top left; v runs up, rows run down.
    layout = UvLayout(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]]))
    texels = rasterise(layout, 4)
    at = {(r, c): b for r, c, b in zip(texels.row.tolist(), texels.column.tolist(), texels.barycentric, strict=True)}
    assert {(r, c) for r in range(4) for c in range(4) if c <= r} <= set(at)
    # The centre of the bottom left texel lies at u = v = 1/8.
    torch.testing.assert_close(at[3, 0], torch.tensor([0.75, 0.125, 0.125]))
    torch.testing.assert_close(at[3, 2], torch.tensor([0.25, 0.625, 0.125]))


def test_unwrap_keeps_faces_and_does_not_overlap_them() -> None:
    box = trimesh.creation.box(extents=(1, 1, 1)).subdivide().subdivide()
    layout = unwrap(box.vertices, box.faces, 128)
    assert layout.face_uvs.shape == box.faces.shape
    assert (layout.uvs >= 0).all() and (layout.uvs <= 1).all()
    a, b, c = layout.uvs[layout.face_uvs].swapaxes(0, 1)
    areas = np.abs(np.cross(b - a, c - a)) / 2
    assert areas.min() > 0
    covered = len(rasterise(layout, 512).row) / 512**2
    assert areas.sum() < covered < areas.sum() * 1.1  # overlapping faces would cover less than their areas


def test_colours_are_read_on_the_fields_own_surface() -> None:
    read_m = []

    class Recording(StandInAvatar):
        def colour(self, points_m: Tensor, directions: Tensor, theta: Tensor, root: Tensor) -> Tensor:
            read_m.append(self.signed_distance(points_m, theta, root))
            return super().colour(points_m, directions, theta, root)

    body = bending_body()
    clothes = upright_column(0.175, 0.2, 1.4)  # 1.5 cm outside the field's surface; its caps are far inside
    layout = unwrap(clothes.vertices, clothes.faces, 64)
    posed = dataclasses.replace(body, rig=clothed_rig(body.rig, clothes))
    field_colours(Recording(body), posed, rasterise(layout, 64))
    assert len(read_m) == len(body.frames)
    for distance_m in read_m:
        assert distance_m.abs().median() < 0.002


def test_baked_colours_are_those_of_the_point_on_the_rest_body() -> None:
    body = bending_body()
    clothes = upright_column(0.16, 0.0, 1.6)
    layout = unwrap(clothes.vertices, clothes.faces, 256)
    rig = clothed_rig(body.rig, clothes)
    texels = rasterise(layout, 256)
    colours = field_colours(StandInAvatar(body), dataclasses.replace(body, rig=rig), texels)
    image = texture_image(texels, colours, 256)
    middle_uv = layout.uvs[layout.face_uvs].mean(1)
    pixel = image[((1 - middle_uv[:, 1]) * 256).astype(int), (middle_uv[:, 0] * 256).astype(int)]
    middle_m = torch.tensor(clothes.triangles_center).float()
    # Between the caps, away from the joint, whose bend shears, and off the stripes' borders. The body is 1 cm beneath.
    z_m = middle_m[:, 2]
    sides = (z_m > 0.1) & (z_m < 1.5) & ((z_m - 0.8).abs() > 0.2) & ((z_m % 0.2 - 0.1).abs() < 0.09)
    inward = middle_m[:, :2] * (0.15 / middle_m[:, :2].norm(dim=1, keepdim=True))
    expected = rest_colour(torch.cat([inward, middle_m[:, 2:]], 1)).numpy()[sides.numpy()]
    assert sides.sum() > 100
    assert np.abs(pixel[sides.numpy()] / 255 - expected).max() < 0.03
