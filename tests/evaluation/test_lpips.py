"""LPIPS with weights worked out by hand, and with the published ones if they are installed."""

import hashlib
import pickle
from pathlib import Path

import numpy as np
import pytest

from hnerf import models
from hnerf.evaluation import lpips as module
from hnerf.evaluation.lpips import MEASURED, NOT_INSTALLED, Lpips, lpips, lpips_availability
from hnerf.evaluation.metrics import score_image
from hnerf.models import LPIPS_ALEXNET, LPIPS_VGG, has_model

BLACK, WHITE = (np.full((64, 64, 3), level, np.uint8) for level in (0, 255))


@pytest.fixture
def by_hand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install weights with two channels in the first layer: one reads red at the window's centre, the other is
    constantly 1. All other layers are constantly 1. The head of the first layer is (2, 3)."""
    sizes = [(11, 3), (5, 2), (3, 1), (3, 1), (3, 1)]
    layers = {f"Conv_{i}": {"kernel": np.zeros((k, k, c, 1)), "bias": np.ones(1)} for i, (k, c) in enumerate(sizes)}
    first = np.zeros((11, 11, 3, 2))
    first[5, 5, 0, 0] = 1
    layers["Conv_0"] = {"kernel": first, "bias": np.array([0.0, 1.0])}
    heads = {f"NetLinLayer_{i}": {"Conv_0": {"kernel": np.ones((1, 1, 1, 1))}} for i in range(5)}
    heads["NetLinLayer_0"]["Conv_0"]["kernel"] = np.array([2.0, 3.0]).reshape(1, 1, 2, 1)
    content = pickle.dumps({"AlexNet_0": layers} | heads)
    (tmp_path / LPIPS_ALEXNET).write_bytes(content)
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path))
    monkeypatch.setitem(models.SHA256, LPIPS_ALEXNET, hashlib.sha256(content).hexdigest())


def test_lpips_by_hand(by_hand: None) -> None:
    """White's red is (1 + .030) / .458 = 2.24891; black's is negative, and ReLU sets it to 0. Features of unit length
    are (.913738, .406303) and (0, 1): 2 x .834917 + 3 x .352476 = 2.727262. All other layers agree."""
    assert Lpips()(WHITE, BLACK) == pytest.approx(2.727262, abs=1e-5)
    assert Lpips()(WHITE, WHITE) == 0


def test_small_images_are_padded_with_black(by_hand: None) -> None:
    """Of 15 x 15 positions, at pixels 3, 7, ..., 59, 4 x 4 lie in an image of 16 px. In the padding, ReLU leaves (0,
    1); with grey it would be (.0654, .9979)."""
    small = Lpips()(WHITE[:16, :16], BLACK[:16, :16])
    assert small == pytest.approx(2.727262 * 16 / 225, abs=1e-6)
    assert Lpips()._features(WHITE[:16, :16])[0][0, :, 14, 14].tolist() == pytest.approx([0, 1], abs=1e-6)


def test_without_weights_lpips_is_null_with_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HNERF_MODELS", str(tmp_path))
    assert lpips(WHITE, BLACK) is None
    assert lpips_availability() == NOT_INSTALLED
    rendered = np.concatenate([WHITE, WHITE[..., :1]], -1)
    assert score_image(rendered, WHITE, np.ones((64, 64), bool))["lpips"] is None


def test_newly_installed_weights_are_used(by_hand: None) -> None:
    module._alexnet.cache_clear()
    rendered = np.concatenate([WHITE, WHITE[..., :1]], -1)
    score = score_image(rendered, BLACK, np.ones((64, 64), bool))
    module._alexnet.cache_clear()
    assert score["lpips"] == pytest.approx(2.727262, abs=1e-5)
    assert lpips_availability() == MEASURED


@pytest.mark.parametrize(("name", "distance"), [(LPIPS_ALEXNET, 0.01470), (LPIPS_VGG, 0.03150)])
def test_published_weights_agree_with_another_implementation(name: str, distance: float) -> None:
    """Compare noise, and noise added to it, with values from independently written weights and layers. For the
    published example pairs with .722 and .138, these give .7219 and .1376."""
    if not has_model(name):
        pytest.skip(f"{name} is not in the cache: `hnerf models` fetches it")
    rng = np.random.default_rng(0)
    a = rng.integers(0, 256, (128, 96, 3), dtype=np.uint8)
    b = np.clip(a.astype(int) + rng.integers(-30, 30, a.shape), 0, 255).astype(np.uint8)
    assert Lpips(name)(a, b) == pytest.approx(distance, abs=1e-4)
