"""The page of `hnerf view`: viser's own server, and browsers that only keep what they are sent."""

import dataclasses
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flows.cli import main
from hnerf.avatar.trained import load_avatar
from hnerf.errors import InputError
from hnerf.render.page import Page, live_person
from hnerf.render.subject import RenderOptions, checked_capture

LIMIT_S = 60.0


class Browser:
    """A window of 150 x 100 pixels."""

    def __init__(self, number: int) -> None:
        self.client_id, self.pictures = number, list[np.ndarray]()
        self.camera = SimpleNamespace(
            wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3), look_at=np.zeros(3), up_direction=np.zeros(3), fov=1.0,
            aspect=1.5, image_width=150, image_height=100, on_update=self._listen,
        )  # fmt: skip
        self.scene = SimpleNamespace(set_background_image=lambda picture, **_: self.pictures.append(picture))
        self.atomic = nullcontext

    def _listen(self, moved: Callable[[Any], None]) -> None:
        self.moved = moved

    def wait(self, condition: Callable[[], bool]) -> None:
        end_s = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < end_s, f"{len(self.pictures)} pictures within {LIMIT_S:.0f} s"
            time.sleep(0.01)

    def settle(self) -> np.ndarray:
        """Wait for an image of the window's size, and return it."""
        self.wait(lambda: bool(self.pictures) and self.pictures[-1].shape == (100, 150, 3))
        return self.pictures[-1]


@pytest.fixture
def page(subject: Path) -> Iterator[Page]:
    viser = pytest.importorskip("viser")
    capture = checked_capture(subject, RenderOptions())
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    page = Page(server, live_person(subject, [subject], capture), capture, can_change=True)
    yield page
    page.close()
    server.stop()


def test_images_grow_until_something_changes(page: Page, subject: Path) -> None:
    """The browser looks from the first recorded camera; its last image is what the avatar renders there."""
    browser = Browser(7)
    page.join(browser)  # type: ignore[arg-type]
    recorded = checked_capture(subject, RenderOptions()).cameras["0"]
    np.testing.assert_allclose(browser.camera.position, recorded.centre_m)
    ahead = browser.camera.look_at - recorded.centre_m
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), recorded.forward)
    browser.settle()
    assert [picture.shape[1] for picture in browser.pictures][-2:] == [96, 150]

    browser.camera.wxyz = Rotation.from_matrix(recorded.R.T).as_quat(scalar_first=True)
    browser.pictures.clear()
    browser.moved(None)
    large = browser.settle()
    focal_px = 50 / np.tan(browser.camera.fov / 2)
    K = np.array([[focal_px, 0, 74.5], [0, focal_px, 49.5], [0, 0, 1]])
    avatar = load_avatar(subject / "training", "cpu")
    camera = dataclasses.replace(recorded, name="", K=K, width_px=150, height_px=100)
    expected = (255 * avatar.render(camera, *avatar.body.pose(0)).rgb).round().numpy()
    assert expected.max() > 50
    np.testing.assert_allclose(large, expected, atol=1)

    page.leave(browser)  # type: ignore[arg-type]
    count = len(browser.pictures)
    browser.moved(None)
    time.sleep(0.1)
    assert len(browser.pictures) == count


def test_play_shows_one_pose_after_another(page: Page) -> None:
    browser = Browser(8)
    page.join(browser)  # type: ignore[arg-type]
    page._play.value = True
    poses = set[int]()
    browser.wait(lambda: poses.add(page.shown().frame) or poses == {0, 1, 2})  # type: ignore[func-returns-value]


def test_play_takes_as_long_as_the_recording(page: Page) -> None:
    """Frames 0, 5 and 10 of a recording of 25 frames a second are shown for 0.2 s each."""
    motion = page._person.motions["captured"]
    sparse = dataclasses.replace(motion, body=dataclasses.replace(motion.body, frames=(0, 5, 10)), fps=25.0)
    waits_s = list[float]()

    class Clock:
        """Ends after four waits."""

        def is_set(self) -> bool:
            return len(waits_s) == 4

        def wait(self, seconds: float) -> None:
            waits_s.append(seconds)

    slow = SimpleNamespace(
        _closed=Clock(), _person=SimpleNamespace(motions={"captured": sparse}),
        _motion=SimpleNamespace(value="captured"), _frame=SimpleNamespace(value=0), _play=SimpleNamespace(value=True),
    )  # fmt: skip
    Page._advance(slow)  # type: ignore[arg-type]
    assert waits_s == pytest.approx([0.2, 0.2, 0.2, 0.2])
    assert slow._frame.value == 1


def test_a_turn_belongs_to_its_joint_and_is_reset(page: Page) -> None:
    by_hand = SimpleNamespace(client_id=7)
    page._turn[1].value = 30
    page._set_turn(by_hand)  # type: ignore[arg-type]
    (first,) = page.shown().turns_deg
    assert page.shown().turns_deg == {first: (0, 30, 0)}
    page._turn[0].value = 5  # as when the sliders move to another joint's turn, one after another
    assert page.shown().turns_deg == {first: (0, 30, 0)}

    page._reset()
    assert not page.shown().turns_deg
    assert [slider.value for slider in page._turn] == [0, 0, 0]


def test_a_reset_is_shown_even_if_no_slider_moves(page: Page) -> None:
    """Another joint is turned than the one whose sliders are shown."""
    page._turns_deg["another"] = (0, 30, 0)
    changed = page._changed[7] = threading.Event()
    page._reset()
    assert changed.is_set()
    assert not page.shown().turns_deg


def test_a_motion_of_another_subject_is_offered(page: Page, subject: Path) -> None:
    assert list(page._person.motions) == ["captured", subject.name]


def test_two_motions_of_the_same_name_are_refused(subject: Path) -> None:
    with pytest.raises(InputError, match=r"--motion column, column: each needs a name of its own"):
        live_person(subject, [subject, subject], checked_capture(subject, RenderOptions()))


@pytest.mark.parametrize("host", ["192.0.2.1", "x" * 64])
def test_an_address_of_another_machine_is_refused(
    host: str, subject: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first is reserved for documentation (RFC 5737); the second is too long for a name."""
    viser = pytest.importorskip("viser")
    monkeypatch.setattr(viser, "ViserServer", lambda *_, **__: pytest.fail("would try one port after another"))
    assert main(["view", str(subject), "--host", host]) == 2
    why = "not an address of this machine; give one, or 0.0.0.0 for all"
    assert capsys.readouterr().err == f"hnerf: --host {host}: {why}\n"


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "0.0.0.0"])
def test_an_address_of_this_machine_is_accepted(host: str, subject: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    viser = pytest.importorskip("viser")
    monkeypatch.setattr(viser, "ViserServer", lambda *given, **_: pytest.fail(f"served at {given[0]}"))
    with pytest.raises(pytest.fail.Exception, match=f"^served at {host}$"):
        main(["view", str(subject), "--host", host])


def test_without_viser_the_error_names_the_extra(
    subject: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(subject)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install --constraint constraints.txt -e '.[view]'" in line
