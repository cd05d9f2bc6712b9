"""`hnerf view`: a web page that shows the radiance field of a trained person live, by viser."""

# To mypy, the values of viser's controls look read-only.
# mypy: disable-error-code="misc"

import asyncio
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hnerf.avatar.finished import avatar_of, reason_without_novel_poses, require_poses
from hnerf.body.rig import Rig
from hnerf.capture.capture import Capture
from hnerf.errors import InputError
from hnerf.geometry.camera import Camera
from hnerf.render.live import LivePerson, Pace, Shown, browser_camera, field_of_view_rad
from hnerf.render.pictures import frame_times
from hnerf.render.subject import RenderOptions, checked_capture, chosen_motion

if TYPE_CHECKING:
    import viser

CAPTURED = "captured"
MOST_PX, JPEG_QUALITY = 1024, 90  # longest side of an image
MOST_TURN_DEG, TURN_STEP_DEG = 120.0, 1.0
MOST_CHANGE, CHANGE_STEP = 0.3, 0.01  # of a shape value


def view_subject(subject: Path, motions: Sequence[Path], host: str, port: int) -> None:
    """Show a subject (<store>/subjects/<name>) on a web page until the process is interrupted. motions: files or
    folders to choose from besides the captured motion. Raises InputError if files or viser are missing, if the method
    cannot show other motions, or if `host` is another machine's. If the port is taken, viser takes the next one."""
    try:
        import viser
    except ImportError:
        raise InputError("viser is missing; pip install --constraint constraints.txt -e '.[view]'") from None
    asyncio.run(_check_host(host))
    capture = checked_capture(subject, RenderOptions())
    person = live_person(subject, motions, capture)
    server = viser.ViserServer(host, port, verbose=False)  # prints its address
    page = Page(server, person, capture, can_change=not reason_without_novel_poses(subject / "training"))
    try:
        threading.Event().wait()
    finally:
        page.close()


async def _check_host(host: str) -> None:
    """Raise InputError unless a server can listen at this address. Viser would take the failure for a port that is
    taken, and try others for ever."""
    try:
        (await asyncio.start_server(lambda *_: None, host, 0)).close()
    except (OSError, UnicodeError):  # UnicodeError: no host has such a name
        raise InputError(f"--host {host}: not an address of this machine; give one, or 0.0.0.0 for all") from None


def live_person(subject: Path, motions: Sequence[Path], capture: Capture) -> LivePerson:
    """Return the subject's avatar in its captured motion and in others, each called by its file's name. Raises
    InputError if two have the same name, or if the method cannot show other motions."""
    if motions:
        require_poses(subject, "another motion")
    options = {CAPTURED: RenderOptions()} | {path.name: RenderOptions(motion=path) for path in motions}
    if len(options) <= len(motions):
        names = ", ".join(path.name for path in motions)
        raise InputError(f"--motion {names}: each needs a name of its own, other than {CAPTURED}; rename the files")
    return LivePerson(avatar_of(subject), {name: chosen_motion(subject, one, capture) for name, one in options.items()})


class Page:
    """The page: its controls, which all browsers share, and a thread for each browser that renders what they ask
    for, small while something changes, larger and larger when nothing does."""

    def __init__(self, server: "viser.ViserServer", person: LivePerson, capture: Capture, can_change: bool) -> None:
        """Put the controls on the page. can_change: whether the method can show poses that it was not trained on."""
        self._person, self._capture = person, capture
        self._changed: dict[int, threading.Event] = {}  # by browser
        self._closed, self._threads = threading.Event(), list[threading.Thread]()
        self._one_at_a_time = threading.Lock()  # images share the processor's cores
        server.scene.set_up_direction("+y" if capture.up == "y" else "+z")
        gui = server.gui
        gui.set_panel_label(capture.name)
        self._note = gui.add_markdown("")
        self._camera = gui.add_button_group("Camera", list(capture.cameras))
        self._camera.on_click(lambda event: self._look_through(event.client, self._camera.value))
        self._motion = gui.add_dropdown("Motion", list(person.motions))
        self._motion.on_update(lambda _: self._fit_slider())
        self._frame = gui.add_slider("Pose", 0, max(1, len(self._frames()) - 1), 1, 0)
        self._frame.on_update(lambda _: self._change())
        self._play = gui.add_checkbox("Play", False)
        self._turns_deg: dict[str, tuple[float, float, float]] = {}
        self._shape: dict[str, viser.GuiSliderHandle[float]] = {}
        if can_change:
            self._add_body(gui, person.motions[CAPTURED].body.rig)
        server.on_client_connect(self.join)
        server.on_client_disconnect(self.leave)
        self._start(self._advance)

    def _add_body(self, gui: "viser.GuiApi", rig: Rig) -> None:
        """Put the controls of joints and shape on the page."""
        with gui.add_folder("Joints"):
            joints = [name for name, free in zip(rig.joint_names, rig.free.tolist(), strict=True) if free]
            self._joint = gui.add_dropdown("Joint", joints)
            limits = (-MOST_TURN_DEG, MOST_TURN_DEG, TURN_STEP_DEG, 0.0)
            self._turn = [gui.add_slider(f"{axis}, degrees", *limits) for axis in "xyz"]
        with gui.add_folder("Shape", expand_by_default=False):
            limits = (-MOST_CHANGE, MOST_CHANGE, CHANGE_STEP, 0.0)
            self._shape = {name: gui.add_slider(name, *limits) for name in rig.beta_names}
        gui.add_button("Reset joints and shape").on_click(lambda _: self._reset())
        self._joint.on_update(lambda _: self._show_turn())
        for slider in self._turn:
            slider.on_update(self._set_turn)
        for slider in self._shape.values():
            slider.on_update(lambda _: self._change())

    def shown(self) -> Shown:
        """Return what the controls ask for."""
        frames, shape = self._frames(), {name: slider.value for name, slider in self._shape.items()}
        turns_deg = {joint: turn_deg for joint, turn_deg in self._turns_deg.items() if any(turn_deg)}
        return Shown(self._motion.value, frames[min(self._frame.value, len(frames) - 1)], turns_deg, shape)

    def join(self, client: "viser.ClientHandle") -> None:
        """Start to render for a browser, from the first recorded camera."""
        changed = self._changed[client.client_id] = threading.Event()
        changed.set()
        self._look_through(client, next(iter(self._capture.cameras)))
        client.camera.on_update(lambda _: changed.set())
        self._start(self._serve, client, changed)

    def leave(self, client: "viser.ClientHandle") -> None:
        """End the rendering for a browser."""
        self._changed.pop(client.client_id, None)

    def close(self) -> None:
        """End all threads: torch aborts a process that ends while one of them is inside it."""
        self._closed.set()
        for thread in self._threads:
            thread.join()

    def _start(self, work: Callable[..., None], *arguments: object) -> None:
        self._threads.append(threading.Thread(target=work, args=arguments))
        self._threads[-1].start()

    def _frames(self) -> tuple[int, ...]:
        return self._person.motions[self._motion.value].body.frames

    def _change(self) -> None:
        for changed in list(self._changed.values()):
            changed.set()

    def _fit_slider(self) -> None:
        self._frame.value = 0
        self._frame.max = max(1, len(self._frames()) - 1)
        self._change()

    def _show_turn(self) -> None:
        for slider, turn_deg in zip(self._turn, self._turns_deg.get(self._joint.value, (0.0, 0.0, 0.0)), strict=True):
            slider.value = turn_deg

    def _set_turn(self, event: "viser.GuiEvent[Any]") -> None:
        if event.client_id is None:  # not moved by hand, but by `_show_turn` or `_reset`, one after another
            return
        x, y, z = (slider.value for slider in self._turn)
        self._turns_deg[self._joint.value] = x, y, z
        self._change()

    def _reset(self) -> None:
        self._turns_deg.clear()
        for slider in [*self._turn, *self._shape.values()]:
            slider.value = 0.0
        self._change()

    def _look_through(self, client: "viser.ClientHandle | None", name: str) -> None:
        """Move a browser's camera to a recorded one."""
        if client is None:  # it has left
            return
        camera = self._capture.cameras[name]
        with client.atomic():
            client.camera.up_direction = np.eye(3)["xyz".index(self._capture.up)]
            client.camera.position = camera.centre_m
            client.camera.look_at = camera.centre_m + self._away_m(camera) * camera.forward
            client.camera.fov = field_of_view_rad(camera)

    def _away_m(self, camera: Camera) -> float:
        """Return how far ahead of a camera the person is: the browser's camera turns about that point."""
        shown = self.shown()
        root_m = self._person.motions[shown.motion].body.pose(shown.frame)[1][:3, 3].double().numpy()
        return max(0.1, float((root_m - camera.centre_m) @ camera.forward))

    def _serve(self, client: "viser.ClientHandle", changed: threading.Event) -> None:
        """Render for a browser until it leaves."""
        pace = Pace()
        while client.client_id in self._changed and not self._closed.is_set():
            if not changed.wait(1):
                continue
            changed.clear()
            for side_px in pace.sides_px(min(MOST_PX, max(client.camera.image_width, client.camera.image_height))):
                began = time.perf_counter()
                self._render(client, side_px)
                pace.took(side_px, time.perf_counter() - began)
                if changed.is_set() or self._closed.is_set():
                    break

    def _render(self, client: "viser.ClientHandle", side_px: int) -> None:
        view = client.camera
        camera = browser_camera(view.wxyz, view.position, view.fov, view.aspect, side_px)
        with self._one_at_a_time:
            try:
                picture, note = self._person.picture(camera, self.shown()), f"{camera.width_px} x {camera.height_px} px"
            except InputError as error:
                picture, note = None, str(error)
        if client.client_id in self._changed:
            client.scene.set_background_image(picture, jpeg_quality=JPEG_QUALITY)
        self._note.content = note

    def _advance(self) -> None:
        """While Play is checked, show each pose for as long as the videos of `hnerf render` do."""
        while not self._closed.is_set():
            motion, row = self._person.motions[self._motion.value], self._frame.value
            rate, lasts = frame_times(motion.body.frames, motion.fps)
            self._closed.wait(lasts[min(row, len(lasts) - 1)] / rate)
            if self._play.value and self._frame.value == row:  # not moved by hand meanwhile
                self._frame.value = (row + 1) % len(lasts)
