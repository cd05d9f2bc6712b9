"""Insert faults into a copy of the code, one at a time, and check that tests fail:

    python tests/faults.py [--at-once 2] [NAME ...]

A fault replaces an exact text in a file. All faults are tried unless some are named. The checkout is not changed. The
exit status is 1 if a fault is missed, and 2 if the tests fail without any fault or a text is not found exactly once.
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
COPIED = ("hnerf", "tasks", "flows", "tests", "configs", "docs", "pyproject.toml")
LIMIT_S = 300.0  # for the tests of one fault, which take seconds; some faults make them wait forever
PYTEST = (sys.executable, "-m", "pytest", "-o", "addopts=", "-x", "-q", "-p", "no:cacheprovider")


@dataclass(frozen=True)
class Fault:
    """A replacement for an exact text in a module, and the module whose tests should catch it: the same module unless
    `seen_by` names another. Modules are paths below hnerf/, or paths that start with tasks/, without `.py`."""

    name: str
    module: str
    text: str
    instead: str
    seen_by: str = ""

    @property
    def file(self) -> str:
        """Return the path of the module."""
        return f"{self.module}.py" if self.module.startswith("tasks/") else f"hnerf/{self.module}.py"

    @property
    def tests(self) -> str:
        """Return the path of the tests."""
        tested = Path("tests", self.seen_by or self.module)
        return str(tested.with_name(f"test_{tested.name}.py"))


FAULTS = (
    # the published method: inputs of its networks F and DH, and units of their outputs
    Fault("paper-view-noise", "fields/paper", "else rays.directions + draws.view", "else rays.directions"),
    Fault("paper-root-noise", "fields/conditions", "root=self.root + root", "root=self.root"),
    Fault("paper-theta-noise", "fields/conditions", "pose=self.pose + pose", "pose=self.pose"),
    Fault("paper-density-unit", "fields/paper", "+ 1e10) / self.settings.scene_m", "+ 1e10)"),
    Fault("paper-eikonal-unit", "fields/paper", "(d_in + residual_in).sum() * self.settings.scene_m",
          "(d_in + residual_in).sum()"),
    Fault("paper-outside-distance", "fields/paper", "OUTSIDE_DISTANCE = 1.0", "OUTSIDE_DISTANCE = 0.3"),
    Fault("paper-pose-outside", "fields/paper", "torch.zeros_like(conditions.pose[row])", "conditions.pose[row]"),
    Fault("paper-root-outside", "fields/paper", "torch.zeros_like(root_inputs[row])", "root_inputs[row]"),
    Fault("paper-importance", "fields/paper",
          "sample_pdf(coarse, near, far, weights_from_alpha(coarse_samples.alpha), draws.fine)",
          "stratified(near, far, draws.fine)"),
    Fault("paper-fine-cells", "fields/paper", "(middles[:, 1:] + middles[:, :-1]) / 2", "middles[:, 1:]"),
    Fault("paper-fine-gradient", "fields/paper", "with torch.no_grad():", "with torch.enable_grad():"),
    Fault("paper-centre", "fields/paper", "(points_m - self.centre_m) / self", "points_m / self"),
    Fault("paper-residual-input-unit", "fields/paper",
          "scaled = torch.cat([described.s, described.d[:, None]], -1) / self.settings.scene_m",
          "scaled = torch.cat([described.s, described.d[:, None]], -1)"),
    Fault("paper-distance-unit", "fields/paper", "d_in = described.d / self.settings.scene_m", "d_in = described.d"),
    Fault("paper-frame", "fields/paper", "conditions.pose[row[pick]])", "conditions.pose[0 * row[pick]])"),
    Fault("paper-static-theta", "fields/paper", "self.radiance(scaled, conditions.pose[row, :0],",
          "self.radiance(scaled, conditions.pose[row],"),
    Fault("paper-box", "fields/paper", "in_box=inside.float()", "in_box=torch.ones_like(d)"),
    Fault("paper-surface-unit", "fields/paper", "self.settings.scene_m * self._residual(", "self._residual("),
    Fault("paper-surface-outside", "fields/paper",
          "torch.maximum(d_hat_m, self.region(bodies, conditions).signed_distance(points_m))", "d_hat_m"),
    Fault("box-missed-at-infinity", "fields/shell", "torch.minimum(torch.minimum(a, b)",
          "torch.maximum(torch.minimum(a, b)"),
    Fault("paper-root-unit", "fields/conditions", "root[:, :3, 3:] / scene_m", "root[:, :3, 3:]"),
    Fault("paper-octaves", "fields/mlp", "OCTAVES = 8", "OCTAVES = 6"),
    Fault("paper-residual-octaves", "fields/mlp", "OCTAVES = 1\n", "OCTAVES = 2\n"),
    Fault("paper-trunk-pose", "fields/mlp", "pose], -1))\n        density", "0 * pose], -1))\n        density"),
    Fault("paper-residual-pose", "fields/mlp", "pose], -1))\n        return self.residual",
          "0 * pose], -1))\n        return self.residual"),
    Fault("bf16-padding-in-front", "fields/mlp", "nn.functional.pad(x, (0, -x.shape[-1] % MULTIPLE))",
          "nn.functional.pad(x, (-x.shape[-1] % MULTIPLE, 0))"),
    Fault("encoding-octaves", "fields/encoding", "2.0 ** torch.arange(octaves", "2.0 * torch.arange(octaves"),
    # from samples to pixels
    Fault("occupancy-sign", "fields/compositing", "torch.sigmoid(-sharpness", "torch.sigmoid(sharpness"),
    Fault("weights-shifted", "fields/compositing", "1 - alpha[:, :-1]], 1)", "1 - alpha[:, 1:]], 1)"),
    Fault("weights-unshaded", "fields/compositing", "alpha * before.cumprod(1)", "alpha * before"),
    Fault("surface-order", "fields/compositing", "log_phi[:, 1:] - log_phi[:, :-1]",
          "log_phi[:, :-1] - log_phi[:, 1:]"),
    # losses
    Fault("reconstruction-weight", "training/losses", "return target.weight * (target", "return (target"),
    Fault("mask-swapped", "training/losses", "target.person * error", "(1 - target.person) * error"),
    Fault("mask-box", "training/losses", "pixel_colour(samples.in_box * samples.alpha, samples, background)",
          "pixel_colour(samples.alpha, samples, background)"),
    Fault("mask-weight", "training/losses", "(target.weight * target.person * error)", "(target.person * error)"),
    Fault("blend-weight", "training/losses", "(target.weight * (target.person + eta", "((target.person + eta"),
    Fault("blend-eta", "training/losses", "eta * (1 - target.person)", "(1 - target.person)"),
    Fault("blend-outside", "training/losses", " + (1 - samples.in_box) * samples.alpha", ""),
    Fault("paper-box-samples", "fields/paper", "stratified(entry, leave, ", "stratified(near, far, "),
    Fault("paper-beyond-the-scene", "fields/paper", "(t.clamp(near, far) for t in box.interval(rays))",
          "box.interval(rays)"),
    Fault("paper-walks-out", "fields/paper", "torch.maximum(self.centre_m + half_m, box.upper_m[rays.frame])",
          "self.centre_m + half_m"),
    Fault("paper-root-origin", "fields/paper", "(conditions.root - centre.flatten())", "conditions.root"),
    Fault("paper-start", "fields/mlp", "        self.trunk.init_kaiming()\n", ""),
    Fault("paper-view-octaves", "fields/mlp", "encoding(view, self", "encoding(0 * view, self"),
    Fault("geometry-moves-the-surface", "training/losses", "samples.alpha_dot.detach()", "samples.alpha_dot"),
    Fault("geometry-roles", "training/losses", 'if roles == "print"', 'if roles != "print"'),
    Fault("geometry-sign", "training/losses", "(samples.density - threshold)", "(threshold - samples.density)"),
    Fault("cross-entropy-clamped", "training/losses", "softplus(logit) - label * logit",
          "softplus(logit.clamp(-14, 14)) - label * logit.clamp(-14, 14)"),
    Fault("segmentation-sign", "training/losses", "_cross_entropy(-sharpness", "_cross_entropy(sharpness"),
    Fault("segmentation-mean", "training/losses", "distance.amin(1)", "distance.mean(1)"),
    Fault("eikonal-slope", "training/losses", "(samples.gradient_norm - 1)", "samples.gradient_norm"),
    Fault("residual-sign", "training/losses", "relu(samples.residual)", "relu(-samples.residual)"),
    Fault("increment-sum", "training/losses", "move_m], 1)).mean()", "move_m], 1)).sum()"),
    Fault("fog-of-the-person", "training/losses", "(1 - target.person) * box_colour", "target.person * box_colour"),
    Fault("fog-everywhere", "training/losses", "box_colour(samples, target.background).sum(1)",
          "pixel_colour(samples.alpha, samples, target.background).sum(1)"),
    Fault("floor-above", "training/losses", "(height_m < 0)", "(height_m > 0)"),
    Fault("floor-outside", "training/losses", "relu(-d_hat)", "relu(d_hat)"),
    Fault("floor-sideways", "training/step", "[..., self.ground_axis])", "[..., 0])"),
    Fault("increment-forgets", "body/canonical", "self.move_m + self.absorbed_move_m", "self.move_m",
          "training/losses"),
    Fault("sole-ignored", "body/contour_fit", "vertices_m, ground, sole_m)]", "vertices_m, ground, 0.0)]", "body/fit"),
    Fault("fit-clothed", "training/step", "segmentation(samples.d, target", "segmentation(samples.d_hat, target"),
    Fault("segmentation-naked", "training/step", "segmentation(samples.d_hat, target",
          "segmentation(samples.d, target"),
    # units of the compared methods' densities
    Fault("box-density-unit", "baselines/box", "append=far_m[:, None]) / self.scale_m", "append=far_m[:, None])",
          "baselines/nerf"),
    Fault("box-surface-unit", "baselines/box", "SURFACE_DENSITY_PER_M * self.scale_m", "SURFACE_DENSITY_PER_M",
          "baselines/nerf"),
    Fault("idr-inside", "baselines/idr", "d - d.detach() - INSIDE_LOGIT / self.gamma", "d - INSIDE_LOGIT / self.gamma"),
    Fault("idr-nearest", "baselines/idr", "hit & (least > 0)", "hit & (least < 0)"),
    Fault("idr-secant", "baselines/idr", "torch.where(outside, middle, start)", "torch.where(outside, start, middle)"),
    Fault("nerfies-undeformed", "baselines/nerfies",
          "self._deform(self.scaled(points).flatten(0, 1), code.flatten(0, 1)).view_as(points)",
          "self.scaled(points)"),
    Fault("nerfies-elastic-of-air", "baselines/nerfies", "weights.sum(1) * elastic_energy(", "elastic_energy("),
    Fault("voxels-level", "baselines/voxels", "self.edge_m * 2**level", "self.edge_m * (level + 1)"),
    Fault("neural-body-frame", "baselines/neural_body", "self.code(conditions)[row]", "self.code(conditions)[0 * row]"),
    Fault("neural-body-sum", "baselines/neural_body",
          "total / torch.cat([voxels.count, voxels.count.new_ones(1)])[:, None]", "total"),
    # targets of a training step
    Fault("fast-edge-pixels", "training/step", "(~rays.edge).float(), drawn)", "everywhere, drawn)"),
    Fault("plate-ignored", "training/step", "if rays.plate is not None:", "if False:"),
    Fault("plate-at-outline", "training/step", "(rays.person | rays.edge)[:, None]", "rays.person[:, None]"),
    Fault("background-black", "training/step", "rays.colour, drawn)", "rays.colour, 0 * drawn)"),
    # inputs of the networks of `fast`
    Fault("fast-colour-normal", "fields/grids", "positional_encoding(normal, 1)", "positional_encoding(0 * normal, 1)"),
    Fault("fast-frozen-grids", "fields/fast", "*self.field.colour_grids.parameters()]", "]"),
    Fault("fast-body-normal", "fields/fast", "outward + (found[1:] - found[0]).T / GRADIENT_STEP_M", "outward",
          "fields/fast_ray"),
    Fault("fast-normal-untaught", "fields/fast", "bodies.turn(gradient, row", "bodies.turn(gradient.detach(), row",
          "fields/fast_ray"),
    Fault("fast-normal-unturned", "body/canonical", "(linear * directions[:, None]).sum(-1)", "directions",
          "fields/fast_ray"),
    Fault("errors-smallest", "training/pixels", "torch.inf).argmax(0)", "torch.inf).argmin(0)"),
    Fault("errors-unmet", "training/pixels", "torch.where(mean > 0, mean, torch.inf)", "mean"),
    Fault("errors-zero", "training/pixels", "errors.clamp(min=LEAST_ERROR)", "errors"),
    Fault("errors-cells", "training/gather", "y // CELL_PX * wanted", "y * wanted", "training/pixels"),
    Fault("errors-images", "training/gather", "cells + cell)", "cell)", "training/pixels"),
    Fault("errors-of-paper", "training/trainer", "None if uniform or cell is None", "None if cell is None"),
    Fault("errors-forgotten", "training/trainer", 'self.errors.mean = state["errors"].cpu()', "pass"),
    Fault("errors-of-one-rank", "training/parts", "processes.all_sum(errors)", "errors", "training/ranks"),
    Fault("plates-hidden", "training/plates", "cv2.dilate(mask, disc) > 0", "mask > 0"),
    Fault("rays-transposed", "training/gather", "c.R.T @ np.linalg.inv(c.K)", "c.R @ np.linalg.inv(c.K)",
          "training/pixels"),
    Fault("plates-unasked", "training/trainer", "with_plates=not uniform", "with_plates=True"),
    Fault("mask-beyond-reach", "training/gather", "visible_pixels(camera, vertices_m) | mask",
          "visible_pixels(camera, vertices_m)", "training/pixels"),
    Fault("plates-known", "training/gather", "plates[c].known | ~edge", "plates[c].known | edge", "training/pixels"),
    Fault("fast-pose-code", "fields/grids", "code.index_select(0, row)", "0 * code.index_select(0, row)"),
    Fault("fast-residual-unit", "fields/grids", "self.unit_m * last(", "last("),
    Fault("fast-frame", "fields/fast", "self._residual(described, pose, rows)",
          "self._residual(described, pose, 0 * rows)", "fields/fast_ray"),
    Fault("sparse-grids-slope", "fields/sparse_grids", "(2.0 * float(j) - 1.0)", "1.0"),
    Fault("sparse-grids-missing", "fields/sparse_grids",
          "                    if left >= 0:\n                        total",
          "                    if left >= 1:\n                        total"),
    Fault("correction-lever", "body/correction_pull", "part * wp.cross(points[i], g)", "part * wp.cross(g, points[i])"),
    Fault("shell-inside", "fields/shell", "inner + SLACK", "outer + SLACK"),
    Fault("beside-distance", "body/canonical", "found.sign * distance + (normal * moved).sum(-1)",
          "found.sign * distance", "body/descriptor"),
    Fault("fast-eikonal-inside", "fields/fast", " * skin.d[pick].detach().sign()[:, None]", "", "fields/fast_ray"),
    Fault("fast-difference-step", "fields/fast", "GRADIENT_STEP_M = 0.005", "GRADIENT_STEP_M = 0.03",
          "fields/fast_ray"),
    Fault("fast-eikonal-body", "fields/fast", "y = y.detach() + GRADIENT_STEP_M", "y = y + GRADIENT_STEP_M",
          "fields/fast_ray"),
    Fault("fast-elastic-unit", "fields/fast", "(moved.index_select(0, chosen) / ELASTIC_M)",
          "moved.index_select(0, chosen)", "fields/fast_ray"),
    Fault("fast-elastic-far", "fields/fast", "torch.where(described.near, (moved",
          "torch.where(torch.ones_like(described.near), (moved", "fields/fast_ray"),
    Fault("fast-colour-place", "fields/fast", "surface_m = move_to_surface(described, d_hat, depth_m, ends)",
          "surface_m = described, depth_m", "fields/fast_ray"),
    Fault("fast-depth", "fields/base", "depths if samples.surface_m is None else samples.surface_m", "depths",
          "fields/fast"),
    Fault("fast-core", "fields/fast", "torch.where(core[met], 1.0, ", "torch.where(~core[met] & core[met], 1.0, "),
    Fault("fast-other-ray", "fields/fast", "near[1:] & ~ends[:-1] & ((y", "near[1:] & ((y"),
    Fault("fast-back-to-other-ray", "fields/fast", " & ~ends[:-2]).to(d_hat)", ").to(d_hat)"),
    Fault("bvh-ends", "asset/bvh_file", "skin.joints[:, 0]", "skin.joints[:, -1]"),
    Fault("fast-probe", "fields/fast", "last - count[met] + 1 +", "last + 0 *",
          "fields/fast_ray"),
    Fault("samples-by-path", "fields/shell", "(self.cell_m * cumulative[:, -1] / spacing_m).ceil()",
          "torch.full_like(edges[:, 0], most)"),
    Fault("fast-thickness", "fields/fast", " & (described.d <= self.outer_m[described.vertex])", ""),
    Fault("fast-displaced-shell", "fields/fast", ".clamp(least_m, s.outer_m)", ""),
    Fault("fast-tighten-sides", "fields/fast", "side * described.d[seen]", "-side * described.d[seen]",
          "training/tighten"),
    Fault("fast-tighten-poses", "fields/fast", "seen |= described.near", "seen = described.near", "training/tighten"),
    # what the trainer passes to a step, and its curve
    Fault("curve-outlines", "training/fixed_rays", "[rays.person & ~mixed]", "[rays.person]"),
    Fault("curve-scene", "training/fixed_rays", "box_colour(samples, torch.zeros_like(rays.colour))",
          "samples.colour[:, 0]"),
    Fault("trainer-noise", "training/trainer", "self.scene.with_noise(s.noise, self.generator)", "self.scene",
          "training/trainer_step"),
    Fault("trainer-view-noise", "training/trainer", "samples, s.noise, self.generator, spacing_m)",
          "samples, 0.0, self.generator, spacing_m)", "training/trainer_step"),
    Fault("exposure-gains", "training/trainer", "visible_pixels, self.gains, out", "visible_pixels, {}, out",
          "training/trainer_step"),
    Fault("exposure-inverse", "training/gather", "shown / np.array(gain", "shown * np.array(gain",
          "training/trainer_step"),
    Fault("trainer-novel-frames", "training/trainer", "rows = self.train_rows if self.step",
          "rows = torch.cat([self.train_rows, self.novel_rows]) if self.step", "training/trainer_step"),
    Fault("trainer-field-goes-on", "training/trainer", "self.field.requires_grad_(False)", "pass",
          "training/trainer_step"),
    Fault("trainer-poses-go-on", "training/trainer", "pose.grad[self.train_rows] = 0.0", "pass",
          "training/trainer_step"),
    Fault("trainer-decay", "training/trainer", "FINAL_LEARNING_RATE ** self._progress() * ", "",
          "training/trainer_step"),
    Fault("ground-unknown", "training/trainer", "settings, ground_axis)", "settings)", "training/trainer_step"),
    Fault("one-camera-drifts", "training/trainer", "if self.only_centre_m is not None:", "if False:",
          "training/trainer_step"),
    Fault("one-camera-farthest", "training/tuned_poses", "tuned.norm(dim=-1).mean()", "tuned.norm(dim=-1).max()",
          "training/trainer_step"),
    Fault("one-camera-all", "training/tuned_poses", "root[rows, :3, 3] = centre",
          "root[-1] = root[0]; root[rows, :3, 3] = centre", "training/trainer_step"),
    Fault("single-frame-shared", "training/trainer", " and len(self.train_rows) > 1:", ":", "training/trainer_step"),
    Fault("trainer-tighten", "training/trainer", "if self.step <= self.field_steps:", "if False:",
          "training/trainer_step"),
    Fault("person-of-all-cameras", "training/auto_settings", "+= len(kept) *", "+= len(capture.train_frames) *"),
    Fault("trainer-momentum", "training/trainer", "self.optimizer.state.clear()", "pass"),
    Fault("checkpoint-optimizer", "training/trainer", 'self.optimizer.load_state_dict(state["optimizer"])', "pass"),
    Fault("exposure-mean", "training/exposure", "weight * np.median(found, 0)", "weight * np.mean(found, 0)"),
    Fault("exposure-clipped", "training/exposure", " & (levels[seen] < MAX_LEVEL).all(1)", ""),
    Fault("exposure-pair", "training/exposure", "= (-weight, weight)", "= (weight, weight)"),
    # cameras, triangulation, meshes
    Fault("camera-half-pixel", "geometry/camera", "[0, sy, top_px + (sy - 1) / 2]", "[0, sy, top_px]"),
    Fault("camera-rays-transposed", "geometry/camera", "np.linalg.inv(self.K).T @ self.R",
          "np.linalg.inv(self.K).T @ self.R.T"),
    Fault("sides-frame-before", "capture/sides", "if same < 0:", "if same > 0:"),
    Fault("sides-gain", "capture/sides", "GAIN_SHARE = 0.04", "GAIN_SHARE = 0.0"),
    Fault("sides-disagreement", "capture/sides", "cameras * AGREED_SHARE", "cameras * GROSS_SHARE"),
    Fault("sides-hidden", "capture/sides", "(sides[..., 2:] > 0).all(0)", "1"),
    Fault("sides-far-frame", "capture/sides", "> NEAR_S:", "> 9.0:"),
    Fault("sides-majority", "capture/sides", "2 * which.sum(0) == cameras", "which.any(0)"),
    Fault("triangulation-depth", "geometry/triangulation", "@ points_m.T + projections[:, 2, 3:])",
          "@ points_m.T - projections[:, 2, 3:])"),
    Fault("triangulation-outlier", "geometry/triangulation", "(confidence > 0) & (distances < inlier_px)",
          "confidence > 0"),
    Fault("mesh-side", "geometry/mesh_queries", "query.sign < 0.0", "query.sign > 0.0", "evaluation/geometry"),
    Fault("silhouette-orientation", "geometry/silhouette", "or wp.max(wp.max(e, g), h) <= wp.float64(0.0)", ""),
    Fault("boards-transposed", "calibration/boards/rig", "R = b[0] @ a[0].T", "R = b[0] @ a[0]",
          "calibration/boards/calibrate"),
    Fault("bundle-transposed", "calibration/bundle", "old.R.T @ new.R for", "new.R.T @ old.R for"),
    Fault("turning-jacobian", "body/articulation", "+ first * cross + second", "- first * cross + second"),
    Fault("silhouette-wide", "geometry/silhouette", "floor(high[0])), image.shape[1]",
          "floor(high[0])), image.shape[0]"),
    Fault("triangulation-surest-pair", "geometry/triangulation", "confidence * np.nan_to_num(dist",
          "np.nan_to_num(dist"),
    Fault("reach-behind", "geometry/reach", "xy, depth_m = xy[depth_m > 0], depth_m[depth_m > 0]",
          "depth_m = depth_m[depth_m > 0]", "training/pixels"),
    Fault("reach-wide-angle", "geometry/reach", "radius * np.sqrt(1 + x**2 + y[:, None] ** 2)",
          "radius + 0 * (x + y[:, None])", "training/pixels"),
    # body fit
    Fault("ground-offsets", "body/ground", " + pose.offsets_m[:, 2]", ""),
    Fault("ground-one-foot", "body/ground", "(LEFT_FOOT, RIGHT_FOOT)", "(LEFT_FOOT, LEFT_FOOT)"),
    Fault("ground-never-each-foot", "body/fit", "replace(problem.ground, each_foot=True)", "problem.ground"),
    Fault("standing-feet-not-held", "body/fit", "standing_feet=StandingFeet.of_pose(pose, runs(capture), capture.fps)",
          "standing_feet=None", "body/standing_feet"),
    Fault("standing-feet-unheeded", "body/keypoint_fit", "cost += self.standing_feet.add(equations, x, by_frame)",
          "pass", "body/standing_feet"),
    Fault("standing-feet-that-move", "body/standing_feet", "< STANDING_MPS", "< np.inf"),
    Fault("standing-feet-in-one-frame", "body/standing_feet", "slow[:-1] & slow[1:]", "slow[:-1] | slow[1:]"),
    Fault("standing-feet-even-frames", "body/standing_feet", "1 / np.diff(at_s)", "fps + 0 * np.diff(at_s)"),
    Fault("standing-feet-uncoupled", "body/standing_feet", "equations.frame[1][self.first] += (before", "(before"),
    Fault("person-of-any-distance", "detection/merge", "if distance <= nearest:", "if True:"),
    Fault("own-network-half-a-pixel", "detection/keypoint_network", "[left + 0.5, top + 0.5]", "[left, top]"),
    Fault("own-network-off-the-crop", "detection/keypoint_network", "[left + 0.5, top", "[0.5, top"),
    Fault("own-network-in-cells", "detection/keypoint_network", "column + _from_peak(heat[row], column)", "column"),
    Fault("own-network-no-feet", "detection/keypoint_network", "np.where(lacks, others[camera], points)", "points"),
    Fault("own-network-upright", "detection/keypoint_network", "angle = person.next.angle", "angle = 0.0"),
    Fault("own-network-bgr", "detection/keypoint_network", "(crop - MEAN) / STD", "(crop[..., ::-1] - MEAN) / STD"),
    Fault("crowd-masks-shifted", "detection/detect", "mask_rows.append(len(masks))",
          "mask_rows.append(len(everybody))"),
    Fault("own-network-unheard", "detection/detect", "        people = network.body_25(", "        network.body_25(",
          "detection/keypoint_network"),
    Fault("ground-anywhere", "capture/standing", "return low <= measured_m <= high", "return True", "body/ground"),
    Fault("ankles-on-the-ground", "capture/standing", "- share * fall", "- 0 * fall", "calibration/monocular"),
    Fault("stature-unheard", "body/fit", "if capture.stature_m:", "if False:"),
    Fault("pose-alone", "fields/grids", "first.bias + of_code @ code[0]", "first.bias"),
    Fault("ghosts-of-limbs", "fields/fast", "arange(len(skips), device=skips.device) + skips",
          "arange(len(skips), device=skips.device)"),
    Fault("limbs-begin-inside", "fields/fast", ".clamp(max=1).maximum(back)", ".clamp(0, 1)"),
    Fault("outlines-unheld", "calibration/outline_adjustment", "if after_px >= min(", "if after_px >= 1e9 + min("),
    Fault("outlines-own-centre", "calibration/outline_adjustment", " + (camera.R - R) @ pivot_m", ""),
    Fault("outlines-zoom-in-place", "calibration/outline_adjustment", "back_m = (zoom - 1) *", "back_m = 0 *"),
    Fault("outlines-missed-alone", "calibration/silhouettes", "before_px > -SLIGHT_CHANGE_PX", "before_px > 0"),
    Fault("outlines-one-way", "calibration/outline_adjustment", "in (steps, -steps)", "in (steps, steps)"),
    Fault("outlines-still-rays", "calibration/silhouettes", "if self.name in changed:", "if False:"),
    Fault("limbs-not-united", "fields/fast", "(other < own[more])", "(other > own[more])"),
    Fault("limbs-close-at-rest", "body/limbs", " & (distances_m < CLOSER_THAN_AT_REST * self.rest_m)", ""),
    Fault("limbs-end-open", "body/canonical", "| (at.barycentric < ON_EDGE)).all(1)", ").all(1) & False", "body/limbs"),
    Fault("fingers-thin", "fields/fast", "torch.where(closest, deeper_m, 0.0)", "0.0 * deeper_m"),
    Fault("little-weight-black", "fields/fast", "* share.view(-1, 1, 1)", ""),
    Fault("fingers-bent-at-rest", "body/fingers", "deg2rad(relaxed) - bend", "deg2rad(relaxed) + bend"),
    Fault("fingers-across-gaps", "body/fingers", "np.arange(ends[-1]), ends - 1)",
          "np.arange(ends[-1]), ends[-1:] - 1)"),
    Fault("hands-seen-once", "body/hand_points", "hands[..., 2] * seen_twice[..., None]", "hands[..., 2]"),
    Fault("hands-by-wrist", "body/fingers", "confidence.unflatten(-1, (2, -1)).amax(-1)", "confidence[..., [0, 21]]"),
    Fault("hands-of-anybody", "detection/hands", "if exchanged else given[i, person]", "if exchanged else given[i, 0]"),
    Fault("hands-given-ignored", "detection/hands", "for name in people if name not in own}", "for name in people}"),
    Fault("hands-given-rarely", "detection/hands", "2 * shown.sum() > seen.sum()", "shown.any()"),
    Fault("hands-of-own-network", "detection/detect", "        write_points(out / GIVEN_HANDS, hands)\n", "",
          seen_by="detection/keypoint_network"),
    Fault("hands-given-outlive-people", "detection/detect", "(out / GIVEN_HANDS).unlink(missing_ok=True)", "pass"),
    Fault("hands-in-the-body", "capture/keypoint_sets", "points.shape[-2] - HAND_POINTS in COUNTS", "False"),
    Fault("fingers-median", "body/fingers", "turns[seen, joints].quantile", "turns[:, joints].quantile"),
    Fault("face-mirror", "body/face_fit", "np.eye(3) - 2 * np.outer(left, left)", "np.eye(3)"),
    Fault("face-difference", "body/face_fit", "region.to_image(seen, SIZE) - region.to_image(rendered, SIZE)",
          "region.to_image(rendered, SIZE) - region.to_image(seen, SIZE)"),
    Fault("face-trust", "body/face_fit", "np.maximum((names[:, None] == names) @ has, 1)", "1"),
    Fault("face-turn", "body/face_fit", "by_world @ met[:, 6:].reshape(-1, 3, 3)", "by_world"),
    Fault("face-network-key", "tasks/fit", ', networks=(FACE_LANDMARKS,)', ""),
    Fault("limbs-twist", "body/posture_prior", "axes[twisted, 1]", "axes[twisted, 0]"),
    Fault("postures-by-group", "body/posture_prior", "slice(first + group * size, first + (group + 1) * size)",
          "slice(first, first + size)"),
    Fault("contour-cells", "body/contour_fit", "np.unique(row * width + column", "np.unique(row + column"),
    Fault("lacked-limb", "body/contour_fit", "LACKED_SHARE * sum(", "LACKED_SHARE / 2 * sum("),
    Fault("contour-shape", "body/contour_fit", "border[frame, :, shape] += weighted_j", "border[frame, :, shape] += j"),
    Fault("cloth-aligned", "body/clothed_fit", "keep = aligned & (", "keep = ("),
    # input: capture formats, segmentation, clocks
    Fault("colmap-pixel-centre", "capture/formats/colmap", "cx - PIXEL_CENTRE", "cx", "capture/formats/camera_files"),
    Fault("colmap-distortion", "capture/formats/colmap", "optics.values[4 : 4 +", "optics.values[5 : 5 +",
          "capture/formats/camera_files"),
    Fault("zjumocap-unit", "capture/formats/zjumocap", "METRES_PER_UNIT = 1e-3", "METRES_PER_UNIT = 1.0"),
    Fault("ingest-stated-rate", "capture/ingest", "        return stated or counted", "        return counted",
          seen_by="capture/clocks"),
    Fault("segmentation-grey-videos", "segmentation/difference", "MAX_GREY_SPREAD = 6", "MAX_GREY_SPREAD = 0",
          seen_by="segmentation/segment"),
    Fault("masks-by-file", "capture/ingest", "return _write_masks(normaliser, masks, out, soft=True)", "soft = True"),
    Fault("hdr-transfer", "capture/video_metadata", "colour[6:8]", "colour[4:6]", "capture/ingest"),
    Fault("focal-of-tracks", "capture/video_metadata", "movie + tracks", "movie", "capture/uncalibrated"),
    Fault("estimated-lens", "capture/uncalibrated", " if self.lens_file or not lens.estimated", ""),
    Fault("normalise-keypoints", "capture/normalise", "* scale + (scale - 1) / 2", "* scale", "capture/ingest"),
    Fault("lens-distortion", "capture/normalise", "if lens.distorts:", "if np.any(lens.distortion[2:]):",
          "capture/ingest"),
    Fault("fisheye-start", "calibration/boards/fisheye", "np.abs(off_px(x)).mean()", "x[0]"),
    Fault("fisheye-gain", "calibration/boards/lens", "FISHEYE_GAIN = 1.5", "FISHEYE_GAIN = 0.9",
          seen_by="calibration/boards/calibrate"),
    Fault("fisheye-deviation", "calibration/boards/fisheye", "variance = 2 * found.cost", "variance = found.cost / 9"),
    Fault("fisheye-beyond", "capture/lens", "straight[tangents > MAX_TANGENT] = np.nan", "pass"),
    Fault("fisheye-recorded", "capture/capture", ", *[True] * lens.fisheye", "", "capture/ingest"),
    Fault("frames-split", "capture/manifest", "train = recorded[: len(recorded) - len(novel)]",
          "train = recorded[: len(recorded) - len(novel) + 1]", "capture/formats/pose2sim"),
    Fault("capture-link", "capture/safe_io", "if stat.S_ISLNK(mode):", "if False:", "capture/bad_input"),
    Fault("capture-pipe", "capture/safe_io", "if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):", "if False:",
          "capture/bad_input"),
    Fault("yaml-aliases", "strict_yaml", "if self.check_event(yaml.AliasEvent):", "if False:"),
    Fault("toml-deep-keys", "capture/safe_io", "if _DEEP_KEY.search(text):", "if False:", "capture/bad_input"),
    Fault("npz-unpacked-size", "capture/safe_io", "if unpacked_bytes > max_bytes:", "if False:", "render/motion"),
    Fault("smpl-limits", "capture/given_poses", "if not (np.abs(values) <= limit).all():", "if False:",
          "capture/formats/zjumocap"),
    Fault("sides-exchanged", "calibration/doubts", "np.cross(up, forward)", "np.cross(forward, up)"),
    Fault("prior-by-rows", "segmentation/prior", "at = (np.array(frames)", "at = (np.arange(len(frames))"),
    Fault("prior-mirrored", "segmentation/prior", "where(depth_m[..., None] <= 0,", "where(False,"),
    Fault("calibration-digits", "calibration/report", "round(tree, DECIMALS)", "round(tree, 15)", "calibration/check"),
    Fault("nearest-frame", "capture/timing", "offset_frames / step + 0.5", "offset_frames / step"),
    # output: assets, and the metrics that judge them
    Fault("stage-axis", "geometry/axes", "[0, 0, 1], [0, -1, 0]])", "[0, 0, 1], [0, 1, 0]])", "asset/staging"),
    Fault("root-heading", "asset/motions", "2 * np.arctan2(y, w)", "np.arctan2(y, w)"),
    Fault("root-upside-down", "asset/motions", "if known.any():", "if False:"),
    Fault("slerp-share", "asset/motions", "np.repeat(share, joints)", "np.tile(share, joints)", "asset/package"),
    Fault("resampled-gap", "asset/motions", "np.floor(share + 1e-6)", "share"),
    Fault("resampled-start", "asset/motions", "np.ceil(first - 1e-6)", "np.floor(first)"),
    Fault("bones-front", "asset/skeleton", "UP if _points_to_front(name) else FRONT",
          "FRONT if _points_to_front(name) else UP"),
    Fault("same-axes", "asset/skeleton", "    full.rotations[game.sources + 1] = game.rotations\n", ""),
    Fault("game-toes", "asset/skeleton", 'toe = f"middle_toe_01_', 'toe = f"no_toe_01_'),
    Fault("folded-weights", "asset/skinning", "joints = taken_by[self.joints]", "joints = self.joints"),
    Fault("game-negative", "asset/skinning", "(found >= 0).all(1) & ", ""),
    Fault("one-eyeball", "asset/rigs", "not all(points.any() for", "not any(points.any() for", "asset/skinning"),
    Fault("package-twice-scaled", "asset/package", "_set_units(layer, part.fps)", "_set_units(layer, 10.0)"),
    Fault("materialx-unlit", "asset/materialx", 'if name == "captured":', 'if name == "unlit":'),
    Fault("materialx-colour-space", "asset/materialx", '"srgb_texture"', '"lin_rec709"'),
    Fault("materialx-normal-map", "asset/materialx", "in1=values, in2=2.0", "in1=values, in2=1.0"),
    Fault("materialx-any-node", "asset/materialx", ".GetProperty().Get() in NODES", ".GetProperty().IsValid()"),
    Fault("materialx-topology", "asset/package", "author_network, name=name, avatar=avatar, prefix=prefix)",
          "author_network, name=name, avatar=avatar)", "asset/materialx"),
    Fault("package-extents", "asset/package", "for boxes in avatar.extents_m.values()", "for boxes in ()"),
    Fault("correctives-sign", "asset/correctives", "np.vstack([shapes_m, -shapes_m", "np.vstack([shapes_m, shapes_m"),
    Fault("bvh-count", "body/bvh", "if frames * max(width, 3 * len(joints)) > MAX_NUMBERS:", "if False:"),
    Fault("bvh-jumps", "body/bvh", "angles[k] * (1, -1, 1) + 180", "angles[k]"),
    Fault("bvh-order", "body/bvh", "Rotation.from_euler(order, angles", "Rotation.from_euler(order.lower(), angles"),
    Fault("bvh-rest", "render/bvh_motion", "align_vectors(theirs[None], ours[None])",
          "align_vectors(ours[None], theirs[None])"),
    Fault("bvh-scale", "render/bvh_motion", "scale * hips -", "hips -"),
    Fault("bvh-fingers", "render/bvh_motion", "len(joints.keys() - AT_REST)", "len(joints)"),
    Fault("bvh-bone-axes", "asset/bvh_file", " @ skeleton.rotations[1:].swapaxes(1, 2)", ""),
    Fault("live-turn", "render/live", 'from_euler("xyz", turn_deg', 'from_euler("zyx", turn_deg'),
    Fault("live-camera", "render/live", "as_matrix().T", "as_matrix()"),
    Fault("live-pace", "render/live", "side >= max(prompt)", "side > max(prompt)"),
    Fault("motion-fingers", "render/motion", "if name in names:", "if name in names and own.rig.free[j]:"),
    Fault("orbit-first-pose", "render/subject", "corners_m[:, 0].amin(0) + corners_m[:, 1].amax(0)",
          "corners_m[0, 0] + corners_m[0, 1]"),
    Fault("render-rate", "render/pictures", "return fps / step", "return fps"),
    Fault("texture-border", "asset/texture", "image[nearest[0], nearest[1]]", "image"),
    Fault("texture-finest", "asset/texture_size", "depth_m[seen] / camera.K[0, 0]", "depth_m[seen]"),
    Fault("texture-memory", "asset/texture_size", "affordable_px, LARGEST_PX)", "LARGEST_PX)"),
    Fault("texture-rounding", "asset/texture_size", "round(np.log2(", "int(np.log2("),
    Fault("texture-away", "asset/texture_size", "seen = facing & ", "seen = "),
    Fault("root-median", "asset/staging", "np.median(points_m[..., 1].min(1))", "np.min(points_m[..., 1].min(1))"),
    Fault("regions-strongest", "asset/regions", "dense_weights.argmax(1)", "dense_weights.argmin(1)"),
    Fault("validation-default", "asset/validation", "if value != default[name]}", "if value != names[name][0]}"),
    Fault("glb-inverse-bind", "asset/glb", "np.linalg.inv(rig.skeleton.bind).swap", "rig.skeleton.bind.swap"),
    Fault("viewer-camera", "asset/staging", "np.diag([1, -1, -1])", "np.eye(3)", "asset/viewer"),
    Fault("texture-upright", "asset/pictures", "(width_px, -height_px)", "(width_px, height_px)"),
    Fault("antialiasing-offsets", "avatar/antialiasing", "QUARTERS_PX = 0.25 *", "QUARTERS_PX = 0.0 *"),
    Fault("antialiasing-depth", "avatar/antialiasing",
          "image[y, x, :4] = render_beside(mixed, QUARTERS_PX).mean(0)[:, :4]",
          "image[y, x] = render_beside(mixed, QUARTERS_PX).mean(0)"),
    Fault("photographs-cosine", "asset/photographs", "cosine**COSINE_POWER", "cosine"),
    Fault("photographs-blurred", "asset/photographs", "colours + change / weight", "colours"),
    Fault("photographs-pixel", "asset/photographs", "y * camera.width_px + x", "x * camera.width_px + y"),
    Fault("photographs-hidden", "asset/photographs", "(distance_m < seen_m[row", "(distance_m > -seen_m[row"),
    Fault("light-reflected", "asset/light", "[1, 2 / 3, 1 / 4]", "[1, 2 / 3, 1 / 2]"),
    Fault("light-ridge", "asset/light", "RIDGE = 1e-5", "RIDGE = 1e-1"),
    Fault("light-outliers", "asset/light", "(error / OUTLIER)", "(0 * error)"),
    Fault("light-axes", "asset/light", "directions @ rotation.T", "directions @ rotation"),
    Fault("light-scale", "asset/light", "coefficients / (basis @ coefficients).max()", "coefficients"),
    Fault("shading-linear", "asset/shading", "to_linear(sampled(", "abs(sampled("),
    Fault("shading-hidden", "asset/shading", "- HIDDEN_M", "- 10"),
    Fault("shading-outline", "asset/shading", "np.ptp(around_m, 0) < EDGE_SLOPE", "0 < EDGE_SLOPE"),
    Fault("albedo-irradiance", "asset/albedo", "+= counts * irradiance", "+= counts"),
    Fault("albedo-vote", "asset/albedo", "take(seen.index, 0) * irradiance", "take(seen.index, 0)"),
    Fault("albedo-field", "asset/albedo", "(seen / field_irradiance[:, None])", "(seen)"),
    Fault("dome-mirrored", "asset/dome", "np.pi * (1 - (np.arange(2 ", "np.pi * (-1 + (np.arange(2 "),
    Fault("look-light-in-world", "asset/staging", "albedo.light.turned(world)", "albedo.light", "asset/package"),
    Fault("glb-unlit", "asset/glb", '"captured": {UNLIT: {}}', '"captured": {}'),
    Fault("corrective-normals", "asset/staging", "change(moved_m, SMALL_WEIGHT)", "change(moved_m)"),
    Fault("glb-looks", "asset/glb", '{"material": k, "variants": [k]}', '{"material": 0, "variants": [k]}'),
    Fault("photographs-outline", "asset/photographs", "inside & ~outline[row, column]", "inside"),
    Fault("photographs-behind", "asset/photographs", " & (depth_m > 0)", ""),
    Fault("shading-behind", "asset/shading", " & (ahead_m > 0)", ""),
    Fault("photographs-slope", "asset/photographs", "TOLERANCE_M / cosine.clip(0.1)", "TOLERANCE_M"),
    Fault("photographs-gain", "asset/photographs", "pixels_px) / gain", "pixels_px) * gain"),
    Fault("correctives-turn", "asset/correctives", "solve(turn, surface_m", "solve(turn.mT, surface_m"),
    Fault("eyelids-brows", "asset/eyelids", "(*BLINKS, *BROWS)]", "BLINKS]"),
    Fault("eyelids-closed", "asset/eyelids", "areas_m2[1] / areas_m2[0]", "areas_m2[0] / areas_m2[1]"),
    Fault("plate-gaps", "asset/plate", "self.bending + self.gaps", "self.bending"),
    Fault("plate-mass", "asset/plate", "diags_array(1 / area_m2)", "diags_array(1e9 * area_m2)"),
    Fault("plate-barycentric", "asset/plate", "-hits.barycentric[vertex]", "-hits.barycentric[vertex][:, ::-1]"),
    Fault("registration-hidden", "asset/registration", "trust[body.hidden] = 0", "trust[body.hidden] = 1"),
    Fault("registration-normals", "asset/registration", "closest_m, aligned /", "closest_m, 1 /"),
    Fault("registration-crossing", "asset/registration", "RINGS = 2, 4", "RINGS = ()"),
    Fault("registration-toes", "asset/registration", "_around(own, faces, rings)", "[]"),
    Fault("registration-loosen", "asset/registration", "= -LOOSEN_M *", "= LOOSEN_M *"),
    Fault("quads-order", "asset/quads", "for k in (1, 2, 0)", "for k in (2, 1, 0)"),
    Fault("eye-size", "body/base_mesh", "scale = np.sqrt(", "scale = 2 * np.sqrt("),
    Fault("regions-head", "asset/regions", '[crossing[:, 0]] == "head"', '[crossing[:, 0]] != "head"'),
    Fault("regions-limit", "asset/regions", "1e3 * surface.closest", "surface.closest"),
    Fault("colours-off-surface", "asset/field_colours", "<= OFF_SURFACE_M", "<= 1.0"),
    Fault("colours-median", "asset/field_colours", "for k in (seen - 1, seen)", "for k in (seen, seen)"),
    Fault("avatar-other-frame", "avatar/avatar", "same[apart.argmin(keepdim=True)]", "same[:1]", "avatar/trained"),
    Fault("lpips-filling", "evaluation/lpips", "value=-1.0)", "value=0.0)"),
    Fault("surface-step", "avatar/surface", "vertices_m - step_to_surface(", "vertices_m + step_to_surface(",
          "asset/correctives"),
    Fault("usd-shape-weights", "asset/usd", "array(motion.shape_weights[k]", "array(1 - motion.shape_weights[k]",
          "asset/package"),
    Fault("splats-triangle", "asset/splats", "root = np.sqrt(", "root = ("),
    Fault("splats-spread", "asset/splats", "SPREAD = 1.4", "SPREAD = 1.3"),
    Fault("splats-logit", "asset/splat_ply", "np.log(OPACITY / (1 - OPACITY))", "OPACITY", "asset/splats"),
    Fault("splats-quaternion", "asset/usd", "[:, [1, 2, 3, 0]]", "[:, [0, 1, 2, 3]]", "asset/splats"),
    Fault("splats-order", "asset/splat_rendering", "np.argsort(depth_m,", "np.argsort(-depth_m,"),
    Fault("splats-hidden", "asset/splat_rendering", "through[pixel] * np.exp(before)", "np.exp(before)"),
    Fault("splats-slope", "asset/splat_rendering", "K[:2] - pixels_px[:, :, None] *", "K[:2] - 0 *"),
    Fault("glb-time", "asset/glb", "(motion.codes - motion.codes[0]) / motion.fps", "motion.codes / motion.fps"),
    Fault("usd-quaternion", "asset/usd", "motion.quaternions[k].astype",
          "motion.quaternions[k][:, [1, 2, 3, 0]].astype", "asset/package"),
    Fault("usd-camera-axis", "asset/staging", "np.diag([1, -1, -1])", "np.diag([1, 1, -1])", "asset/usd"),
    Fault("report-unescaped", "evaluation/report", "autoescape=True", "autoescape=False", "evaluation/evaluate"),
    Fault("surface-one-way", "evaluation/geometry", "distance_p.mean() + distance_t.mean()",
          "distance_p.mean() + distance_p.mean()"),
    Fault("surface-normals-turned", "evaluation/geometry",
          "np.abs((normals_t * predicted.face_normals[face_p]).sum(1))",
          "(normals_t * predicted.face_normals[face_p]).sum(1)"),
    Fault("surface-cut", "avatar/surface", " or (mesh.vertices >= np.array(nodes) - 1).any()", ""),
    Fault("gallery-sides", "evaluation/galleries", '"front": ahead, "back": -ahead', '"front": -ahead, "back": ahead'),
    Fault("surface-closed-truth", "evaluation/geometry", "bool(predicted.is_watertight)", "bool(truth.is_watertight)"),
    Fault("ssim-sample-covariance", "evaluation/metrics", 'covariance": False', 'covariance": True'),
    Fault("psnr-amplitude", "evaluation/metrics", "-10 * np.log10(", "-20 * np.log10("),
    Fault("flat-half", "study/benchmark/convergence", "LAST_SHARE = 1 / 3 ", "LAST_SHARE = 1 / 2 "),
    Fault("ahead-somewhere", "study/benchmark/claims", "yield min(leads) > 0", "yield max(leads) > 0"),
    Fault("claims-of-all", "study/benchmark/claims", 'result["own"][:1]', 'result["own"]'),
    Fault("garment-through-the-body", "study/degradations/clothing",
          "np.concatenate([faces, body_faces + len(vertices_m)])", "np.concatenate([faces, body_faces])"),
    Fault("eroded-by-height", "study/degradations/masks", "_edge_distance_px(mask) > percent / 100 * mask.shape[1]",
          "_edge_distance_px(mask) > percent / 100 * mask.shape[0]"),
    Fault("dilated-by-height", "study/degradations/masks", "_edge_distance_px(~mask) <= percent / 100 * mask.shape[1]",
          "_edge_distance_px(~mask) <= percent / 100 * mask.shape[0]"),
    Fault("blurred-by-height", "study/degradations/images", "percent / 100 * rgb.shape[1]",
          "percent / 100 * rgb.shape[0]"),
    Fault("curve-goes-on", "study/benchmark/scoring", "if s < end_s}", "}"),
    Fault("pose-of-each-joint", "study/benchmark/training_distance", "angle_deg.sum(1).min()",
          "angle_deg.amin(0).sum()"),
    # retries, resumed work and cached results
    Fault("retry-lost-worker", "tasks/policy", "OSError | LostWorkerError)", "OSError)"),
    Fault("retry-out-of-memory", "tasks/policy", "if is_out_of_memory(error):", "if False:"),
    Fault("rank-out-of-memory", "tasks/launcher", "    5: LostWorkerError,\n", ""),
    Fault("retry-permanent", "tasks/policy", " and not is_permanent(error)", ""),
    Fault("key-ignores-version", "tasks/policy", '"version": version, ', ""),
    Fault("store-lock-link", "tasks/store", "flags | os.O_NOFOLLOW", "flags"),
    Fault("store-planted-links", "tasks/store", "for path in partial.rglob(\"*\"):", "for path in list[Path]():"),
    Fault("store-replaced-twice", "tasks/store", "old / uuid4().hex", 'old / "one"'),
    Fault("ledger-key", "tasks/ledger", "*lines[-1:]", "''"),
    Fault("ledger-other-run", "tasks/ledger", "run == failed_run and ", ""),
    Fault("ledger-releases", "tasks/ledger", " and len(runs) < RELEASES", ""),
    Fault("ledger-empty-note", "tasks/ledger", 'or "none")', 'or "")'),
    Fault("store-bad-input", "tasks/store",
          " or (isinstance(error, InputError) and not isinstance(error, PlaceError))", ""),
    Fault("store-gc-locked", "tasks/garbage",
          ' if not _is_locked(inventory.store.path(one.stage, one.key, ".lock"))', ""),
    Fault("too-few-gpus", "tasks/training", "if 0 < gpus < settings.processes:", "if False:"),
    Fault("pycolmap-signals", "pycolmap_import", "libc.sigaction(int(number), action, None)", "pass"),
    Fault("rank-reason", "tasks/launcher", " if line.startswith(REASON)", ""),
    Fault("checkpoint-damage", "training/checkpoint", "archive.testzip()", "None", "training/trainer"),
    Fault("checkpoint-key", "training/checkpoint", 'or state.get("key") != key', "", "training/trainer"),
    Fault("store-damage", "tasks/store", " or sha256_of(path) != file.sha256", ""),
    # garbage collection, archives and the reader's limits
    Fault("gc-inputs", "tasks/inventory", "waiting += self.stored[name].artifact.inputs", "waiting += ()",
          "tasks/garbage"),
    Fault("gc-use", "tasks/garbage", "if aside.stat().st_mtime != garbage.used_s:", "if False:"),
    Fault("gc-pinned", "tasks/inventory", "return pinned(self.store.root).union(", "return set[str]().union(",
          "tasks/garbage"),
    Fault("gc-lock", "tasks/store", "if not _is_at(path, lock.fileno()):", "if False:", "tasks/garbage"),
    Fault("archive-path", "tasks/packed", 'or ".." in parts or', "or", "tasks/archive"),
    Fault("archive-type", "tasks/packed", "member.type != tarfile.REGTYPE or", "", "tasks/archive"),
    Fault("archive-digest", "tasks/packed", "if seen.hexdigest() != digest:", "if False:", "tasks/archive"),
    Fault("archive-manifest", "tasks/packed", " or manifest_name(text) != name", "", "tasks/shared"),
    Fault("note-once", "tasks/bucket", '(name), "xb")', '(name), "wb")'),
    Fault("lease-renewed", "tasks/lease", "if now != text:", "if False:"),
    Fault("lease-of-the-gone", "tasks/lease", "os.kill(int(number), 0)", "pass"),
    Fault("lease-any-place", "tasks/lease", "rest.partition(\" \")[0] != _place() or ", ""),
    Fault("lease-given-up", "tasks/lease", "if text != FREE and", "if"),
    Fault("shared-another", "tasks/shared", "if list(contents.artifacts) != [name]:", "if False:"),
    Fault("shared-later", "tasks/shared", "if bucket.size_bytes(_object(artifact.name)) is None:", "if False:"),
    Fault("limit-progress", "tasks/limits", "            arm()\n\n    def end", "            pass\n\n    def end"),
    Fault("limit-end", "tasks/limits", "exit=True", "exit=False"),
    Fault("cage-unused", "tasks/capture", "read_source(source, ingest_folder, source.root, settings, out, layout)",
          "ingest_folder(source.root, settings, out, layout)"),
    Fault("t-pose-mirror", "body/t_pose", "1.0 if side == \"L\" else -1.0", "1.0"),
    Fault("t-pose-feet", "body/t_pose", "if bone == \"foot\" else above", "if False else above"),
    Fault("cameras-of-one", "capture/ingest", "len(image_folders_in(folder) or videos_in(folder)) > 1\n",
          "len(image_folders_in(folder) or videos_in(folder)) > 0\n", seen_by="capture/uncalibrated"),
    Fault("cameras-boards", "capture/ingest", "if has_calibration(folder) or path_in_capture(",
          "if has_calibration(folder) or not path_in_capture(",
          seen_by="capture/uncalibrated"),
    Fault("cameras-clocks", "capture/formats/from_person", "return read_clocks(self.found)", "return {}",
          seen_by="calibration/find_cameras"),
    Fault("cameras-any-fault", "calibration/find_cameras", "except UndeterminedClocksError as", "except InputError as"),
    Fault("cameras-images", "calibration/find_cameras", "not clocks and not image_folders_in(folder)", "not clocks"),
    Fault("cameras-uncaged", "tasks/cameras", "read_source(source, find_missing_cameras, source.root, out)",
          "find_missing_cameras(source.root, out)", seen_by="calibration/find_cameras"),
    Fault("cameras-guessed", "calibration/find_cameras", "if not have_equal_frames(folder):", "if False:"),
    Fault("cage-memory", "tasks/cage", "_limit(resource.RLIMIT_DATA, memory_bytes)", "pass"),
    Fault("cage-time", "tasks/cage", "    _limit_processor_time(patience_s)\n    try", "    try"),
    Fault("cage-comes-on", "tasks/cage", "        _limit_processor_time(patience_s)\n        _send", "        _send"),
    Fault("cage-network", "tasks/cage", "    _give_up_network()\n    replies", "    replies"),
    Fault("cage-outlives", "tasks/cage", "    end_with_parent(signal.SIGKILL, parent)\n", ""),
    # found by reading the code line by line
    Fault("fit-split-runs", "body/observations", "changes != {frame}", "frame not in changes", seen_by="body/fit"),
    Fault("fit-uneven-frames", "body/pose_prior", "[before * (before", "[after * (before"),
    Fault("clocks-middle", "calibration/clocks/keypoints", "(self.rate - rate) * self.middle_s", "0 * self.middle_s",
          seen_by="calibration/clocks/clocks"),
    Fault("clocks-counted", "capture/clocks", "4), _regular(times_s[name])))", "4),))"),
    Fault("boards-gap", "calibration/boards/bundle", "MAX_APART = 1.5", "MAX_APART = 99.0",
          seen_by="calibration/boards/calibrate"),
    Fault("pose2sim-numbers", "capture/formats/easymocap",
          "images if len(images) == len(found) else range(len(found))", "range(len(found))",
          seen_by="capture/formats/pose2sim"),
    Fault("lone-video-lens", "capture/formats/videos", "if self.folder.is_dir() and", "if False and"),
    Fault("truth-of-training", "evaluation/ground_truth", "for c in self.capture.test_cameras for",
          "for c in self.capture.cameras for", seen_by="evaluation/evaluate"),
    Fault("trc-first", "asset/bvh_file", "(count, -1), first):", "(count, -1)):"),
    Fault("bvh-root", "asset/bvh_file", "    offsets[0] = 0", "    offsets[0] = offsets[0]"),
    Fault("garbage-damaged", "tasks/garbage", "record in lost or not", "not"),
    Fault("preset-empty", "config", "if not tree:", "if False:"),
    Fault("named-files", "config", "isinstance(value, Path) and not value.is_file()", "False"),
    Fault("view-elsewhere", "render/page", "    asyncio.run(_check_host(host))\n", ""),
    Fault("iou-of-nobody", "evaluation/metrics", " if union else 1.0", ""),
    # found by a motion capture engineer
    Fault("clocks-drifting", "capture/clocks", "bool(IRREGULAR * _step_s(times_s[0]) <", "bool(99 <"),
    Fault("clocks-uneven-instants", "capture/clocks", "    warn_if_uneven(footage[slowest])\n", ""),
    Fault("pose2sim-tables", "capture/formats/pose2sim", 'table.keys() & {"matrix", "rotation"}', "True"),
    Fault("caliscope-unposed", "capture/formats/caliscope", "    if unposed:", "    if False:",
          seen_by="capture/formats/camera_files"),
    Fault("undistortion-lost", "capture/ingest", "> MAX_LOST_SHARE:", "> 1:"),
    Fault("board-lens-rms", "calibration/boards/calibrate", "if not found.describes_corners:", "if False:"),
    Fault("pixel-aspect-turned", "capture/footage", "height / width if stream.get(cv2.CAP_PROP_ORIENTATION_META) % 180",
          "height / width if False", seen_by="capture/uncalibrated"),
    Fault("ranges-overlap", "capture/manifest", "if frame not in trained]", "]", seen_by="capture/ingest"),
    Fault("mmpose-first", "capture/keypoint_files", 'frame["frame_id"] - first', 'frame["frame_id"]',
          seen_by="capture/keypoint_sets"),
)  # fmt: skip


@dataclass(frozen=True)
class Verdict:
    """The first test that failed with a fault, or None if none did, and the seconds it took."""

    fault: Fault
    red: str | None
    seconds: float

    def __str__(self) -> str:
        found = f"caught by {self.red}" if self.red else f"MISSED by {self.fault.tests}"
        return f"{self.fault.name:26} {found} ({self.seconds:.0f} s)"


def with_fault(fault: Fault, root: Path) -> str:
    """Return the file's text with the fault in it; ValueError if the text to replace is not found exactly once."""
    text = (root / fault.file).read_text()
    if (times := text.count(fault.text)) != 1:
        raise ValueError(f"{fault.name}: found {times} times in {fault.file}, not once: {fault.text!r}")
    return text.replace(fault.text, fault.instead)


@contextmanager
def copied(root: Path) -> Iterator[Path]:
    """Yield a temporary copy of the code and its tests."""
    with tempfile.TemporaryDirectory(prefix="hnerf-faults-") as folder:
        for name in COPIED:
            if (root / name).is_dir():
                shutil.copytree(root / name, Path(folder, name), ignore=shutil.ignore_patterns("__pycache__"))
            elif (root / name).exists():
                shutil.copy(root / name, folder)
        yield Path(folder)


def first_red(folder: Path, tests: list[str], limit_s: float | None = None) -> str | None:
    """Run tests in a folder. Return the first one that fails, a text that names the time limit if they do not end in
    time, or None if all pass. Raises RuntimeError, with pytest's output, if the tests cannot be run."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            [*PYTEST, *tests], cwd=folder, env=environment, capture_output=True, text=True, timeout=limit_s
        )
    except subprocess.TimeoutExpired:
        return f"its time limit of {limit_s:g} s"
    red = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    if done.returncode > 1 or (done.returncode == 1 and not red):
        raise RuntimeError(f"pytest {' '.join(tests)} ends with {done.returncode}:\n{done.stdout[-3000:]}{done.stderr}")
    return red.group(1) if red and done.returncode else None


def judge(fault: Fault, root: Path = ROOT) -> Verdict:
    """Run the tests of a fault on a copy of the code that has it; return the verdict."""
    began, faulty = time.monotonic(), with_fault(fault, root)
    with copied(root) as folder:
        (folder / fault.file).write_text(faulty)
        red = first_red(folder, [fault.tests], LIMIT_S)
    return Verdict(fault, red, time.monotonic() - began)


def main() -> int:
    """Judge the requested faults; return the exit status."""
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
