"""Put faults into a copy of the code, one at a time, and see whether tests turn red:

    python tests/faults.py [--at-once 2] [NAME ...]

A fault is an exact text of a file and what stands there instead. All of them are put in unless some are named. The
checkout stays as it is. The exit status is 1 if a fault is missed, 2 if the tests fail without any or a text is not
found exactly once.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
COPIED = ("hnerf", "tasks", "flows", "tests", "configs", "pyproject.toml")
PYTEST = (sys.executable, "-m", "pytest", "-o", "addopts=", "-x", "-q", "-p", "no:cacheprovider")

PAPER, FAST = "hnerf/fields/paper.py", "hnerf/fields/fast.py"
LOSSES, STEP = "hnerf/training/losses.py", "hnerf/training/step.py"
CONDITIONS, TRAINER = "hnerf/fields/conditions.py", "hnerf/training/trainer.py"
TUNED_POSES = "hnerf/training/tuned_poses.py"
COMPOSITING, CANONICAL = "hnerf/fields/compositing.py", "hnerf/fields/grids.py"
ENCODING, MLP = "hnerf/fields/encoding.py", "hnerf/fields/mlp.py"
BODIES, GATHER = "hnerf/body/canonical.py", "hnerf/training/gather.py"
SPARSE, SHELL = "hnerf/fields/sparse_grids.py", "hnerf/fields/shell.py"
PULL = "hnerf/body/correction_pull.py"
BOARDS, BUNDLE = "hnerf/calibration/boards/rig.py", "hnerf/calibration/bundle.py"
CAMERA, TRIANGULATION = "hnerf/geometry/camera.py", "hnerf/geometry/triangulation.py"
QUERIES, SILHOUETTE = "hnerf/geometry/mesh_queries.py", "hnerf/geometry/silhouette.py"
COLMAP, ZJUMOCAP = "hnerf/capture/formats/colmap.py", "hnerf/capture/formats/zjumocap.py"
SAFE_IO, TIMING = "hnerf/capture/safe_io.py", "hnerf/capture/timing.py"
NORMALISE, MANIFEST = "hnerf/capture/normalise.py", "hnerf/capture/manifest.py"
PLATE, REGISTRATION = "hnerf/asset/plate.py", "hnerf/asset/registration.py"
FIELD_COLOURS = "hnerf/asset/field_colours.py"
GLB, USD, PACKAGE = "hnerf/asset/glb.py", "hnerf/asset/usd.py", "hnerf/asset/package.py"
SPLATS, SPLAT_RENDERING = "hnerf/asset/splats.py", "hnerf/asset/splat_rendering.py"
SKELETON, MOTIONS, SKINNING = "hnerf/asset/skeleton.py", "hnerf/asset/motions.py", "hnerf/asset/skinning.py"
RIGS, BVH, BVH_MOTION = "hnerf/asset/rigs.py", "hnerf/body/bvh.py", "hnerf/render/bvh_motion.py"
ANTIALIASING, CORRECTIVES = "hnerf/avatar/antialiasing.py", "hnerf/asset/correctives.py"
PHOTOGRAPHS, SURFACE = "hnerf/asset/photographs.py", "hnerf/avatar/surface.py"
LIGHT, SHADING = "hnerf/asset/light.py", "hnerf/asset/shading.py"
ALBEDO, DOME = "hnerf/asset/albedo.py", "hnerf/asset/dome.py"
METRICS, REPORT = "hnerf/evaluation/metrics.py", "hnerf/evaluation/report.py"
EXPOSURE, ARTICULATION = "hnerf/training/exposure.py", "hnerf/body/articulation.py"
REACH, SCORES = "hnerf/geometry/reach.py", "hnerf/evaluation/geometry.py"
FINGERS, CONTOUR = "hnerf/body/fingers.py", "hnerf/body/contour_fit.py"
POSTURES, BY_POSTURES = "hnerf/body/posture_prior.py", "tests/body/test_posture_prior.py"
POLICY, STORE = "tasks/policy.py", "tasks/store.py"
INVENTORY, PACKED, LIMITS = "tasks/inventory.py", "tasks/packed.py", "tasks/limits.py"
BUCKET, LEASE, SHARED = "tasks/bucket.py", "tasks/lease.py", "tasks/shared.py"

BY_PAPER, BY_LOSSES = "tests/fields/test_paper.py", "tests/training/test_losses.py"
BY_STEP, BY_CONDITIONS = "tests/training/test_step.py", "tests/fields/test_conditions.py"
BY_TRAINER, BY_TIGHTEN = "tests/training/test_trainer_step.py", "tests/training/test_tighten.py"
BY_RAY, BY_CANONICAL = "tests/fields/test_fast_ray.py", "tests/fields/test_grids.py"
BY_FAST, BY_COMPOSITING = "tests/fields/test_fast.py", "tests/fields/test_compositing.py"
BY_ENCODING, BY_MLP = "tests/fields/test_encoding.py", "tests/fields/test_mlp.py"
BY_EXPOSURE = "tests/training/test_exposure.py"
BY_SPARSE, BY_SHELL = "tests/fields/test_sparse_grids.py", "tests/fields/test_shell.py"
BY_PULL, BY_DESCRIPTOR = "tests/body/test_correction_pull.py", "tests/body/test_descriptor.py"
BY_CAMERA, BY_TRIANGULATION = "tests/geometry/test_camera.py", "tests/geometry/test_triangulation.py"
BY_FILES, BY_USD = "tests/capture/formats/test_camera_files.py", "tests/asset/test_usd.py"
BY_PACKAGE, BY_MOTIONS = "tests/asset/test_package.py", "tests/asset/test_motions.py"
BY_SKINNING = "tests/asset/test_skinning.py"
BY_SPLATS, BY_SPLAT_RENDERING = "tests/asset/test_splats.py", "tests/asset/test_splat_rendering.py"
BY_BVH, BY_BVH_MOTION = "tests/body/test_bvh.py", "tests/render/test_bvh_motion.py"
BY_METRICS, BY_POLICY = "tests/evaluation/test_metrics.py", "tests/tasks/test_policy.py"
BY_SCORES, BY_FINGERS = "tests/evaluation/test_geometry.py", "tests/body/test_fingers.py"
BY_CONTOUR = "tests/body/test_contour_fit.py"
BY_INGEST, BY_STORE = "tests/capture/test_ingest.py", "tests/tasks/test_store.py"
BY_BAD_INPUT = "tests/capture/test_bad_input.py"
BY_ANTIALIASING, BY_CORRECTIVES = "tests/avatar/test_antialiasing.py", "tests/asset/test_correctives.py"
BY_PLATE, BY_REGISTRATION = "tests/asset/test_plate.py", "tests/asset/test_registration.py"
BY_FIELD_COLOURS = "tests/asset/test_field_colours.py"
BY_PHOTOGRAPHS = "tests/asset/test_photographs.py"
BY_LIGHT, BY_SHADING = "tests/asset/test_light.py", "tests/asset/test_shading.py"
BY_ALBEDO, BY_DOME = "tests/asset/test_albedo.py", "tests/asset/test_dome.py"
BY_VIEWER, BY_PICTURES = "tests/asset/test_viewer.py", "tests/asset/test_pictures.py"
BY_GARBAGE, BY_ARCHIVE = "tests/tasks/test_garbage.py", "tests/tasks/test_archive.py"
BY_BUCKET, BY_LEASE, BY_SHARED = (f"tests/tasks/test_{name}.py" for name in ("bucket", "lease", "shared"))
BY_LIMITS = "tests/tasks/test_limits.py"
BY_TIMING, BY_GLB = "tests/capture/test_timing.py", "tests/asset/test_glb.py"


@dataclass(frozen=True)
class Fault:
    """What is put into a file in place of an exact text, and the tests that should see it."""

    name: str
    file: str
    text: str
    instead: str
    tests: str


FAULTS = (
    # what F and DH of the published method are asked, and the units of what they answer
    Fault("paper-view-noise", PAPER, "else rays.directions + draws.view", "else rays.directions", BY_PAPER),
    Fault("paper-root-noise", CONDITIONS, "root=self.root + root", "root=self.root", BY_CONDITIONS),
    Fault("paper-theta-noise", CONDITIONS, "pose=self.pose + pose", "pose=self.pose", BY_CONDITIONS),
    Fault("paper-density-unit", PAPER, "+ 1e10) / self.settings.scene_m", "+ 1e10)", BY_PAPER),
    Fault("paper-eikonal-unit", PAPER, "(d_in + residual_in).sum() * self.settings.scene_m",
          "(d_in + residual_in).sum()", BY_PAPER),
    Fault("paper-outside-distance", PAPER, "OUTSIDE_DISTANCE = 1.0", "OUTSIDE_DISTANCE = 0.3", BY_PAPER),
    Fault("paper-pose-outside", PAPER, "torch.zeros_like(conditions.pose[row])", "conditions.pose[row]", BY_PAPER),
    Fault("paper-root-outside", PAPER, "torch.zeros_like(root_inputs[row])", "root_inputs[row]", BY_PAPER),
    Fault("paper-importance", PAPER,
          "sample_pdf(coarse, near, far, weights_from_alpha(coarse_samples.alpha), draws.fine)",
          "stratified(near, far, draws.fine)", BY_PAPER),
    Fault("paper-fine-cells", PAPER, "(middles[:, 1:] + middles[:, :-1]) / 2", "middles[:, 1:]", BY_PAPER),
    Fault("paper-fine-gradient", PAPER, "with torch.no_grad():", "with torch.enable_grad():", BY_PAPER),
    Fault("paper-centre", PAPER, "(points_m - self.centre_m) / self", "points_m / self", BY_PAPER),
    Fault("paper-residual-input-unit", PAPER,
          "scaled = torch.cat([described.s, described.d[:, None]], -1) / self.settings.scene_m",
          "scaled = torch.cat([described.s, described.d[:, None]], -1)", BY_PAPER),
    Fault("paper-distance-unit", PAPER, "d_in = described.d / self.settings.scene_m", "d_in = described.d", BY_PAPER),
    Fault("paper-frame", PAPER, "conditions.pose[row[pick]])", "conditions.pose[0 * row[pick]])", BY_PAPER),
    Fault("paper-static-theta", PAPER, "self.radiance(scaled, conditions.pose[row, :0],",
          "self.radiance(scaled, conditions.pose[row],", BY_PAPER),
    Fault("paper-box", PAPER, "in_box=inside.float()", "in_box=torch.ones_like(d)", BY_PAPER),
    Fault("paper-surface-unit", PAPER, "self.settings.scene_m * self._residual(", "self._residual(", BY_PAPER),
    Fault("paper-root-unit", CONDITIONS, "root[:, :3, 3:] / scene_m", "root[:, :3, 3:]", BY_CONDITIONS),
    Fault("paper-octaves", MLP, "OCTAVES = 8", "OCTAVES = 6", BY_MLP),
    Fault("paper-residual-octaves", MLP, "OCTAVES = 1\n", "OCTAVES = 2\n", BY_MLP),
    Fault("paper-trunk-pose", MLP, "pose], -1))\n        density", "0 * pose], -1))\n        density", BY_MLP),
    Fault("paper-residual-pose", MLP, "pose], -1))\n        return self.residual",
          "0 * pose], -1))\n        return self.residual", BY_MLP),
    Fault("bf16-padding-in-front", MLP, "nn.functional.pad(x, (0, -x.shape[-1] % MULTIPLE))",
          "nn.functional.pad(x, (-x.shape[-1] % MULTIPLE, 0))", BY_MLP),
    Fault("encoding-octaves", ENCODING, "2.0 ** torch.arange(octaves", "2.0 * torch.arange(octaves", BY_ENCODING),
    # from samples to pixels
    Fault("occupancy-sign", COMPOSITING, "torch.sigmoid(-sharpness", "torch.sigmoid(sharpness", BY_COMPOSITING),
    Fault("weights-shifted", COMPOSITING, "1 - alpha[:, :-1]], 1)", "1 - alpha[:, 1:]], 1)", BY_COMPOSITING),
    Fault("weights-unshaded", COMPOSITING, "alpha * before.cumprod(1)", "alpha * before", BY_COMPOSITING),
    Fault("surface-order", COMPOSITING, "log_phi[:, 1:] - log_phi[:, :-1]", "log_phi[:, :-1] - log_phi[:, 1:]",
          BY_COMPOSITING),
    # the losses
    Fault("reconstruction-weight", LOSSES, "(target.weight * (target.colour", "((target.colour", BY_LOSSES),
    Fault("mask-swapped", LOSSES, "target.person * error", "(1 - target.person) * error", BY_LOSSES),
    Fault("mask-box", LOSSES, "pixel_colour(samples.in_box * samples.alpha, samples)",
          "pixel_colour(samples.alpha, samples)", BY_LOSSES),
    Fault("blend-eta", LOSSES, "eta * (1 - target.person)", "(1 - target.person)", BY_LOSSES),
    Fault("blend-outside", LOSSES, " + (1 - samples.in_box) * samples.alpha", "", BY_LOSSES),
    Fault("paper-box-samples", PAPER, "stratified(entry, leave, ", "stratified(near, far, ", BY_PAPER),
    Fault("paper-start", MLP, "        self.trunk.init_kaiming()\n", "", BY_MLP),
    Fault("paper-view-octaves", MLP, "encoding(view, self", "encoding(0 * view, self", BY_MLP),
    Fault("geometry-moves-the-surface", LOSSES, "occupied.detach()", "occupied", BY_LOSSES),
    Fault("geometry-roles", LOSSES, 'if roles == "print"', 'if roles != "print"', BY_LOSSES),
    Fault("geometry-sign", LOSSES, "(samples.density - threshold)", "(threshold - samples.density)", BY_LOSSES),
    Fault("segmentation-sign", LOSSES, "logit = -sharpness", "logit = sharpness", BY_LOSSES),
    Fault("segmentation-mean", LOSSES, "distance.amin(1)", "distance.mean(1)", BY_LOSSES),
    Fault("eikonal-slope", LOSSES, "(samples.gradient_norm - 1)", "samples.gradient_norm", BY_LOSSES),
    Fault("residual-sign", LOSSES, "relu(samples.residual)", "relu(-samples.residual)", BY_LOSSES),
    Fault("increment-sum", LOSSES, "move_m], 1)).mean()", "move_m], 1)).sum()", BY_LOSSES),
    Fault("fog-of-the-person", LOSSES, "(1 - target.person) * box_colour", "target.person * box_colour", BY_LOSSES),
    Fault("fog-everywhere", LOSSES, "box_colour(samples).sum(1)", "pixel_colour(samples.alpha, samples).sum(1)",
          BY_LOSSES),
    Fault("floor-above", LOSSES, "(height_m < 0)", "(height_m > 0)", BY_LOSSES),
    Fault("floor-outside", LOSSES, "relu(-d_hat)", "relu(d_hat)", BY_LOSSES),
    Fault("floor-sideways", STEP, "[..., self.ground_axis])", "[..., 0])", BY_STEP),
    Fault("increment-forgets", BODIES, "self.move_m + self.absorbed_move_m", "self.move_m", BY_LOSSES),
    Fault("sole-ignored", CONTOUR, "(vertices_m, ground, sole_m))", "(vertices_m, ground, 0.0))",
          "tests/body/test_fit.py"),
    Fault("fit-clothed", STEP, "segmentation(samples.d, target", "segmentation(samples.d_hat, target", BY_STEP),
    Fault("segmentation-naked", STEP, "segmentation(samples.d_hat, target", "segmentation(samples.d, target", BY_STEP),
    # what a step aims at
    Fault("fast-edge-pixels", STEP, "(~rays.edge).float()), draws", "everywhere), draws", BY_STEP),
    Fault("plate-ignored", STEP, "if rays.plate is not None:", "if False:", BY_STEP),
    Fault("plate-at-outline", STEP, "(rays.person | rays.edge)[:, None]", "rays.person[:, None]", BY_STEP),
    Fault("background-black", STEP, "rays.colour, draws.background)", "rays.colour, 0 * draws.background)", BY_STEP),
    # what the networks of `fast` are asked
    Fault("fast-colour-normal", CANONICAL, "positional_encoding(normal, 1)", "positional_encoding(0 * normal, 1)",
          BY_CANONICAL),
    Fault("fast-body-normal", FAST, "outward + (found[1:] - found[0]).T / GRADIENT_STEP_M", "outward", BY_RAY),
    Fault("fast-normal-untaught", FAST, "bodies.turn(gradient, row", "bodies.turn(gradient.detach(), row", BY_RAY),
    Fault("fast-normal-unturned", BODIES, "(linear * directions[:, None]).sum(-1)", "directions", BY_RAY),
    Fault("plates-hidden", "hnerf/training/plates.py", "cv2.dilate(mask, disc) > 0", "mask > 0",
          "tests/training/test_plates.py"),
    Fault("plates-known", "hnerf/training/gather.py", "plates[c].known | ~edge", "plates[c].known | edge",
          "tests/training/test_pixels.py"),
    Fault("fast-pose-code", CANONICAL, "code.index_select(0, row)", "0 * code.index_select(0, row)", BY_CANONICAL),
    Fault("fast-residual-unit", CANONICAL, "self.unit_m * last(", "last(", BY_CANONICAL),
    Fault("fast-frame", FAST, "self._residual(described, pose, row).view_as(d)",
          "self._residual(described, pose, 0 * row).view_as(d)", BY_RAY),
    Fault("sparse-grids-slope", SPARSE, "(2.0 * float(j) - 1.0)", "1.0", BY_SPARSE),
    Fault("sparse-grids-missing", SPARSE, "                    if left >= 0:\n                        total",
          "                    if left >= 1:\n                        total", BY_SPARSE),
    Fault("correction-lever", PULL, "part * wp.cross(points[i], g)", "part * wp.cross(g, points[i])", BY_PULL),
    Fault("shell-inside", SHELL, "inner + SLACK", "outer + SLACK", BY_SHELL),
    Fault("beside-distance", BODIES, "found.sign * distance + (normal * moved).sum(-1)", "found.sign * distance",
          BY_DESCRIPTOR),
    Fault("fast-eikonal-inside", FAST, " * skin.d[pick].detach().sign()[:, None]", "", BY_RAY),
    Fault("fast-difference-step", FAST, "GRADIENT_STEP_M = 0.005", "GRADIENT_STEP_M = 0.03", BY_RAY),
    Fault("fast-eikonal-body", FAST, "y = y.detach() + GRADIENT_STEP_M", "y = y + GRADIENT_STEP_M", BY_RAY),
    Fault("fast-elastic-unit", FAST, "(moved / ELASTIC_M)", "moved", BY_RAY),
    Fault("fast-colour-place", FAST, "on_surface, weights = move_to_surface(described, d_hat),",
          "on_surface, weights = described,", BY_RAY),
    Fault("fast-core", FAST, "torch.where(core[hit, None], 1.0, alpha_dot[:, -1:])", "alpha_dot[:, -1:]", BY_FAST),
    Fault("fast-tighten-sides", FAST, "side * described.d[seen]", "-side * described.d[seen]", BY_TIGHTEN),
    Fault("fast-tighten-poses", FAST, "seen |= described.near", "seen = described.near", BY_TIGHTEN),
    # what the trainer hands to a step
    Fault("trainer-noise", TRAINER, "self.scene.with_noise(s.noise, self.generator)", "self.scene",
          BY_TRAINER),
    Fault("trainer-view-noise", TRAINER, "samples, s.noise, self.generator)", "samples, 0.0, self.generator)",
          BY_TRAINER),
    Fault("exposure-gains", TRAINER, "visible_pixels, self.gains, out", "visible_pixels, {}, out", BY_TRAINER),
    Fault("exposure-inverse", GATHER, "shown / np.array(gain", "shown * np.array(gain", BY_EXPOSURE),
    Fault("trainer-novel-frames", TRAINER, "rows = self.train_rows if self.step",
          "rows = torch.cat([self.train_rows, self.novel_rows]) if self.step", BY_TRAINER),
    Fault("trainer-field-goes-on", TRAINER, "self.field.requires_grad_(False)", "pass", BY_TRAINER),
    Fault("trainer-poses-go-on", TRAINER, "pose.grad[self.train_rows] = 0.0", "pass", BY_TRAINER),
    Fault("trainer-decay", TRAINER, "FINAL_LEARNING_RATE ** self._progress() * ", "", BY_TRAINER),
    Fault("ground-unknown", TRAINER, "settings, ground_axis)", "settings)", BY_TRAINER),
    Fault("one-camera-drifts", TRAINER, "if self.only_centre_m is not None:", "if False:", BY_TRAINER),
    Fault("one-camera-farthest", TUNED_POSES, "tuned.norm(dim=-1).mean()", "tuned.norm(dim=-1).max()", BY_TRAINER),
    Fault("one-camera-all", TUNED_POSES, "root[rows, :3, 3] = centre", "root[-1] = root[0]; root[rows, :3, 3] = centre",
          BY_TRAINER),
    Fault("trainer-tighten", TRAINER, "if self.step <= self.field_steps:", "if False:", BY_TRAINER),
    Fault("checkpoint-optimizer", TRAINER, 'self.optimizer.load_state_dict(state["optimizer"])', "pass",
          "tests/training/test_trainer.py"),
    Fault("exposure-mean", EXPOSURE, "weight * np.median(found, 0)", "weight * np.mean(found, 0)", BY_EXPOSURE),
    Fault("exposure-clipped", EXPOSURE, " & (levels[seen] < MAX_LEVEL).all(1)", "", BY_EXPOSURE),
    Fault("exposure-pair", EXPOSURE, "= (-weight, weight)", "= (weight, weight)", BY_EXPOSURE),
    # cameras, triangulation, meshes
    Fault("camera-half-pixel", CAMERA, "[0, sy, top_px + (sy - 1) / 2]", "[0, sy, top_px]", BY_CAMERA),
    Fault("camera-rays-transposed", CAMERA, "np.linalg.inv(self.K).T @ self.R", "np.linalg.inv(self.K).T @ self.R.T",
          BY_CAMERA),
    Fault("triangulation-depth", TRIANGULATION, "@ points_m.T + projections[:, 2, 3:])",
          "@ points_m.T - projections[:, 2, 3:])", BY_TRIANGULATION),
    Fault("triangulation-outlier", TRIANGULATION, "(confidence > 0) & (distances < inlier_px)", "confidence > 0",
          BY_TRIANGULATION),
    Fault("mesh-side", QUERIES, "query.sign < 0.0", "query.sign > 0.0", "tests/evaluation/test_geometry.py"),
    Fault("silhouette-orientation", SILHOUETTE, "or wp.max(wp.max(e, g), h) <= wp.float64(0.0)", "",
          "tests/geometry/test_silhouette.py"),
    Fault("boards-transposed", BOARDS, "R = b[0] @ a[0].T", "R = b[0] @ a[0]",
          "tests/calibration/boards/test_calibrate.py"),
    Fault("bundle-transposed", BUNDLE, "old.R.T @ new.R for", "new.R.T @ old.R for",
          "tests/calibration/test_bundle.py"),
    Fault("turning-jacobian", ARTICULATION, "+ first * cross + second", "- first * cross + second",
          "tests/body/test_articulation.py"),
    Fault("silhouette-wide", SILHOUETTE, "floor(high[0])), image.shape[1]", "floor(high[0])), image.shape[0]",
          "tests/geometry/test_silhouette.py"),
    Fault("triangulation-surest-pair", TRIANGULATION, "confidence * np.nan_to_num(dist",
          "np.nan_to_num(dist", BY_TRIANGULATION),
    Fault("reach-behind", REACH, "xy, depth_m = xy[depth_m > 0], depth_m[depth_m > 0]",
          "depth_m = depth_m[depth_m > 0]", "tests/training/test_pixels.py"),
    # the fit of the body
    Fault("ground-offsets", "hnerf/body/ground.py", " + pose.offsets_m[FEET, 2]", "", "tests/body/test_ground.py"),
    Fault("person-of-any-distance", "hnerf/detection/merge.py", "if distance <= nearest:", "if True:",
          "tests/detection/test_merge.py"),
    Fault("ground-anywhere", "hnerf/body/ground.py", "low <= stature_m <= high", "True", "tests/body/test_ground.py"),
    Fault("pose-alone", CANONICAL, "first.bias + of_code @ code[0]", "first.bias", BY_CANONICAL),
    Fault("ghosts-of-limbs", FAST, "arange(len(skips), device=skips.device) + skips",
          "arange(len(skips), device=skips.device)", BY_FAST),
    Fault("limbs-begin-inside", FAST, ".clamp(max=1).maximum(back)", ".clamp(0, 1)", BY_FAST),
    Fault("fingers-thin", FAST, "torch.where(closest, deeper_m, 0.0)", "0.0 * deeper_m", BY_FAST),
    Fault("little-weight-black", FAST, "* share.view(-1, 1, 1)", "", BY_FAST),
    Fault("fingers-bent-at-rest", FINGERS, "deg2rad(relaxed) - bend", "deg2rad(relaxed) + bend", BY_FINGERS),
    Fault("fingers-across-gaps", FINGERS, "np.arange(ends[-1]), ends - 1)", "np.arange(ends[-1]), ends[-1:] - 1)",
          BY_FINGERS),
    Fault("hands-seen-once", "hnerf/body/hand_points.py", "seen_twice(hands[..., 0, 2])[..., None]", "1",
          "tests/body/test_hand_points.py"),
    Fault("fingers-usual", FINGERS, "hand[seen if seen.any() else ~seen]", "hand", BY_FINGERS),
    Fault("forearms-twist", POSTURES, "axes[forearms, 1]", "axes[forearms, 0]", BY_POSTURES),
    Fault("postures-by-group", POSTURES, "slice(first + group * size, first + (group + 1) * size)",
          "slice(first, first + size)", BY_POSTURES),
    Fault("contour-cells", CONTOUR, "np.unique(row * width + column", "np.unique(row + column", BY_CONTOUR),
    Fault("contour-shape", CONTOUR, "border[frame, :, shape] += weighted_j", "border[frame, :, shape] += j",
          BY_CONTOUR),
    Fault("cloth-aligned", "hnerf/body/clothed_fit.py", "keep = aligned & (", "keep = (",
          "tests/body/test_clothed_fit.py"),
    # what comes in
    Fault("colmap-pixel-centre", COLMAP, "cx - PIXEL_CENTRE", "cx", BY_FILES),
    Fault("colmap-distortion", COLMAP, "distortion=values[4:9]", "distortion=values[5:9]", BY_FILES),
    Fault("zjumocap-unit", ZJUMOCAP, "METRES_PER_UNIT = 1e-3", "METRES_PER_UNIT = 1.0",
          "tests/capture/formats/test_zjumocap.py"),
    Fault("normalise-keypoints", NORMALISE, "* scale + (scale - 1) / 2", "* scale", BY_INGEST),
    Fault("lens-distortion", NORMALISE, "if np.any(lens.distortion):", "if np.any(lens.distortion[2:]):", BY_INGEST),
    Fault("frames-split", MANIFEST, "train = recorded[: len(recorded) - len(novel)]",
          "train = recorded[: len(recorded) - len(novel) + 1]", "tests/capture/formats/test_pose2sim.py"),
    Fault("capture-link", SAFE_IO, "if stat.S_ISLNK(mode):", "if False:", BY_BAD_INPUT),
    Fault("capture-pipe", SAFE_IO, "if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):", "if False:", BY_BAD_INPUT),
    Fault("yaml-aliases", "hnerf/strict_yaml.py", "if self.check_event(yaml.AliasEvent):", "if False:",
          "tests/test_strict_yaml.py"),
    Fault("toml-deep-keys", SAFE_IO, "if _DEEP_KEY.search(text):", "if False:", BY_BAD_INPUT),
    Fault("npz-unpacked-size", SAFE_IO, "if unpacked_bytes > max_bytes:", "if False:", "tests/render/test_motion.py"),
    Fault("smpl-limits", "hnerf/capture/given_poses.py", "if not (np.abs(values) <= limit).all():", "if False:",
          "tests/capture/formats/test_zjumocap.py"),
    Fault("sides-exchanged", "hnerf/calibration/doubts.py", "np.cross(up, forward)", "np.cross(forward, up)",
          "tests/calibration/test_doubts.py"),
    Fault("prior-mirrored", "hnerf/segmentation/prior.py", "where(depth_m[..., None] <= 0,", "where(False,",
          "tests/segmentation/test_prior.py"),
    Fault("calibration-digits", "hnerf/calibration/report.py", "round(tree, DECIMALS)", "round(tree, 15)",
          "tests/calibration/test_check.py"),
    Fault("nearest-frame", TIMING, "offset_frames / step + 0.5", "offset_frames / step", BY_TIMING),
    # what goes out
    Fault("stage-axis", "hnerf/geometry/axes.py", "[0, 0, 1], [0, -1, 0]])", "[0, 0, 1], [0, 1, 0]])",
          "tests/asset/test_staging.py"),
    Fault("root-heading", MOTIONS, "2 * np.arctan2(y, w)", "np.arctan2(y, w)", BY_MOTIONS),
    Fault("slerp-share", MOTIONS, "np.repeat(share, joints)", "np.tile(share, joints)", BY_PACKAGE),
    Fault("resampled-start", MOTIONS, "np.ceil(first - 1e-6)", "np.floor(first)", BY_MOTIONS),
    Fault("bones-front", SKELETON, "UP if _points_to_front(name) else FRONT", "FRONT if _points_to_front(name) else UP",
          "tests/asset/test_skeleton.py"),
    Fault("game-toes", SKELETON, 'toe = f"middle_toe_01_', 'toe = f"no_toe_01_', "tests/asset/test_skeleton.py"),
    Fault("folded-weights", SKINNING, "joints = taken_by[self.joints]", "joints = self.joints", BY_SKINNING),
    Fault("game-negative", SKINNING, "(found >= 0).all(1) & ", "", BY_SKINNING),
    Fault("one-eyeball", RIGS, "not all(points.any() for", "not any(points.any() for", BY_SKINNING),
    Fault("package-twice-scaled", PACKAGE, "_set_rate(layer, part.fps)", "_set_rate(layer, 10.0)", BY_PACKAGE),
    Fault("package-extents", PACKAGE, "for boxes in avatar.extents_m.values()", "for boxes in ()", BY_PACKAGE),
    Fault("correctives-sign", CORRECTIVES, "np.vstack([shapes_m, -shapes_m", "np.vstack([shapes_m, shapes_m",
          BY_CORRECTIVES),
    Fault("bvh-count", BVH, "if frames * max(width, 3 * len(joints)) > MAX_NUMBERS:", "if False:", BY_BVH),
    Fault("bvh-order", BVH, "Rotation.from_euler(order, angles", "Rotation.from_euler(order.lower(), angles", BY_BVH),
    Fault("bvh-rest", BVH_MOTION, "align_vectors(theirs[None], ours[None])", "align_vectors(ours[None], theirs[None])",
          BY_BVH_MOTION),
    Fault("bvh-scale", BVH_MOTION, "scale * hips -", "hips -", BY_BVH_MOTION),
    Fault("glb-inverse-bind", GLB, "np.linalg.inv(rig.skeleton.bind).swap", "rig.skeleton.bind.swap", BY_GLB),
    Fault("viewer-camera", "hnerf/asset/viewer.py", "np.diag([1, -1, -1])", "np.eye(3)", BY_VIEWER),
    Fault("texture-upright", "hnerf/asset/pictures.py", "(width_px, -height_px)", "(width_px, height_px)", BY_PICTURES),
    Fault("antialiasing-offsets", ANTIALIASING, "QUARTERS_PX = 0.25 *", "QUARTERS_PX = 0.0 *", BY_ANTIALIASING),
    Fault("antialiasing-depth", ANTIALIASING, "image[y, x, :4] = render_beside(mixed, QUARTERS_PX).mean(0)[:, :4]",
          "image[y, x] = render_beside(mixed, QUARTERS_PX).mean(0)", BY_ANTIALIASING),
    Fault("photographs-cosine", PHOTOGRAPHS, "cosine**COSINE_POWER", "cosine", BY_PHOTOGRAPHS),
    Fault("photographs-blurred", PHOTOGRAPHS, "colours + change / weight", "colours", BY_PHOTOGRAPHS),
    Fault("photographs-pixel", PHOTOGRAPHS, "y * camera.width_px + x", "x * camera.width_px + y", BY_PHOTOGRAPHS),
    Fault("photographs-hidden", PHOTOGRAPHS, "(distance_m < seen_m[row", "(distance_m > -seen_m[row", BY_PHOTOGRAPHS),
    Fault("light-reflected", LIGHT, "[1, 2 / 3, 1 / 4]", "[1, 2 / 3, 1 / 2]", BY_LIGHT),
    Fault("light-ridge", LIGHT, "RIDGE = 1e-5", "RIDGE = 1e-1", BY_LIGHT),
    Fault("light-outliers", LIGHT, "(error / OUTLIER)", "(0 * error)", BY_LIGHT),
    Fault("light-axes", LIGHT, "directions @ rotation.T", "directions @ rotation", BY_LIGHT),
    Fault("light-scale", LIGHT, "coefficients / (basis @ coefficients).max()", "coefficients", BY_LIGHT),
    Fault("shading-linear", SHADING, "to_linear(sampled(", "abs(sampled(", BY_SHADING),
    Fault("shading-hidden", SHADING, "- HIDDEN_M", "- 10", BY_SHADING),
    Fault("shading-outline", SHADING, "np.ptp(around_m, 0) < EDGE_SLOPE", "0 < EDGE_SLOPE", BY_SHADING),
    Fault("albedo-irradiance", ALBEDO, "+= counts * irradiance", "+= counts", BY_ALBEDO),
    Fault("albedo-vote", ALBEDO, "take(seen.index, 0) * irradiance", "take(seen.index, 0)", BY_ALBEDO),
    Fault("albedo-field", ALBEDO, "(seen / field_irradiance[:, None])", "(seen)", BY_ALBEDO),
    Fault("dome-mirrored", DOME, "np.pi * (1 - (np.arange(2 ", "np.pi * (-1 + (np.arange(2 ", BY_DOME),
    Fault("look-light-in-world", "hnerf/asset/staging.py", "albedo.light.turned(world)", "albedo.light", BY_PACKAGE),
    Fault("glb-looks", GLB, '{"material": k, "variants": [k]}', '{"material": 0, "variants": [k]}', BY_GLB),
    Fault("photographs-outline", PHOTOGRAPHS, "inside & ~outline[row, column]", "inside", BY_PHOTOGRAPHS),
    Fault("photographs-behind", PHOTOGRAPHS, " & (depth_m > 0)", "", BY_PHOTOGRAPHS),
    Fault("shading-behind", SHADING, " & (ahead_m > 0)", "", BY_SHADING),
    Fault("photographs-slope", PHOTOGRAPHS, "TOLERANCE_M / cosine.clip(0.1)", "TOLERANCE_M", BY_PHOTOGRAPHS),
    Fault("photographs-gain", PHOTOGRAPHS, "pixels_px) / gain", "pixels_px) * gain", BY_PHOTOGRAPHS),
    Fault("correctives-turn", CORRECTIVES, "solve(turn, surface_m", "solve(turn.mT, surface_m", BY_CORRECTIVES),
    Fault("plate-gaps", PLATE, "self.bending + self.gaps", "self.bending", BY_PLATE),
    Fault("plate-mass", PLATE, "diags_array(1 / area_m2)", "diags_array(1e9 * area_m2)", BY_PLATE),
    Fault("plate-barycentric", PLATE, "-hits.barycentric[vertex]", "-hits.barycentric[vertex][:, ::-1]", BY_PLATE),
    Fault("registration-hidden", REGISTRATION, "trust[body.hidden] = 0", "trust[body.hidden] = 1", BY_REGISTRATION),
    Fault("registration-normals", REGISTRATION, "closest_m, aligned /", "closest_m, 1 /", BY_REGISTRATION),
    Fault("registration-loosen", REGISTRATION, "= -LOOSEN_M *", "= LOOSEN_M *", BY_REGISTRATION),
    Fault("quads-order", "hnerf/asset/quads.py", "for k in (1, 2, 0)", "for k in (2, 1, 0)",
          "tests/asset/test_quads.py"),
    Fault("eye-size", "hnerf/body/base_mesh.py", "scale = np.sqrt(", "scale = 2 * np.sqrt(",
          "tests/body/test_base_mesh.py"),
    Fault("regions-limit", "hnerf/asset/regions.py", "1e3 * surface.closest", "surface.closest",
          "tests/asset/test_regions.py"),
    Fault("colours-off-surface", FIELD_COLOURS, "<= OFF_SURFACE_M", "<= 1.0", BY_FIELD_COLOURS),
    Fault("colours-median", FIELD_COLOURS, "for k in (seen - 1, seen)", "for k in (seen, seen)", BY_FIELD_COLOURS),
    Fault("surface-step", SURFACE, "vertices_m - step_to_surface(", "vertices_m + step_to_surface(", BY_CORRECTIVES),
    Fault("usd-shape-weights", USD, "array(motion.shape_weights[k]", "array(1 - motion.shape_weights[k]", BY_PACKAGE),
    Fault("splats-triangle", SPLATS, "root = np.sqrt(", "root = (", BY_SPLATS),
    Fault("splats-spread", SPLATS, "SPREAD = 1.4", "SPREAD = 1.3", BY_SPLATS),
    Fault("splats-logit", "hnerf/asset/splat_ply.py", "np.log(OPACITY / (1 - OPACITY))", "OPACITY", BY_SPLATS),
    Fault("splats-quaternion", "hnerf/asset/splat_prim.py", "[:, [1, 2, 3, 0]]", "[:, [0, 1, 2, 3]]", BY_SPLATS),
    Fault("splats-order", SPLAT_RENDERING, "np.argsort(depth_m,", "np.argsort(-depth_m,", BY_SPLAT_RENDERING),
    Fault("splats-hidden", SPLAT_RENDERING, "through[pixel] * np.exp(before)", "np.exp(before)", BY_SPLAT_RENDERING),
    Fault("splats-slope", SPLAT_RENDERING, "K[:2] - pixels_px[:, :, None] *", "K[:2] - 0 *", BY_SPLAT_RENDERING),
    Fault("glb-time", GLB, "(motion.codes - motion.codes[0]) / motion.fps", "motion.codes / motion.fps", BY_GLB),
    Fault("usd-quaternion", USD, "Gf.Quatf(w, x, y, z)", "Gf.Quatf(x, y, z, w)", BY_PACKAGE),
    Fault("usd-camera-axis", USD, "np.diag([1, -1, -1])", "np.diag([1, 1, -1])", BY_USD),
    Fault("report-unescaped", REPORT, "autoescape=True", "autoescape=False", "tests/evaluation/test_evaluate.py"),
    Fault("surface-one-way", SCORES, "distance_p.mean() + distance_t.mean()", "distance_p.mean() + distance_p.mean()",
          BY_SCORES),
    Fault("surface-closed-truth", SCORES, "bool(predicted.is_watertight)", "bool(truth.is_watertight)", BY_SCORES),
    Fault("ssim-sample-covariance", METRICS, "use_sample_covariance=False", "use_sample_covariance=True", BY_METRICS),
    Fault("psnr-amplitude", METRICS, "-10 * np.log10(", "-20 * np.log10(", BY_METRICS),
    # what is done again, and what is not
    Fault("retry-lost-worker", POLICY, "OSError | LostWorkerError)", "OSError)", BY_POLICY),
    Fault("retry-permanent", POLICY, " and not is_permanent(error)", "", BY_POLICY),
    Fault("key-ignores-version", POLICY, '"version": version, ', "", BY_POLICY),
    Fault("store-lock-link", STORE, "flags | os.O_NOFOLLOW", "flags", BY_STORE),
    Fault("store-planted-links", STORE, "for path in partial.rglob(\"*\"):", "for path in list[Path]():", BY_STORE),
    Fault("ledger-key", "tasks/ledger.py", "lost.read_text() if lost.exists() else ''", "''",
          "tests/tasks/test_ledger.py"),
    Fault("ledger-empty-note", "tasks/ledger.py", 'or "none")', 'or "")', "tests/tasks/test_ledger.py"),
    Fault("store-bad-input", STORE, "if not resumable or isinstance(error, InputError)", "if not resumable", BY_STORE),
    Fault("checkpoint-damage", "hnerf/training/checkpoint.py", "archive.testzip()", "None",
          "tests/training/test_trainer.py"),
    Fault("checkpoint-key", "hnerf/training/checkpoint.py", 'or state.get("key") != key', "",
          "tests/training/test_trainer.py"),
    Fault("store-damage", STORE, " or sha256_of(path) != file.sha256", "", BY_STORE),
    # order in the store, and time limits
    Fault("gc-inputs", INVENTORY, "waiting += self.stored[name].artifact.inputs", "waiting += ()", BY_GARBAGE),
    Fault("gc-use", "tasks/garbage.py", "if aside.stat().st_mtime != garbage.used_s:", "if False:", BY_GARBAGE),
    Fault("gc-pinned", INVENTORY, "roots = pinned(self.store.root)", "roots = set[str]()", BY_GARBAGE),
    Fault("gc-lock", STORE, "if not _is_at(path, lock.fileno()):", "if False:", BY_GARBAGE),
    Fault("archive-path", PACKED, 'or ".." in parts or', "or", BY_ARCHIVE),
    Fault("archive-type", PACKED, "member.type != tarfile.REGTYPE or", "", BY_ARCHIVE),
    Fault("archive-digest", PACKED, "if seen.hexdigest() != digest:", "if False:", BY_ARCHIVE),
    Fault("archive-manifest", PACKED, " or manifest_name(text) != name", "", BY_SHARED),
    Fault("note-once", BUCKET, '(name), "xb")', '(name), "wb")', BY_BUCKET),
    Fault("lease-renewed", LEASE, "if now != text:", "if False:", BY_LEASE),
    Fault("lease-given-up", LEASE, "if text != FREE and", "if", BY_LEASE),
    Fault("shared-another", SHARED, "if list(contents.artifacts) != [name]:", "if False:", BY_SHARED),
    Fault("shared-later", SHARED, "if bucket.size_bytes(_object(artifact.name)) is None:", "if False:", BY_SHARED),
    Fault("limit-progress", LIMITS, "            arm()\n\n    def end", "            pass\n\n    def end", BY_LIMITS),
    Fault("limit-end", LIMITS, "exit=True", "exit=False", BY_LIMITS),
)  # fmt: skip


@dataclass(frozen=True)
class Verdict:
    """Of a fault: the first test that turned red, or None; how long it took."""

    fault: Fault
    red: str | None
    seconds: float

    def __str__(self) -> str:
        found = f"caught by {self.red}" if self.red else f"MISSED by {self.fault.tests}"
        return f"{self.fault.name:26} {found} ({self.seconds:.0f} s)"


def with_fault(fault: Fault, root: Path) -> str:
    """The file's text with the fault in it; ValueError if what it replaces is not found exactly once."""
    text = (root / fault.file).read_text()
    if (times := text.count(fault.text)) != 1:
        raise ValueError(f"{fault.name}: found {times} times in {fault.file}, not once: {fault.text!r}")
    return text.replace(fault.text, fault.instead)


@contextmanager
def copied(root: Path) -> Iterator[Path]:
    """A copy of the code and its tests, for as long as it is needed."""
    with tempfile.TemporaryDirectory(prefix="hnerf-faults-") as folder:
        for name in COPIED:
            if (root / name).is_dir():
                shutil.copytree(root / name, Path(folder, name), ignore=shutil.ignore_patterns("__pycache__"))
            elif (root / name).exists():
                shutil.copy(root / name, folder)
        yield Path(folder)


def first_red(folder: Path, tests: list[str]) -> str | None:
    """The first test that fails there, None if all pass; RuntimeError, with what pytest says, if they cannot be run."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run([*PYTEST, *tests], cwd=folder, env=environment, capture_output=True, text=True)
    red = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if done.returncode > 1 or (done.returncode == 1 and not red):
        raise RuntimeError(f"pytest {' '.join(tests)} ends with {done.returncode}:\n{done.stdout[-3000:]}{done.stderr}")
    return red.group(1) if red and done.returncode else None


def judge(fault: Fault, root: Path = ROOT) -> Verdict:
    """Whether the fault's tests see it."""
    began, faulty = time.monotonic(), with_fault(fault, root)
    with copied(root) as folder:
        (folder / fault.file).write_text(faulty)
        red = first_red(folder, [fault.tests])
    return Verdict(fault, red, time.monotonic() - began)


def main() -> int:
    """Judge the faults that are asked for; the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="of faults; all of them unless given")
    parser.add_argument("--at-once", type=int, default=1, help="how many are tried side by side")
    asked = parser.parse_args()
    if unknown := set(asked.names) - {fault.name for fault in FAULTS}:
        parser.error(f"no such fault: {', '.join(sorted(unknown))}; there are {', '.join(f.name for f in FAULTS)}")
    faults = [fault for fault in FAULTS if not asked.names or fault.name in asked.names]
    try:
        for fault in faults:
            with_fault(fault, ROOT)
        with copied(ROOT) as folder:
            if red := first_red(folder, sorted({fault.tests for fault in faults})):
                raise ValueError(f"{red} fails without any fault")
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    missed = 0
    with ThreadPoolExecutor(asked.at_once) as side_by_side:
        for verdict in side_by_side.map(judge, faults):
            print(verdict, flush=True)
            missed += verdict.red is None
    print(f"{len(faults) - missed} of {len(faults)} caught")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
