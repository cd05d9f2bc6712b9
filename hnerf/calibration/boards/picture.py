"""Plot of board corners: where each camera found them, and the residuals of the calibration."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hnerf.calibration.boards.bundle import BoardFit

MAGNIFIED = 50  # length of the arrows relative to the image
COLUMNS = 4


def draw_boards(path: Path, fit: BoardFit) -> None:
    """Write one panel per camera as PNG: corners coloured by frame, arrows from seen to projected."""
    count = len(fit.cameras)
    columns = min(count, COLUMNS)
    rows = -(-count // columns)
    figure = Figure(figsize=(5 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for i, camera in enumerate(fit.cameras):
        frame, corner = np.nonzero(np.isfinite(fit.residuals_px[i, ..., 0]))
        miss = fit.residuals_px[i, frame, corner]
        seen = fit.seen_px[i, frame, corner]
        panels[i].quiver(*seen.T, *(MAGNIFIED * miss).T, frame, angles="xy", scale_units="xy", scale=1, width=0.002)
        panels[i].scatter(*seen.T, c=frame, s=4)
        rms = f"{np.sqrt((miss**2).sum(-1).mean()):.2f} px" if len(miss) else "no board"
        panels[i].set(
            title=f"{camera.name}: {rms}, {len(set(frame.tolist()))} pictures",
            xlim=(-0.5, camera.width_px - 0.5),
            ylim=(camera.height_px - 0.5, -0.5),
            aspect="equal",
        )
    for panel in panels[count:]:
        panel.set_axis_off()
    figure.suptitle(f"board corners, and residuals x {MAGNIFIED}")
    figure.savefig(path, dpi=90)
