"""From detected keypoints to points in space: robust triangulation, and which detected person is the subject."""

from itertools import combinations, pairwise

import numpy as np

from hnerf.capture.camera import Camera
from hnerf.capture.capture import Capture
from hnerf.errors import CaptureError

CHUNK = 1 << 14  # points triangulated at once, which bounds memory
MIN_INLIER_PX = 3.0
AGREEMENT_REACH = 0.15  # of a person's height in the image: where a detection stops supporting a hypothesis
UNEXPLAINED = 0.1  # weight of a detection that the other cameras do not support: a camera may be badly calibrated
CANDIDATES = 8  # combinations of people kept a frame
SINGULAR = 1e-12  # of the normal equations' trace: parallel rays meet far away instead of nowhere
JUMP_COST = 4.0  # of one camera's best score, for moving by the person's own height between frames
USUAL_JUMPS = 2.0  # times the median movement between frames, which cost nothing


def triangulate(
    projections: np.ndarray, keypoints: np.ndarray, inlier_px: float | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in space from their images, with outlier views left out.

    projections (C, 3, 4); keypoints (C, K, 3) x_px, y_px, confidence (0: unseen). The pair of views whose linear
    solution lies nearest to all views (confidence-weighted L1) decides which views are inliers; these are solved
    together by the iteratively re-weighted linear method (Hartley and Sturm 1997). `inlier_px` defaults to 4 times the
    median distance of the views that took no part in a pair's solution: it grows with noise and calibration error.

    Returns points_m (K, 3), NaN with fewer than two inlier views; residuals_px (C, K), NaN where unseen or without a
    point; inliers (C, K) bool.
    """
    confidence = _confidence(keypoints)
    best = [_best_pair(projections, keypoints[:, i : i + CHUNK], confidence[:, i : i + CHUNK])
            for i in range(0, keypoints.shape[1], CHUNK)]  # fmt: skip
    pair_points = np.concatenate([points for points, _ in best]) if best else np.zeros((0, 3))
    in_pair = np.concatenate([members for _, members in best], 1) if best else confidence > 0
    distances = reprojection_px(projections, pair_points, keypoints)
    if inlier_px is None:
        witnesses = distances[(confidence > 0) & ~in_pair & np.isfinite(distances)]
        inlier_px = max(MIN_INLIER_PX, 4 * float(np.median(witnesses))) if witnesses.size else np.inf
    inliers = (confidence > 0) & (distances < inlier_px)
    points_m = _solve(projections, keypoints, confidence * inliers)
    residuals_px = reprojection_px(projections, points_m, keypoints)
    inliers &= np.isfinite(residuals_px)
    points_m[inliers.sum(0) < 2] = np.nan
    residuals_px[:, inliers.sum(0) < 2] = np.nan
    residuals_px[confidence == 0] = np.nan
    return points_m, residuals_px, inliers & np.isfinite(residuals_px)


def _confidence(keypoints: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(keypoints).all(-1), keypoints[..., 2], 0.0)


def _best_pair(projections: np.ndarray, keypoints: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Per point the two-view solution nearest to all views: (K, 3), and the members of the pair (C, K) bool."""
    cameras, count = confidence.shape
    best_cost = np.full(count, np.inf)
    points_m = np.full((count, 3), np.nan)
    members = np.zeros((cameras, count), bool)
    for both in map(list, combinations(range(cameras), 2)):
        in_pair = np.zeros((cameras, 1), bool)
        in_pair[both] = True
        candidate_m = _solve(projections[both], keypoints[both], confidence[both])
        far = reprojection_px(projections, candidate_m, keypoints)
        cost = np.where(confidence > 0, confidence * np.nan_to_num(far, nan=1e6), 0).sum(0)
        better = (confidence[both] > 0).all(0) & (cost < best_cost)
        best_cost[better], points_m[better], members[:, better] = cost[better], candidate_m[better], in_pair
    return points_m, members


def _solve(projections: np.ndarray, keypoints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted linear triangulation (K, 3), re-weighted once by depth to minimise pixels; NaN under two views.

    Hartley and Sturm 1997, section 5.2, "Iterative-LS": inhomogeneous normal equations, the same wherever the origin.
    """
    rows = projections[:, None, 2:] * np.nan_to_num(keypoints)[..., :2, None] - projections[:, None, :2]  # (C, K, 2, 4)
    focal = np.linalg.norm(projections[:, :2, :3], axis=-1).mean(1)
    outer = np.einsum("ckia,ckib->ckab", rows, rows) / focal[:, None, None, None] ** 2
    scale = np.where(weights > 0, np.sqrt(weights), 0)
    enough = (weights > 0).sum(0) >= 2
    points_m = np.full((keypoints.shape[1], 3), np.nan)
    for _ in range(2):
        normal = np.einsum("ckab,ck->kab", outer, scale**2)[enough]
        damping = SINGULAR * np.trace(normal[:, :3, :3], axis1=1, axis2=2)[:, None, None] * np.eye(3)
        points_m[enough] = -np.linalg.solve(normal[:, :3, :3] + damping, normal[:, :3, 3:])[..., 0]
        depth = np.abs(projections[:, 2, :3] @ points_m.T + projections[:, 2, 3:])
        scale = np.where(enough, np.sqrt(weights.clip(0)) / depth.clip(1e-9), 0)
    return points_m


def reprojection_px(projections: np.ndarray, points_m: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Distance of points (K, 3) to keypoints (C, K, 3) in the image, (C, K); NaN behind a camera."""
    x = np.einsum("cij,kj->cki", projections, np.concatenate([points_m, np.ones_like(points_m[:, :1])], 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.linalg.norm(x[..., :2] / x[..., 2:] - keypoints[..., :2], axis=-1)
        return np.where(x[..., 2] > 0, distance, np.nan)


def subject_keypoints(capture: Capture) -> dict[str, np.ndarray]:
    """The subject's keypoints in every training camera, (frames, 25, 3) in the order of `capture.frames`.

    Where several people are detected, the subject is whom most cameras agree on (two-view triangulation predicts where
    each camera must see the person), weighted by size, confidence and nearness to the image's centre, and followed
    through time (Viterbi). Confidence is 0 where the person is not detected. Test cameras are never read.
    Raises CaptureError where no frame shows a person in two cameras (in one, if there is only one).
    """
    names = capture.train_cameras
    detections = {name: capture.keypoints(name) for name in names}
    for name, found in detections.items():
        if found is None:
            raise CaptureError(f"{capture.name}: camera {name}: no keypoints; run a keypoint detector on its images")
    people = [np.nan_to_num(found).astype(np.float64) for found in detections.values() if found is not None]
    seen = np.array([(p[..., 2] > 0).any((1, 2)) for p in people])  # (cameras, frames)
    if not (seen.sum(0) >= min(2, len(names))).any():
        raise CaptureError(f"{capture.name}: no person found in any frame by enough cameras; check the keypoint files")
    if all(p.shape[1] == 1 for p in people):
        return {name: p[:, 0] for name, p in zip(names, people, strict=True)}
    cameras = [capture.cameras[name] for name in names]
    choice = _follow([_frame_candidates(cameras, [p[i] for p in people]) for i in range(len(capture.frames))], people)
    chosen = {}
    for c, name in enumerate(names):
        chosen[name] = people[c][np.arange(len(choice)), choice[:, c]] * (choice[:, c] >= 0)[:, None, None]
    return chosen


def _frame_candidates(cameras: list[Camera], people: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The best combinations of people in one frame: indices (n, C), -1 for nobody, and their scores (n,), the best one
    first; with and without those whom no other camera sees where they are.

    people: per camera (P, 25, 3). The score is the mean over cameras of prominence times agreement.
    """
    prominence = [_prominence(camera, found) for camera, found in zip(cameras, people, strict=True)]
    agreements = _agreements(cameras, people) if len(cameras) > 1 else [np.eye(len(people[0]))]
    if len(agreements[0]) == 0:  # one camera alone shows somebody
        agreements = [np.zeros((1, len(found))) for found in people]
    picks = np.full((len(agreements[0]), len(cameras)), -1)
    scores, supported = np.zeros(picks.shape), np.zeros(picks.shape, bool)
    for c, agreement in enumerate(agreements):
        if not prominence[c].any():
            continue
        value = (UNEXPLAINED + agreement) * prominence[c]
        picks[:, c] = value.argmax(1)
        scores[:, c] = value.max(1) / len(cameras)
        supported[:, c] = np.take_along_axis(agreement, picks[:, c : c + 1], 1)[:, 0] > 0
    picks = np.concatenate([picks, np.where(supported, picks, -1), np.full((1, len(cameras)), -1)])
    total = np.concatenate([scores.sum(1), np.where(supported, scores, 0).sum(1), [0.0]])
    best = np.argsort(-total, kind="stable")
    _, first = np.unique(picks[best], axis=0, return_index=True)
    kept = best[np.sort(first)[:CANDIDATES]]
    return picks[kept], total[kept]


def _agreements(cameras: list[Camera], people: list[np.ndarray]) -> list[np.ndarray]:
    """How well each hypothesis (a person in one camera being a person in another) explains each person: per camera
    (n, P), from 0 to 1."""
    projections = np.stack([camera.projection for camera in cameras])
    shown = [found[found[..., 2].any(1)] for found in people]
    hypotheses_m = [np.zeros((0, 25, 3))]
    for a, b in combinations(range(len(cameras)), 2):
        views = np.stack(
            [
                shown[a].repeat(len(shown[b]), axis=0).reshape(-1, 3),
                np.tile(shown[b], (len(shown[a]), 1, 1)).reshape(-1, 3),
            ]
        )
        hypotheses_m.append(_solve(projections[[a, b]], views, _confidence(views)).reshape(-1, 25, 3))
    points_m = np.concatenate(hypotheses_m)
    return [_support(camera, points_m, found) for camera, found in zip(cameras, people, strict=True)]


def _support(camera: Camera, points_m: np.ndarray, people: np.ndarray) -> np.ndarray:
    """(n, P): confidence-weighted share of the keypoints of people (P, 25, 3) that points (n, 25, 3) project onto."""
    uv, depth_m = camera.project(points_m)
    height_px = person_heights_px(people).clip(1)
    distance = np.linalg.norm(uv[:, None] - people[None, ..., :2], axis=-1) / height_px[:, None]
    hit = np.where((depth_m[:, None] > 0) & np.isfinite(distance), 1 - distance / AGREEMENT_REACH, 0).clip(0)
    weight = people[..., 2]
    return (hit * weight).sum(-1) / weight.sum(-1).clip(1e-9)


def person_heights_px(people: np.ndarray) -> np.ndarray:
    """Largest side of each person's keypoint box, (P,)."""
    visible = people[..., 2:] > 0
    low = np.where(visible, people[..., :2], np.inf).min(-2)
    high = np.where(visible, people[..., :2], -np.inf).max(-2)
    return (high - low).max(-1).clip(0)


def _prominence(camera: Camera, people: np.ndarray) -> np.ndarray:
    """Size x confidence x centrality of each person, (P,), from 0 to 1."""
    size_px = np.array([camera.width_px, camera.height_px])
    weight = people[..., 2:]
    centre = (people[..., :2] * weight).sum(-2) / weight.sum(-2).clip(1e-9)
    off_centre = np.linalg.norm((centre - size_px / 2) / size_px, axis=-1)
    height = (person_heights_px(people) / camera.height_px).clip(0, 1)
    return height * people[..., 2].mean(-1).clip(0, 1) * np.exp(-2 * off_centre**2)


def _follow(candidates: list[tuple[np.ndarray, np.ndarray]], people: list[np.ndarray]) -> np.ndarray:
    """The most probable sequence of combinations, (frames, C): Viterbi with a cost for jumping in the image, by more
    than is usual here. Who is not seen is where he was seen last."""
    shown = [_shown([p[i] for p in people], picks) for i, (picks, _) in enumerate(candidates)]
    best = [[one[:1] for one in frame] for frame in shown]
    usual = USUAL_JUMPS * float(np.median([_jump(a, b)[0, 0] for a, b in pairwise(best)])) if len(best) > 1 else 0.0
    last, total, back = shown[0], candidates[0][1], []
    for now, (picks, score) in zip(shown[1:], candidates[1:], strict=True):
        best_before = total[:, None] - JUMP_COST * _jump(last, now, usual)
        back.append(best_before.argmax(0))
        total = best_before.max(0) + score
        seen = (picks >= 0).T[..., None, None]
        last = [np.where(is_seen, new, old[back[-1]]) for is_seen, new, old in zip(seen, now, last, strict=True)]
    path = [int(total.argmax())]
    for step in reversed(back):
        path.append(int(step[path[-1]]))
    return np.stack([picks[k] for (picks, _), k in zip(candidates, reversed(path), strict=True)])


def _shown(people: list[np.ndarray], picks: np.ndarray) -> list[np.ndarray]:
    """Per camera the keypoints (n, 25, 3) of the picked people of one frame, 0 for nobody."""
    return [np.where((pick >= 0)[:, None, None], found[pick], 0.0) for found, pick in zip(people, picks.T, strict=True)]


def _jump(before: list[np.ndarray], now: list[np.ndarray], usual: float = 0.0) -> np.ndarray:
    """Mean over cameras of the movement beyond `usual` in person heights, at most 1 a camera, from each of people
    (n, 25, 3) to each of others (m, 25, 3): (n, m)."""
    jumps = np.zeros((len(before[0]), len(now[0])))
    for was, is_now in zip(before, now, strict=True):
        a, b = was[:, None], is_now[None]
        both = np.minimum(a[..., 2], b[..., 2])
        distance = np.linalg.norm(a[..., :2] - b[..., :2], axis=-1) / person_heights_px(b).clip(1)[..., None]
        jumps += (((distance - usual).clip(0, 1) * both).sum(-1) / both.sum(-1).clip(1e-9)) / len(before)
    return jumps
