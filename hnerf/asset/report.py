"""The report of the asset: one self-contained HTML file next to it, which links to the viewer."""

from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hnerf.asset.baking import Filled
from hnerf.asset.comparison import Compared
from hnerf.asset.extreme_poses import ExtremePose
from hnerf.asset.pictures import joints_over, moving_uri, textured, turntable_cameras, uv_picture, wireframe
from hnerf.asset.rigs import StagedRig
from hnerf.asset.skeleton import FRONT
from hnerf.asset.staging import CAPTURED, StagedAvatar
from hnerf.evaluation.galleries import GalleryPicture, captioned
from hnerf.evaluation.pictures import Shot, clay, shoot, shrunk
from hnerf.evaluation.report import report_environment
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.camera import Camera
from hnerf.geometry.mesh_queries import Surface
from hnerf.side_by_side import side_by_side

TEMPLATES = Path(__file__).parent / "page"
STILLS, TURNS = 4, 24  # views of the turntable, as stills and in the image that moves
MOVING = 0.7  # size of the latter, as a share of the former's
TURN_MS = 160  # how long it shows a view
COMPARED = 3  # views shown next to the field's
SQUARE_PX = 640  # of the layout, and at most of the texture


def write_report(
    path: Path,
    name: str,
    avatar: StagedAvatar,
    filled: Filled,
    frame: int,
    world_from_body: np.ndarray,
    compared: list[Compared],
    poses: list[ExtremePose],
    figures: dict[str, Any],
) -> None:
    """Write the page of an avatar called `name`, shown in the pose of a frame. world_from_body (4, 4): the transform of
    the body, Z up and facing -Y, in that frame; figures: the content of `report.json`."""
    facing = avatar.stage_from_world @ -world_from_body[:3, 1]
    row = list(avatar.frames).index(frame)
    points_m = avatar.points_m[row].astype(np.float64)
    surface = Surface.of(points_m, avatar.faces)
    shots = list(side_by_side(partial(shoot, surface), turntable_cameras(points_m, facing, STILLS)))
    front, back = shots[0], shots[STILLS // 2]
    turns = [camera.scaled(MOVING) for camera in turntable_cameras(points_m, facing, TURNS)]
    page = report_environment(TEMPLATES).get_template("asset.html")
    path.write_text(
        page.render(
            name=name,
            frame=frame,
            has_viewer=(path.parent / "viewer.html").exists(),
            moving=moving_uri(
                list(side_by_side(lambda camera: textured(shoot(surface, camera), avatar), turns)), TURN_MS
            ),
            turntable=[captioned(f"{360 * k // STILLS}°", textured(shot, avatar)) for k, shot in enumerate(shots)],
            surface=[
                captioned("Clay, front", clay(front)),
                captioned("Clay, back", clay(back)),
                captioned("Wireframe, front", wireframe(front)),
                captioned("Wireframe, back", wireframe(back)),
                *_less_detail(avatar, points_m, front.camera),
                *(_joints(front, name, rig, row) for name, rig in avatar.rigs.items()),
            ],
            texture=[
                captioned("Texture", shrunk(avatar.texture, SQUARE_PX)),
                captioned("Layout", uv_picture(avatar, SQUARE_PX)),
                captioned(
                    f"White: the {filled.share:.1%} of texels that no photograph shows, filled by the field",
                    cv2.cvtColor(shrunk(filled.mask, SQUARE_PX), cv2.COLOR_GRAY2RGB),
                ),
                *_without_light(avatar),
            ],
            against_field=[_beside_field(view) for view in evenly_spaced(compared, COMPARED)],
            poses=list(chain.from_iterable(side_by_side(partial(_extreme, avatar), poses))),
            figures=figures,
        ),
        encoding="utf-8",
    )


def _joints(shot: Shot, name: str, rig: StagedRig, row: int) -> GalleryPicture:
    """Return the clay figure with the joints of a rig over it, in the pose of a row of the captured motion."""
    positions_m = rig.stage(CAPTURED, [row])[0, :, :3, 3]
    picture = joints_over(clay(shot), shot.camera, positions_m, rig.skeleton.parents)
    return captioned(f"{name.capitalize()} rig, {len(positions_m)} joints", picture)


def _beside_field(view: Compared) -> list[GalleryPicture]:
    """Return the photograph of a view and all its renders, with their PSNR."""
    captions = {"field": "Field", "asset": "Captured look", "albedo": "Albedo in its light", "splats": "Splats"}
    return [
        captioned(f"Photograph, camera {view.view.camera}, frame {view.view.frame}", view.photograph),
        *(
            captioned(f"{captions[name]}, {view.scores[name]['psnr']:.1f} dB", render[..., :3])
            for name, render in view.renders.items()
        ),
    ]


def _less_detail(avatar: StagedAvatar, points_m: np.ndarray, camera: Camera) -> list[GalleryPicture]:
    """Return the wireframe of each lower level of detail."""
    shots = [shoot(Surface.of(points_m[lv.vertices], lv.faces), camera) for lv in avatar.levels[1:]]
    return [captioned(f"lod{k}, {len(shot.mesh.faces)} triangles", wireframe(shot)) for k, shot in enumerate(shots, 1)]


def _without_light(avatar: StagedAvatar) -> list[GalleryPicture]:
    """Return the albedo and the light, if there are any."""
    if avatar.albedo is None:
        return []
    light = cv2.resize(avatar.albedo.dome[0], (SQUARE_PX, SQUARE_PX // 2))
    return [
        captioned("Albedo", shrunk(avatar.albedo.texture, SQUARE_PX)),
        captioned("Estimated light, +Z in the middle, +X left of it", light),
    ]


def _extreme(avatar: StagedAvatar, pose: ExtremePose) -> list[GalleryPicture]:
    """Return a pose in clay and textured."""
    camera = turntable_cameras(pose.points_m[pose.shown], FRONT, 1)[0]
    shot = shoot(Surface.of(pose.points_m, avatar.faces), camera)
    return [
        captioned(f"{pose.name}: {100 * pose.crossing:.1f} % of faces cross", clay(shot)),
        captioned(pose.name, textured(shot, avatar)),
    ]
