"""Draw the README's picture from a finished subject: photograph, fitted body, rendered avatar, surface.

usage: python benchmarks/readme_picture.py SUBJECT_DIR [--camera NAME] [--frame N] [--out docs/valid-walk.png]
"""

from pathlib import Path

import cv2
import numpy as np
from provenance import arguments

from hnerf.avatar.finished import recording_of
from hnerf.avatar.surface import posed_surface
from hnerf.avatar.trained import load_avatar
from hnerf.body.fit_result import BodyFit
from hnerf.evaluation.pictures import clay, crop, cropped_camera, frame_person, overlay_surface, shoot
from hnerf.geometry.mesh_queries import Surface


def main() -> None:
    """Write the image."""
    parser = arguments(__doc__)
    parser.add_argument("subject", type=Path)
    parser.add_argument("--camera", default="05")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("docs/valid-walk.png"))
    options = parser.parse_args()
    capture = recording_of(options.subject)
    fitted, avatar = BodyFit.load(options.subject / "fit"), load_avatar(options.subject / "training", "cpu")
    camera, row = capture.cameras[options.camera], avatar.body.index(options.frame)
    drawn = avatar.render(camera, avatar.body.theta[row], avatar.body.root[row])
    rendered = (drawn.rgb.numpy() * 255).round().astype(np.uint8)
    box = frame_person(drawn.alpha.numpy() > 0.5)
    close = cropped_camera(camera, box)
    photograph = crop(capture.image(options.camera, options.frame), box)
    body = Surface.of(fitted.vertices_m()[row].numpy(), fitted.rig.faces.numpy())
    panels = [
        photograph,
        overlay_surface(photograph, body, close),
        crop(rendered, box),
        clay(shoot(Surface(posed_surface(avatar, options.frame)), close)),
    ]
    cv2.imwrite(str(options.out), cv2.cvtColor(np.hstack(panels), cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
