"""Render a trained person along a path of cameras: from one recorded camera through the others and back to the first.

`subject` is `store/subjects/NAME` of `hnerf run`, or the folder that `examples/train.py` wrote. Writes one RGBA PNG per
picture: colour over black, and coverage.
"""

import argparse
import dataclasses
from pathlib import Path

from hnerf.avatar.finished import avatar_of, recording_of
from hnerf.capture.capture import write_image
from hnerf.evaluation.images import rgba
from hnerf.render.trajectory import interpolate_cameras


def main(subject: Path, out: Path, pictures: int = 60, side_px: int = 256) -> None:
    """Write `pictures` square images, in which the person moves through all fitted frames."""
    capture, avatar = recording_of(subject), avatar_of(subject)
    recorded = [capture.cameras[name].resized(side_px, side_px) for name in capture.train_cameras]
    path = interpolate_cameras([*recorded, recorded[0]], pictures)
    frames = avatar.body.frames
    for number, camera in enumerate(path):
        row = number * len(frames) // pictures
        free = dataclasses.replace(camera, name="")  # not a recorded camera: shown without that camera's exposure
        rendering = avatar.render(free, avatar.body.theta[row], avatar.body.root[row])
        write_image(out / f"{number:06d}.png", rgba(rendering))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subject", type=Path)
    parser.add_argument("out", type=Path)
    main(**vars(parser.parse_args()))
