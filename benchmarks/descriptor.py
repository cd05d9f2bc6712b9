"""Measure how many points a second the body descriptor handles, by kind of query.

usage: python benchmarks/descriptor.py

Points lie within the shell of `fast` around the average body, one resting copy a frame, in random order (rays query
points in order, which caches better). Writes `benchmarks/results/descriptor.json` and `.md`: medians of five runs after
a warm-up run.
"""

import statistics
import timeit
from collections.abc import Callable
from typing import Any

import torch
from provenance import arguments, provenance, provenance_line, table, write_result
from torch import Tensor

from hnerf.body.anny import anny_rig
from hnerf.body.canonical import PosedBodies
from hnerf.body.descriptor import vertex_normals

POINTS, FRAMES = 100_000, 8
OUTER_M, INNER_M = 0.07, 0.03  # extent of the shell outside and inside the body
RUNS = 5


def main() -> None:
    """Measure, print and write."""
    arguments(__doc__).parse_args()
    where, rows = provenance(), measure()
    result = where | {"points": POINTS, "frames": FRAMES, "points_per_s": rows}
    shown = [["query", "points a second"], *([name, f"{rate:,.0f}"] for name, rate in rows.items())]
    markdown = "\n".join(["# Body descriptor", "", provenance_line(result), "", *table(shown), ""])
    write_result("descriptor", result, markdown)


def measure() -> dict[str, float]:
    """Return points per second, by kind of query."""
    rig = anny_rig()
    theta, root = torch.zeros(FRAMES, len(rig.joints_m), 3), torch.eye(4).expand(FRAMES, 4, 4)
    bodies = PosedBodies(rig, theta, root, rig.vertices_m)
    correction = bodies.correction()
    points_m, frame = shell_points(rig.vertices_m, rig.faces), torch.arange(POINTS) % FRAMES
    reach_m = OUTER_M + 0.04

    def learning() -> None:
        found = bodies.describe(points_m, frame, reach_m, correction)
        (found.d.sum() + found.y.sum()).backward()

    asked: dict[str, Callable[[], Any]] = {
        "(d, s, y), sign by normal where unambiguous": lambda: bodies.describe(points_m, frame, reach_m),
        "(d, s, y), sign by winding number": lambda: bodies.describe(points_m, frame, reach_m, None, True),
        "(d, s, y) and gradients to pose and shape": learning,
    }
    return {name: POINTS / median_s(work) for name, work in asked.items()}


def shell_points(vertices_m: Tensor, faces: Tensor) -> Tensor:
    """Return random points (POINTS, 3), uniform in depth over the shell."""
    generator = torch.Generator().manual_seed(0)
    pick = torch.randint(len(vertices_m), (POINTS,), generator=generator)
    depth_m = torch.rand(POINTS, 1, generator=generator) * (OUTER_M + INNER_M) - INNER_M
    return vertices_m[pick] + depth_m * vertex_normals(vertices_m, faces)[pick]


def median_s(work: Callable[[], Any]) -> float:
    """Return the median time of one call, in seconds."""
    return statistics.median(timeit.repeat(work, number=1, repeat=RUNS + 1)[1:])


if __name__ == "__main__":
    main()
