"""The scene decides the size: what a capture's pixels, masks and poses ask of the fast field, and no more.

A setting of 0, or no cells, is open; what a preset or an override names stands. `benchmarks/budget.py` measures what
twice and half as much are worth.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks
from hnerf.config import FastFieldSettings, TrainingSettings
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.silhouette import silhouette

ALIGNMENT_M = 0.01  # to which surfaces of different poses lie on each other; what is finer blurs, whatever the cells
FINEST_M = 0.008  # cells of one posture: with 6 mm Adam takes three times as long for each step as with these
COLOUR_LEVELS, GEOMETRY_LEVELS = 4, 3  # of the grids, from the coarsest to the finest in equal ratios
COARSEST_CELLS = {"colour": 24, "geometry": 16}
GEOMETRY_COARSER = 1.5  # times than colour: fingers and folds are larger than prints
PATH = 2.4  # of a ray through the shell, in thicknesses of it, in the mean over rays that meet a person
SAMPLE_CELLS, LONGEST_SAMPLE_M = 0.6, 0.006  # between samples: smoother and nearer surfaces than with one each cell
ROOM_M = 0.015  # beyond where masks reach, for poses that are still wrong
THINNEST_M, THICKEST_M = 0.03, 0.15
MASKS_A_CAMERA = 6  # are looked at
STILL_RAD = 0.05  # spread of joints below which nothing can be learned from their angles
ONE_POSTURE_RAD = 0.002  # spread of joints as the fit leaves it where it found one posture in all frames
POSE_WIDTH = 8
NODES = 128  # about 12 cm apart: what they cannot follow, such as a collar, is the canonical surface's own
LOOKS = 1.5  # how often a person's pixel is drawn in the mean
LEAST_STEPS, MOST_STEPS = 600, 4000
STEPS_A_FRAME = 540  # that see it, until its body stands as deep as one camera can tell; half as many lose 0.7 dB


@dataclass(frozen=True)
class Decision:
    """A setting's value and why it is that."""

    value: int | float | tuple[float, ...]
    reason: str


@dataclass(frozen=True)
class SceneStatistics:
    """What was recorded, as far as it decides sizes. footprint_m: of a pixel on the body, median over cameras;
    outside_m, inside_m: how far masks reach out of the fitted body and stay inside it, 99 % of their outlines; side_m:
    longest of the rest body; std_rad: of the free joints, mean; person_px: pixels of the person in all training
    images."""

    cameras: int
    frames: int
    footprint_m: float
    outside_m: float
    inside_m: float
    side_m: float
    std_rad: float
    person_px: int

    @staticmethod
    def of(capture: Capture, masks: Masks, body: BodyFit) -> "SceneStatistics":
        """Looks at some masks of every training camera."""
        vertices_m, faces = body.vertices_m().numpy(), body.rig.faces.numpy()
        footprints_m, outlines_m, images, areas_px = [], [], 0, []
        for camera in (capture.cameras[name] for name in capture.train_cameras):
            kept = [frame for frame in capture.train_frames if (camera.name, frame) in masks]
            images += len(kept)
            for frame in evenly_spaced(kept, MASKS_A_CAMERA):
                points_m = vertices_m[body.index(frame)]
                footprints_m.append(float(np.median(camera.project(points_m)[1])) / camera.K[0, 0])
                covered = silhouette(camera, points_m, faces)
                mask = masks.get(camera.name, frame)
                outlines_m.append(footprints_m[-1] * _beyond_px(mask, covered))
                areas_px.append(mask.sum())
        if not sum(map(len, outlines_m)):
            raise InputError(f"{capture.name}: no mask shows the person; see the report of the segmentation")
        inside_m, outside_m = np.percentile(np.concatenate(outlines_m), [1, 99])
        rows = [body.index(frame) for frame in capture.train_frames]
        angles = body.theta[rows][:, body.rig.free]
        return SceneStatistics(
            cameras=len(capture.train_cameras),
            frames=len(capture.train_frames),
            footprint_m=float(np.median(footprints_m)),
            outside_m=float(max(outside_m, 0)),
            inside_m=float(max(-inside_m, 0)),
            side_m=float((body.rig.vertices_m.amax(0) - body.rig.vertices_m.amin(0)).max()),
            std_rad=float((angles - angles.mean(0)).square().sum(-1).mean(0).sqrt().mean()),
            person_px=round(images * float(np.mean(areas_px))),
        )


def decide(scene: SceneStatistics, settings: TrainingSettings) -> tuple[TrainingSettings, dict[str, Decision]]:
    """The settings with all that was open decided, and each decision by its setting's name."""
    wanted = _field(scene, settings.field) if isinstance(settings.field, FastFieldSettings) else {}
    made = {name: decision for name, decision in wanted.items() if not getattr(settings.field, name)}
    field = settings.field.model_copy(update={name: decision.value for name, decision in made.items()})
    decisions = {f"field.{name}": decision for name, decision in made.items()}
    whole = {"steps": _steps(scene, settings)} if not settings.steps else {}
    if settings.one_posture is None:
        whole["one_posture"] = _one_posture(scene, settings)
    update = {name: decision.value for name, decision in whole.items()}
    return settings.model_copy(update={"field": field} | update), decisions | whole


def _field(scene: SceneStatistics, given: FastFieldSettings) -> dict[str, Decision]:
    posed = scene.frames > 1 and scene.std_rad >= ONE_POSTURE_RAD
    cell_m = max(scene.footprint_m, ALIGNMENT_M if posed else FINEST_M)
    sample_m = min(SAMPLE_CELLS * cell_m, LONGEST_SAMPLE_M)
    align = f"poses align to {_mm(ALIGNMENT_M)}" if posed else "there is one posture"
    finest = f"a pixel covers {_mm(scene.footprint_m)}, {align}: cells of {_mm(cell_m)}"
    outer_m, inner_m = (_thickness_m(reach_m) for reach_m in (scene.outside_m, scene.inside_m))
    outer_m, inner_m = given.outer_m or outer_m, given.inner_m or inner_m
    still = scene.std_rad < STILL_RAD
    colour_cells = given.colour_cells or _ladder(COARSEST_CELLS["colour"], scene.side_m / cell_m, COLOUR_LEVELS)
    return {
        "outer_m": Decision(outer_m, f"masks reach {_mm(scene.outside_m)} out of the fitted body, and room"),
        "inner_m": Decision(inner_m, f"masks stay {_mm(scene.inside_m)} inside the fitted body, and room"),
        "samples": Decision(
            max(8, round(PATH * (outer_m + inner_m) / sample_m)),
            f"one each {_mm(sample_m)} of a ray through a shell of {_mm(outer_m + inner_m)}",
        ),
        "colour_cells": Decision(colour_cells, finest),
        "geometry_cells": Decision(
            _ladder(COARSEST_CELLS["geometry"], colour_cells[-1] / GEOMETRY_COARSER, GEOMETRY_LEVELS),
            f"{GEOMETRY_COARSER} times coarser than colour",
        ),
        "pose_width": Decision(
            1 if still else POSE_WIDTH,
            f"joints spread {np.rad2deg(scene.std_rad):.1f} degrees over {scene.frames} frames"
            + (": too little to learn from" if still else ""),
        ),
        "nodes": _nodes(scene, given),
    }


def _nodes(scene: SceneStatistics, given: FastFieldSettings) -> Decision:
    if not given.deformation_learning_rate:
        return Decision(0, "no learning rate for them")
    if scene.frames == 1:
        return Decision(0, "one frame: it is the canonical body's own form")
    if scene.cameras == 1:
        return Decision(0, "one camera does not see where clothes move")
    return Decision(NODES, f"skinning does not move the clothes of {scene.frames} frames alike")


def _one_posture(scene: SceneStatistics, settings: TrainingSettings) -> Decision:
    fitted = f"fitted joints spread {np.rad2deg(scene.std_rad):.2f} degrees over {scene.frames} frames"
    if settings.field.kind != "fast" or scene.frames == 1:
        return Decision(False, "each frame has its own pose")
    return Decision(scene.std_rad < ONE_POSTURE_RAD, fitted)


def _steps(scene: SceneStatistics, settings: TrainingSettings) -> Decision:
    rays = settings.frames_per_step * settings.rays_per_frame
    wanted = LOOKS * scene.person_px / rays
    reason = f"{scene.person_px} pixels of the person at {rays} rays a step ask for {wanted:.0f}"
    if scene.cameras == 1 and scene.frames > 1 and settings.pose_learning_rate:
        depths = STEPS_A_FRAME * scene.frames / settings.frames_per_step
        wanted = max(wanted, depths)
        reason += f", the depths of {scene.frames} bodies in one camera for {depths:.0f}"
    steps = int(np.clip(round(wanted, -1), LEAST_STEPS, MOST_STEPS))
    return Decision(steps, f"{reason}; never fewer than {LEAST_STEPS} or more than {MOST_STEPS}")


def _beyond_px(mask: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Distance of a mask's outline from the body's silhouette, (P,), negative inside it."""
    outline = mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    outwards = cv2.distanceTransform((~covered).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inwards = cv2.distanceTransform(covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (outwards - inwards)[outline]


def _thickness_m(reach_m: float) -> float:
    return round(float(np.clip(reach_m + ROOM_M, THINNEST_M, THICKEST_M)), 3)


def _ladder(coarsest: int, finest: float, levels: int) -> tuple[int, ...]:
    """Cells of each level along the longest side; one level where the finest is no finer than the coarsest."""
    if finest <= coarsest:
        return (max(2, round(finest)),)
    return tuple(int(n) for n in np.geomspace(coarsest, finest, levels).round())


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm"
