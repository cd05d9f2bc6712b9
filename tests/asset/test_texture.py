import numpy as np
import trimesh

from hnerf.asset.texture import Texels, UvLayout, rasterise, texture_image, unwrap


def test_texels_of_one_triangle() -> None:
    # The triangle covers half of a 4 x 4 image: bottom left, bottom right and top left. v points up, rows count down.
    layout = UvLayout(np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]]))
    texels = rasterise(layout, 4)
    at = {(r, c): b for r, c, b in zip(texels.row.tolist(), texels.column.tolist(), texels.barycentric, strict=True)}
    assert {(r, c) for r in range(4) for c in range(4) if c <= r} <= set(at)
    # The centre of the bottom left texel lies at u = v = 1/8.
    np.testing.assert_allclose(at[3, 0], [0.75, 0.125, 0.125], rtol=1e-6)
    np.testing.assert_allclose(at[3, 2], [0.25, 0.625, 0.125], rtol=1e-6)


def test_a_texel_belongs_to_the_face_that_contains_its_centre() -> None:
    """Two rectangles of two faces each meet at u = 0.4, which is 1.6 texels from the left, and end at u = 0.8, at 3.2
    texels. The centres of columns 0 and 1 lie in the first rectangle and that of column 2 in the second, which also
    touches columns 1 and 3."""
    corners = [[u, v] for u in (0, 0.4, 0.8) for v in (0, 1)]
    layout = UvLayout(np.array(corners), np.array([[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]]))
    texels = rasterise(layout, 4)
    image = np.full((4, 4), -1)
    image[texels.row, texels.column] = texels.face // 2
    assert image.tolist() == [[0, 0, 1, 1]] * 4
    corner_u = layout.uvs[layout.face_uvs][texels.face, :, 0]
    inside = texels.column < 3
    at_u = (texels.barycentric * corner_u).sum(1)[inside]
    np.testing.assert_allclose(at_u, (texels.column[inside] + 0.5) / 4, atol=1e-5)


def test_texels_off_the_charts_repeat_the_nearest_border() -> None:
    """In a 4 x 4 image, the first texel of the top row is red and the last of the bottom row blue. Texels whose row and
    column add up to less than 3 are nearer to red, those with more to blue."""
    ends = np.array([0, 3])
    texels = Texels(ends, ends, np.zeros(2, int), np.zeros((2, 3)))
    image = texture_image(texels, np.array([[1.0, 0, 0], [0, 0, 0.6]]), 4)
    row, column = np.indices((4, 4))
    assert (image[row + column < 3] == (255, 0, 0)).all() and (image[row + column > 3] == (0, 0, 153)).all()


def test_vertex_values_are_interpolated_at_texels() -> None:
    faces, values = np.array([[0, 1, 2], [2, 1, 3]]), np.array([[0.0, 1], [4, 1], [8, 1], [100, 1]])
    texels = Texels(*np.zeros((2, 2), int), np.array([1, 0]), np.array([[0.5, 0.25, 0.25], [0.25, 0.5, 0.25]]))
    np.testing.assert_array_equal(texels.interpolate(values, faces), [[30, 1], [4, 1]])  # 8/2 + 4/4 + 100/4; 4/2 + 8/4
    np.testing.assert_array_equal(texels.interpolate(values, faces, np.array([1])), [[4, 1]])


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
