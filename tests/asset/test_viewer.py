"""The avatar's viewer page: its contents and, if a browser is installed, its behaviour."""

import base64
import dataclasses
import gzip
import math
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hnerf.asset.compact_glb import as_glb, read_glb
from hnerf.asset.glb import write_glb
from hnerf.asset.staging import StagedAvatar
from hnerf.asset.viewer import MAX_BYTES, _modules, lower_indices, recording, write_viewer
from hnerf.capture.capture import Capture
from hnerf.errors import PlaceError
from hnerf.evaluation.pictures import cast_pixels
from hnerf.geometry.mesh_queries import Surface
from hnerf.models import THREE_SHA256, has_model
from tests.asset.browser import Page, browser, found_browser
from tests.asset.figure import FRAMES, INFO, capture, side_camera

NEEDS_THREE = pytest.mark.skipif(
    not all(map(has_model, THREE_SHA256)), reason="three.js is not installed; `hnerf models` fetches it"
)
LAST_JOINT = "viewer.avatar.joints.at(-1)"
PICTURE = "(viewer.stage.render(), document.getElementById('canvas').toDataURL())"


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Return the capture of one camera with grey images."""
    root = tmp_path_factory.mktemp("capture")
    (root / "images" / "01").mkdir(parents=True)
    for frame in FRAMES:
        cv2.imwrite(str(root / "images" / "01" / f"{frame:06d}.png"), np.full((480, 640, 3), 60 + frame, np.uint8))
    return dataclasses.replace(capture(), root=root)


@pytest.fixture(scope="module")
def viewer(staged: StagedAvatar, photographed: Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the page of an avatar whose vertices are moved only by their fifth and later joints. A further motion has
    the four captured poses at 30 frames a second."""
    folder = tmp_path_factory.mktemp("viewer")
    glb, full = folder / "avatar.glb", staged.rigs["full"]
    fast = dataclasses.replace(full.motions["captured"], fps=30.0, codes=np.arange(4.0))
    full = dataclasses.replace(full, motions=full.motions | {"fast": fast})
    write_glb(glb, staged, full, INFO)
    glb.write_bytes(with_joints_in_second_set(glb.read_bytes()))
    written = write_viewer(folder / "viewer.html", glb, photographed, staged.stage_from_world, staged.levels)
    assert written == "viewer.html"
    return folder / "viewer.html"


@pytest.fixture(scope="module")
def page(viewer: Path) -> Iterator[Page]:
    """Open the page in a browser."""
    program = found_browser()
    if program is None:
        pytest.skip("no Chromium is installed")
    with browser(program) as opened:
        opened.open(viewer, 1000, 640)
        opened.wait("window.viewer !== undefined")
        opened.evaluate("document.getElementById('follow').click()")  # following would move the camera between images
        yield opened


def test_without_three_js_no_page_is_written_and_an_altered_one_is_refused(
    staged: StagedAvatar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stage's key depends on which files there are, so a page left out for another reason would stay away."""
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path))
    page, glb = tmp_path / "viewer.html", tmp_path / "avatar.glb"
    *others, last = THREE_SHA256
    for name in others:
        (tmp_path / name).write_text("// an older version")
    reason = write_viewer(page, glb, capture(), staged.stage_from_world, [])
    assert reason == "no viewer.html: three.js is not installed; run `hnerf models`"
    (tmp_path / last).write_text("// an older version")
    with pytest.raises(PlaceError, match=rf"/{others[0]}: altered or damaged; run `hnerf models`$"):
        write_viewer(page, glb, capture(), staged.stage_from_world, [])
    assert not page.exists()


def test_cameras_and_photographs_are_in_the_avatars_world(photographed: Capture, staged: StagedAvatar) -> None:
    found = recording(photographed, staged.stage_from_world)
    (camera,) = found["cameras"]
    # At (0, -3, 1) of a world with z up, looking along +y. With y up that is at (0, 1, 3), looking along -z.
    np.testing.assert_allclose(camera["pose"], [1, 0, 0, 0, 0, 1, 0, 1, 0, 0, 1, 3, 0, 0, 0, 1], atol=1e-12)
    assert {key: camera[key] for key in ("fx", "fy", "cx", "cy")} == {"fx": 500, "fy": 400, "cx": 300, "cy": 200}
    assert (found["fps"], found["first_frame"]) == (10, 3)
    taken = [(photograph["frame"], photograph["time_s"]) for photograph in camera["photographs"]]
    assert taken == [(3, 0.0), (4, 0.1), (5, 0.2)]
    jpeg = base64.b64decode(camera["photographs"][2]["jpeg"].split(",")[1])
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (288, 384, 3)
    assert abs(int(image[100, 100, 0]) - 65) <= 1


def test_lower_levels_of_detail_are_triangles_of_the_files_vertices(staged: StagedAvatar) -> None:
    """The file has a vertex for each row of the first level's texture coordinates."""
    lower, (level,) = staged.levels[1], lower_indices(staged.levels)
    vertex_of_row = np.zeros(len(staged.uvs), int)
    vertex_of_row[staged.face_uvs] = staged.faces
    assert np.array_equal(vertex_of_row[level], lower.vertices[lower.faces.ravel()])
    assert np.array_equal(staged.uvs[level], lower.layout.uvs[lower.layout.face_uvs.ravel()])


@NEEDS_THREE
def test_the_page_contains_every_imported_module(viewer: Path) -> None:
    modules = _modules()
    for name, source in modules.items():
        code = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
        imported = set(re.findall(r"""\bfrom ['"]([^'"]+)['"];$""", code, flags=re.MULTILINE))
        assert imported <= set(modules), name
    assert set(re.findall(r"from '(.*)';", modules["three/OrbitControls.js"])) >= {"three"}
    assert viewer.stat().st_size < MAX_BYTES


@NEEDS_THREE
def test_a_page_is_packed_once_per_texture_size(
    viewer: Path, photographed: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The avatar's texture has 64 px, so sizes 256, 128 and 64 give the same page; 32 and 16 give two more."""
    packed: list[bytes] = []
    monkeypatch.setattr("hnerf.asset.viewer._packed", lambda content: packed.append(content) or "")
    monkeypatch.setattr("hnerf.asset.viewer.MAX_BYTES", 1)
    monkeypatch.setattr("hnerf.asset.viewer.TEXTURES_PX", (256, 128, 64, 32, 16))
    write_viewer(tmp_path / "viewer.html", viewer.with_name("avatar.glb"), photographed, np.eye(3), [])
    assert [content[:4] for content in packed].count(b"glTF") == 3


@NEEDS_THREE
def test_a_page_that_is_too_large_gets_a_smaller_texture(
    staged: StagedAvatar,
    viewer: Path,
    photographed: Capture,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr("hnerf.asset.viewer.MAX_BYTES", viewer.stat().st_size - 1)
    monkeypatch.setattr("hnerf.asset.viewer.TEXTURES_PX", (64, 16, 8))
    write_viewer(tmp_path / "viewer.html", viewer.with_name("avatar.glb"), photographed, np.eye(3), staged.levels)
    packed = re.search(r'id="packed-avatar">(.*?)<', (tmp_path / "viewer.html").read_text())
    assert packed is not None
    document, binary = read_glb(gzip.decompress(base64.b64decode(packed[1])))
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    jpeg = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (16, 16, 3)
    monkeypatch.setattr("hnerf.asset.viewer.MAX_BYTES", 1)
    write_viewer(tmp_path / "viewer.html", viewer.with_name("avatar.glb"), photographed, np.eye(3), [])
    assert "viewer.html: over 0 MB even with a small texture: the motion is long or the mesh fine" in caplog.text


@NEEDS_THREE
def test_the_page_opens_without_console_warnings_or_requests(page: Page, viewer: Path) -> None:
    page.evaluate("new Promise(requestAnimationFrame)")
    assert page.complaints() == []
    assert page.requests() == [viewer.as_uri()]


@NEEDS_THREE
def test_the_page_plays_and_pauses_the_motion(page: Page) -> None:
    before = page.evaluate(LAST_JOINT + ".matrixWorld.elements.slice()")
    page.evaluate("viewer.play(true)")
    page.wait(f"{LAST_JOINT}.matrixWorld.elements.some((value, i) => value !== {before}[i])")
    page.press(" ")
    assert page.evaluate("viewer.playing") is False
    assert page.evaluate("document.getElementById('play').textContent") == "Play"
    page.evaluate("viewer.setTime(0.1)")
    page.press(".")
    assert page.evaluate("viewer.avatar.time") == pytest.approx(0.2)
    assert page.evaluate("document.getElementById('clock').textContent") == "frame 5 · 0.20 s"


@NEEDS_THREE
def test_each_motion_is_stepped_through_at_its_own_rate_to_its_last_frame(page: Page) -> None:
    """Rounded to floats, three frames of 1/30 s are longer than 0.1 s."""
    page.evaluate("viewer.setMotion(1)")
    page.press(".")
    assert page.evaluate("viewer.avatar.time") == pytest.approx(1 / 30)
    page.evaluate(move("#time", 10, "input"))
    assert page.evaluate("viewer.avatar.time") == pytest.approx(0.1)
    page.evaluate("viewer.setMotion(0)")
    page.press(".")
    assert page.evaluate("viewer.avatar.time") == pytest.approx(0.1)


@NEEDS_THREE
def test_a_single_captured_pose_is_a_frame_and_not_the_rest_pose(page: Page) -> None:
    clock = "document.getElementById('clock').textContent"
    lasts_s = page.evaluate("viewer.setMotion(0), viewer.avatar.duration")
    page.evaluate("viewer.avatar.motion.duration = 0, viewer.setTime(0)")
    assert page.evaluate(clock) == "frame 3 · 0.00 s"
    page.evaluate(f"viewer.avatar.motion.duration = {lasts_s}, viewer.setMotion(2)")
    assert page.evaluate(clock) == "at rest"
    page.evaluate("viewer.setMotion(0)")


@NEEDS_THREE
def test_a_slider_turns_its_joint_on_top_of_the_motion(page: Page) -> None:
    page.evaluate("viewer.setTime(0.2)")
    quaternion = f"{LAST_JOINT}.quaternion.toArray()"
    before, picture = page.evaluate(quaternion), page.evaluate(PICTURE)
    page.evaluate(move("#joint", page.evaluate("viewer.avatar.joints.length - 1"), "change"))
    page.evaluate(move("#turns input", 90, "input"))
    about_x = Rotation.from_euler("x", 90, degrees=True)
    expected = (Rotation.from_quat(before) * about_x).as_matrix()
    for _ in range(2):  # the second time, the turn must not be added again
        page.evaluate("viewer.setTime(0.2)")
        turned = Rotation.from_quat(page.evaluate(quaternion)).as_matrix()
        np.testing.assert_allclose(turned, expected, atol=1e-6)
    assert page.evaluate(PICTURE) != picture
    page.click("#straighten")
    assert page.evaluate(quaternion) == before
    assert page.evaluate(PICTURE) == picture


@NEEDS_THREE
def test_a_slider_adds_to_the_weight_of_a_shape(page: Page, staged: StagedAvatar) -> None:
    page.evaluate("viewer.setTime(0.2)")
    weights = "viewer.avatar.mesh.morphTargetInfluences.slice()"
    before, picture = page.evaluate(weights), page.evaluate(PICTURE)
    page.evaluate(move("#weights input", 0.5, "input"))
    np.testing.assert_allclose(page.evaluate(weights), np.add(before, np.eye(len(before))[0] / 2), atol=1e-6)
    assert page.evaluate(PICTURE) != picture
    page.evaluate("document.getElementById('unshape').click()")
    assert page.evaluate(weights) == before


@NEEDS_THREE
def test_shapes_that_a_motion_uses_are_found_in_long_motions_too(page: Page) -> None:
    """In a motion of 200 000 poses with five weights each, the last pose alone uses the fourth shape."""
    shapes = page.evaluate(
        "import('viewer/avatar.js').then(({ shapesOf }) => {"
        "  const values = new Float32Array(1_000_000); values[999_998] = 0.5;"
        "  const track = { name: 'Surface.morphTargetInfluences', values };"
        "  return shapesOf(viewer.avatar.mesh, [{ tracks: [track] }]);"
        "})"
    )
    assert [shape["name"] for shape in shapes if shape["moves"]] == ["frown"]
    assert page.evaluate("viewer.avatar.shapes.map(({ moves }) => moves)") == [True, True, True, False, False]


@NEEDS_THREE
def test_the_person_is_framed_from_the_front(page: Page, staged: StagedAvatar) -> None:
    low, high = page.evaluate("[viewer.bounds.box.min.toArray(), viewer.bounds.box.max.toArray()]")
    np.testing.assert_allclose([low, high], [staged.points_m[0].min(0), staged.points_m[0].max(0)], atol=5e-5)
    ground_m = sorted(staged.points_m[..., 1].min(1))
    x, _, z = page.evaluate("viewer.bounds.forward.toArray()")
    assert math.atan2(x, z) == pytest.approx(0.8 * FRAMES[0])  # the root's turn about the vertical, from +z
    assert ground_m[0] - 0.02 < page.evaluate("viewer.bounds.ground") < ground_m[-1] + 0.02


@NEEDS_THREE
@pytest.mark.parametrize("key", ["r", "R"])  # R with Caps Lock
def test_the_view_is_reset_to_where_the_person_is(key: str, page: Page, staged: StagedAvatar) -> None:
    page.evaluate("viewer.setTime(0), viewer.stage.frame(viewer.bounds), viewer.setTime(viewer.avatar.duration)")
    page.press(key)
    last_m = staged.points_m[-1]
    middle_m = (last_m.min(0) + last_m.max(0)) / 2
    np.testing.assert_allclose(page.evaluate("viewer.stage.orbit.target.toArray()"), middle_m, atol=1e-3)
    assert page.evaluate("viewer.avatar.time") == pytest.approx(0.5)


@NEEDS_THREE
def test_a_hidden_page_frames_the_person_when_it_is_shown(page: Page) -> None:
    camera = "viewer.stage.free.position.toArray()"
    page.evaluate("viewer.stage.frame(viewer.bounds)")
    framed = page.evaluate(camera)
    page.evaluate("viewer.stage.free.position.set(1, 2, 3)")
    page.evaluate("document.getElementById('view').hidden = true")
    page.wait("viewer.stage.canvas.clientWidth === 0")
    page.evaluate("new Promise(requestAnimationFrame)")  # so that the page notices
    page.evaluate("viewer.stage.frame(viewer.bounds)")
    assert page.evaluate("viewer.stage.free.projectionMatrix.elements.every(Number.isFinite)")
    assert page.evaluate(camera) == [1, 2, 3]
    page.evaluate("document.getElementById('view').hidden = false")
    page.wait(f"{camera}[0] !== 1")
    assert page.evaluate(camera) == pytest.approx(framed)


@NEEDS_THREE
def test_another_ground_replaces_the_old_one(page: Page) -> None:
    geometries = "(viewer.stage.render(), viewer.stage.renderer.info.memory.geometries)"
    before = page.evaluate(geometries)
    page.evaluate("viewer.stage.drawGround()")
    assert page.evaluate(geometries) == before


@NEEDS_THREE
def test_lower_levels_of_detail_are_drawn_in_every_look(page: Page) -> None:
    page.evaluate("viewer.setTime(0.2), viewer.stage.grid.visible = false")
    names = page.evaluate("[...document.getElementById('level').options].map(({ text }) => text)")
    assert names == ["lod0, 816 triangles", "lod1, 400 triangles"]
    drawn = "(viewer.stage.render(), viewer.stage.renderer.info.render)"
    for look, count in (("0", f"{drawn}.triangles"), ("2", f"{drawn}.lines")):
        page.evaluate(f"viewer.choose.look({look})")
        finest, picture = page.evaluate(count), page.evaluate(PICTURE)
        page.evaluate(move("#level", 1, "change"))
        assert page.evaluate(count) == pytest.approx(finest * 400 / 816)
        assert page.evaluate(PICTURE) != picture
        page.evaluate(move("#level", 0, "change"))
        assert page.evaluate(count) == finest
        assert page.evaluate(PICTURE) == picture
    page.evaluate("viewer.choose.look(0)")


@NEEDS_THREE
def test_the_albedo_is_shown_in_the_pages_light(page: Page) -> None:
    """With a light of half the strength, only looks that are lit are darker."""
    page.evaluate("viewer.setTime(0.2)")
    textured = page.evaluate(PICTURE)
    page.press("5")
    assert page.evaluate("document.querySelector('#looks :checked').parentElement.textContent") == "Albedo"
    albedo = page.evaluate(PICTURE)
    dimmed = "viewer.stage.scene.traverse((part) => part.isLight && (part.intensity *= %s))"
    page.evaluate(dimmed % "0.5")
    darker = page.evaluate(PICTURE)
    page.press("1")
    assert page.evaluate(PICTURE) == textured
    page.evaluate(dimmed % "2")
    shown = decoded(albedo)[..., 3] > 127
    assert decoded(darker)[shown, :3].mean() < 0.9 * decoded(albedo)[shown, :3].mean()
    assert page.evaluate("viewer.looks.materials.Albedo.map.image !== viewer.looks.materials.Textured.map.image")


@NEEDS_THREE
def test_lit_looks_have_the_normal_map(page: Page) -> None:
    """It has 32 px, and the textures 64."""
    names = ("Clay", "Wireframe", "Albedo")
    assert [page.evaluate(f"viewer.looks.materials.{name}.normalMap.image.width") for name in names] == [32] * 3


@NEEDS_THREE
def test_without_an_albedo_the_page_does_not_offer_it(page: Page) -> None:
    names = page.evaluate(
        "import('viewer/looks.js').then(({ Looks }) => {"
        "  const mesh = viewer.avatar.mesh.clone(); mesh.material = viewer.looks.materials.Clay;"
        "  return new Looks(mesh, null, null).names;"
        "})"
    )
    assert names == ["Textured", "Clay", "Wireframe", "Weights"]


@NEEDS_THREE
def test_the_rest_pose_moves_no_vertices(page: Page, staged: StagedAvatar) -> None:
    page.evaluate("viewer.setTime(0.2)")
    page.evaluate("viewer.setMotion(viewer.avatar.motions.length)")
    inverse = "viewer.avatar.inverses.get(joint)"
    moved = f"joint.matrixWorld.clone().multiply({inverse}).elements.map((value, i) => value - (i % 5 === 0))"
    off = page.evaluate(f"Math.max(...viewer.avatar.joints.flatMap(joint => {moved}).map(Math.abs))")
    assert off < 1e-6  # no joint moves its vertices
    page.evaluate("viewer.setMotion(0)")


@NEEDS_THREE
def test_a_recorded_camera_shows_the_avatar_over_its_photograph(page: Page, staged: StagedAvatar) -> None:
    page.evaluate("viewer.setTime(0.19)")
    page.click("#cameras label:nth-child(2)")
    assert page.evaluate("viewer.avatar.time") == pytest.approx(0.2)  # the time of the nearest photograph
    caption = "document.getElementById('caption').textContent"
    assert page.evaluate(caption) == "Photograph of frame 5"
    page.evaluate("viewer.setTime(0.26)")
    assert page.evaluate(caption) == "Photograph of frame 5, not the avatar's current time"
    page.evaluate("viewer.setTime(0.2)")
    assert page.evaluate("viewer.stage.camera.matrixWorld.elements.slice(12, 15)") == pytest.approx([0, 1, 3])
    left, top, width, height = page.evaluate(
        "(({offsetLeft, offsetTop, offsetWidth, offsetHeight}) => [offsetLeft, offsetTop, offsetWidth, offsetHeight])"
        "(document.getElementById('photograph'))"
    )
    assert width / height == pytest.approx(640 / 480, abs=0.01)
    page.evaluate("viewer.stage.grid.visible = false")
    shown = page.evaluate(PICTURE)
    canvas = decoded(shown)
    seen = cv2.resize(canvas[top : top + height, left : left + width, 3], (640, 480), interpolation=cv2.INTER_AREA)
    expected = outline(staged.points_m[2] @ staged.stage_from_world, staged.faces)
    overlap = ((seen > 127) & expected).sum() / ((seen > 127) | expected).sum()
    assert overlap > 0.97
    page.click("#cameras label:nth-child(1)")
    assert page.evaluate("document.getElementById('photograph').hidden")


@NEEDS_THREE
@pytest.mark.parametrize("fps", [10, 10_000])
def test_the_next_photograph_is_found_at_any_frame_rate(fps: int, page: Page) -> None:
    besides = (
        "(({constructor}) => { const found = new constructor(null, null, %d);"
        "found.camera = {photographs: [0, 1, 2].map((frame) => ({time_s: frame / %d}))};"
        "return [-1, 1].map((direction) => found.beside(1 / %d, direction).time_s); })(viewer.photographs)"
    )
    assert page.evaluate(besides % (fps, fps, fps)) == pytest.approx([0, 2 / fps])


@NEEDS_THREE
def test_a_long_lens_shows_a_person_half_a_kilometre_away(page: Page) -> None:
    """The column is 5 m from the camera. At 100 times that, 100 times the focal length shows the same size."""
    page.evaluate("viewer.setTime(0), viewer.stage.grid.visible = false")
    near, far = (
        page.evaluate(
            f"(({{fx, fy, pose, ...camera}}) => (viewer.stage.lookThrough({{...camera, fx: {k} * fx, fy: {k} * fy, "
            f"pose: pose.map((value, i) => value + (i === 11 && 5 * ({k} - 1)))}}), {PICTURE}))"
            "(viewer.recording.cameras[0])"
        )
        for k in (1, 100)
    )
    page.evaluate("viewer.stage.lookThrough(null)")
    covered = [(decoded(shown)[..., 3] > 127).sum() for shown in (near, far)]
    assert covered[0] > 1000 and covered[1] == pytest.approx(covered[0], rel=0.1)


def decoded(uri: str) -> np.ndarray:
    """Return the image (H, W, 4) of a data URI."""
    return cv2.imdecode(np.frombuffer(base64.b64decode(uri.split(",")[1]), np.uint8), cv2.IMREAD_UNCHANGED)


def outline(world_m: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the pixels where the side camera sees a surface, (480, 640) bool."""
    hits = cast_pixels(Surface.of(world_m, faces), side_camera())
    return (hits.face >= 0).reshape(480, 640)


def move(selector: str, value: float, event: str) -> str:
    """Return a script that moves the first control of a selector as a user does."""
    return (
        f"(control => {{ control.value = {value}; control.dispatchEvent(new Event('{event}')); }})"
        f"(document.querySelector('{selector}'))"
    )


def with_joints_in_second_set(glb: bytes) -> bytes:
    """Return the file with four zero-weight influences inserted before those of each vertex."""
    document, binary = read_glb(glb)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    for name in ("JOINTS", "WEIGHTS"):
        attributes[f"{name}_1"] = attributes[f"{name}_0"]
        accessor = document["accessors"][attributes[f"{name}_1"]]
        attributes[f"{name}_0"] = len(document["accessors"])
        document["accessors"].append({key: accessor[key] for key in ("componentType", "count", "type")})  # zeros
    return as_glb(document, binary)
