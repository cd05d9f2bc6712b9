"""Automatic settings of the fast field and of training, from the capture's pixels, masks and poses.

A setting that is 0, or has no cells, is open; values from a preset or an override are kept. `benchmarks/budget.py`
measures the effect of doubling and halving the settings.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from hnerf.body.fit_result import BodyFit
from hnerf.capture.capture import Capture
from hnerf.capture.masks import Masks, outline
from hnerf.config import FastFieldSettings, TrainingSettings
from hnerf.errors import InputError
from hnerf.evenly_spaced import evenly_spaced
from hnerf.geometry.silhouette import silhouette

ALIGNMENT_M = 0.01  # accuracy to which poses align; finer detail blurs, whatever the cells
FINEST_M = 0.008  # least cell size for one posture; with 6 mm, an Adam step takes three times as long
COLOUR_LEVELS, GEOMETRY_LEVELS = 4, 3  # of the grids, in a geometric series
COARSEST_CELLS = {"colour": 24, "geometry": 16}
GEOMETRY_COARSER = 1.5  # times coarser than colour: fingers and folds are larger than prints
SPACING_CELLS, MAX_SPACING_M = 0.6, 0.006  # of samples, at the end of training
SHELL_MARGIN_M = 0.015  # beyond the extent of the masks, for poses that are still inaccurate
MIN_THICKNESS_M, MAX_THICKNESS_M = 0.03, 0.15
MASKS_PER_CAMERA = 6  # number of masks to measure
MIN_POSE_STD_RAD = 0.05  # below it, nothing can be learned from joint angles
GROUND_M, SUNK_M = 0.03, 0.05  # of bodies' lowest points: median distance from height 0, greatest depth below it
ONE_POSTURE_RAD = 0.002  # std_rad below which the fit found one posture in all frames
POSE_WIDTH = 8
NODES = 128  # about 12 cm apart; finer detail, such as a collar, is left to the canonical surface
RAYS_PER_PIXEL = 1.5  # of the person; about half of all rays meet the person
MIN_STEPS, MAX_STEPS = 600, 4000
STEPS_PER_FRAME = 270  # with a frame's rays, until its body's depth converges with one camera


@dataclass(frozen=True)
class Decision:
    """Value of an automatic setting, and its reason."""

    value: int | float | str | tuple[float, ...]
    reason: str


@dataclass(frozen=True)
class SceneStatistics:
    """Statistics of the capture that determine settings.

    footprint_m: size of a pixel on the body, median over cameras. outside_m, inside_m: how far masks extend outside the
    fitted body and stay inside it, for 99 % of their outlines. side_m: longest side of the rest body. std_rad: mean
    standard deviation of the free joints. person_px: pixels of the person in all training images. lowest_m: height of
    each body's lowest point, median and minimum over frames.
    """

    cameras: int
    frames: int
    footprint_m: float
    outside_m: float
    inside_m: float
    side_m: float
    std_rad: float
    person_px: int
    lowest_m: tuple[float, float]

    @staticmethod
    def of(capture: Capture, masks: Masks, body: BodyFit) -> "SceneStatistics":
        """Measure the statistics, with some masks of every training camera. Raises InputError if no mask shows the
        person."""
        vertices_m, faces = body.vertices_m().numpy(), body.rig.faces.numpy()
        footprints_m, outlines_m, person_px = [], [], 0.0
        for camera in (capture.cameras[name] for name in capture.train_cameras):
            kept = [frame for frame in capture.train_frames if (camera.name, frame) in masks]
            areas_px = []
            for frame in evenly_spaced(kept, MASKS_PER_CAMERA):
                points_m = vertices_m[body.index(frame)]
                footprints_m.append(float(np.median(camera.project(points_m)[1])) / camera.K[0, 0])
                covered = silhouette(camera, points_m, faces)
                mask = masks.get(camera.name, frame)
                outlines_m.append(footprints_m[-1] * _outline_distance_px(mask, covered))
                areas_px.append(mask.sum())
            person_px += len(kept) * float(np.mean(areas_px or [0]))
        if not sum(map(len, outlines_m)):
            raise InputError(f"{capture.name}: no mask shows the person; see the report of the segmentation")
        inside_m, outside_m = np.percentile(np.concatenate(outlines_m), [1, 99])
        rows = [body.index(frame) for frame in capture.train_frames]
        lowest_m = vertices_m[rows, :, "xyz".index(capture.up)].min(1)
        angles = body.theta[rows][:, body.rig.free]
        return SceneStatistics(
            cameras=len(capture.train_cameras),
            frames=len(capture.train_frames),
            footprint_m=float(np.median(footprints_m)),
            outside_m=float(max(outside_m, 0)),
            inside_m=float(max(-inside_m, 0)),
            side_m=float((body.rig.vertices_m.amax(0) - body.rig.vertices_m.amin(0)).max()),
            std_rad=float((angles - angles.mean(0)).square().sum(-1).mean(0).sqrt().mean()),
            person_px=round(person_px),
            lowest_m=(float(np.median(lowest_m)), float(lowest_m.min())),
        )


def decide(scene: SceneStatistics, settings: TrainingSettings) -> tuple[TrainingSettings, dict[str, Decision]]:
    """Return the settings with all open ones decided, and each decision by the setting's name."""
    wanted = _field_decisions(scene, settings.field) if isinstance(settings.field, FastFieldSettings) else {}
    open_decisions = {name: decision for name, decision in wanted.items() if not getattr(settings.field, name)}
    field = settings.field.model_copy(update={name: decision.value for name, decision in open_decisions.items()})
    decisions = {f"field.{name}": decision for name, decision in open_decisions.items()}
    other_decisions = {"steps": _steps(scene, settings)} if not settings.steps else {}
    if settings.one_posture is None:
        other_decisions["one_posture"] = _one_posture(scene, settings)
    if settings.ground is None:
        other_decisions["ground"] = _ground(scene)
    update = {name: decision.value for name, decision in other_decisions.items()}
    return settings.model_copy(update={"field": field} | update), decisions | other_decisions


def _field_decisions(scene: SceneStatistics, given: FastFieldSettings) -> dict[str, Decision]:
    posed = scene.frames > 1 and scene.std_rad >= ONE_POSTURE_RAD
    cell_m = max(scene.footprint_m, ALIGNMENT_M if posed else FINEST_M)
    align = f"poses align to {_mm(ALIGNMENT_M)}" if posed else "there is one posture"
    finest = f"a pixel covers {_mm(scene.footprint_m)}, {align}: cells of {_mm(cell_m)}"
    outer_m, inner_m = (_thickness_m(reach_m) for reach_m in (scene.outside_m, scene.inside_m))
    nearly_static = scene.std_rad < MIN_POSE_STD_RAD
    colour_cells = given.colour_cells or _level_cells(COARSEST_CELLS["colour"], scene.side_m / cell_m, COLOUR_LEVELS)
    return {
        "outer_m": Decision(outer_m, f"masks reach {_mm(scene.outside_m)} out of the fitted body, plus a margin"),
        "inner_m": Decision(inner_m, f"masks stay {_mm(scene.inside_m)} inside the fitted body, plus a margin"),
        "spacing_m": Decision(
            min(SPACING_CELLS * cell_m, MAX_SPACING_M),
            f"{SPACING_CELLS:g} cells of {_mm(cell_m)}, at most {_mm(MAX_SPACING_M)}",
        ),
        "colour_cells": Decision(colour_cells, finest),
        "geometry_cells": Decision(
            _level_cells(COARSEST_CELLS["geometry"], colour_cells[-1] / GEOMETRY_COARSER, GEOMETRY_LEVELS),
            f"{GEOMETRY_COARSER} times coarser than colour",
        ),
        "pose_width": Decision(
            1 if nearly_static else POSE_WIDTH,
            f"joints spread {np.rad2deg(scene.std_rad):.1f} degrees over {scene.frames} frames"
            + (": too little to learn from" if nearly_static else ""),
        ),
        "nodes": _nodes(scene, given),
    }


def _nodes(scene: SceneStatistics, given: FastFieldSettings) -> Decision:
    if not given.deformation_learning_rate:
        return Decision(0, "no learning rate for them")
    if scene.frames == 1:
        return Decision(0, "one frame: its shape is the canonical shape")
    if scene.cameras == 1:
        return Decision(0, "one camera does not see where clothes move")
    return Decision(NODES, f"skinning does not move the clothes of {scene.frames} frames alike")


def _one_posture(scene: SceneStatistics, settings: TrainingSettings) -> Decision:
    fitted = f"fitted joints spread {np.rad2deg(scene.std_rad):.2f} degrees over {scene.frames} frames"
    if settings.field.kind != "fast" or scene.frames == 1:
        return Decision(False, "each frame has its own pose")
    return Decision(scene.std_rad < ONE_POSTURE_RAD, fitted)


def _ground(scene: SceneStatistics) -> Decision:
    median_m, lowest_m = scene.lowest_m
    stand = f"bodies' lowest points are at {_mm(median_m)} in the median, {_mm(lowest_m)} or higher"
    return Decision(abs(median_m) < GROUND_M and lowest_m > -SUNK_M, stand)


def _steps(scene: SceneStatistics, settings: TrainingSettings) -> Decision:
    rays = settings.frames_per_step * settings.rays_per_frame
    wanted = RAYS_PER_PIXEL * scene.person_px / rays
    reason = f"{scene.person_px} pixels of the person at {rays} rays a step ask for {wanted:.0f}"
    if scene.cameras == 1 and scene.frames > 1 and settings.pose_learning_rate:
        depths = STEPS_PER_FRAME * scene.frames / settings.frames_per_step
        wanted = max(wanted, depths)
        reason += f", the depths of {scene.frames} bodies in one camera for {depths:.0f}"
    steps = int(np.clip(round(wanted, -1), MIN_STEPS, MAX_STEPS))
    return Decision(steps, f"{reason}; never fewer than {MIN_STEPS} or more than {MAX_STEPS}")


def _outline_distance_px(mask: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Return the distances (P,) of a mask's outline from the body's silhouette, negative inside it; none if the body
    fills the image or is not in it."""
    if covered.all() or not covered.any():
        return np.zeros(0)
    outwards = cv2.distanceTransform((~covered).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inwards = cv2.distanceTransform(covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return (outwards - inwards)[outline(mask)]


def _thickness_m(reach_m: float) -> float:
    return round(float(np.clip(reach_m + SHELL_MARGIN_M, MIN_THICKNESS_M, MAX_THICKNESS_M)), 3)


def _level_cells(coarsest: int, finest: float, levels: int) -> tuple[int, ...]:
    """Return the cells of each level along the longest side; one level if the finest is no finer than the coarsest."""
    if finest <= coarsest:
        return (max(2, round(finest)),)
    return tuple(int(n) for n in np.geomspace(coarsest, finest, levels).round())


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm"
