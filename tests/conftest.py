"""Tensor shapes in annotations are checked; Prefect's home is a folder of this test session's own, so that tests
neither see nor touch the user's."""

import atexit
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from jaxtyping import install_import_hook

if TYPE_CHECKING:
    from hnerf.body.rig import Rig
    from hnerf.capture.capture import Capture

SHAPED = ["geometry.camera", "geometry.reach", "geometry.triangulation", "fields.compositing", "fields.encoding"]
SHAPED += ["fields.samples", "training.losses"]
install_import_hook([f"hnerf.{name}" for name in SHAPED], "beartype.beartype")

# Prefect reads its settings when it is imported.
_home = tempfile.mkdtemp(prefix="hnerf-prefect-")
atexit.register(shutil.rmtree, _home, ignore_errors=True)
os.environ |= {"PREFECT_HOME": _home, "PREFECT_SERVER_ANALYTICS_ENABLED": "false", "DO_NOT_TRACK": "1"}
os.environ.pop("HNERF_BUCKET", None)  # the user's


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests of a Prefect server: then one of the workers has them all, and starts the only one; and
    with the types, for which the others would wait at the end."""

    def order(item: pytest.Item) -> tuple[bool, bool]:
        return "prefect_api" not in getattr(item, "fixturenames", ()), item.name != "test_types_agree"

    items.sort(key=order)


@pytest.fixture(autouse=True)
def usual_limits() -> Iterator[None]:
    """Have no limits left that a test has set."""
    yield
    from hnerf.config import LimitSettings
    from tasks.limits import set_limits

    set_limits(LimitSettings())


@pytest.fixture(scope="session")
def wave(tmp_path_factory: pytest.TempPathFactory) -> "Capture":
    """The shared capture valid-wave as ingested, for tests that write nothing into it."""
    from hnerf.capture.ingest import ingest
    from hnerf.config import CaptureSettings
    from tests.shared_data import shared_capture

    return ingest(shared_capture("valid-wave"), CaptureSettings(), tmp_path_factory.mktemp("wave"))


@pytest.fixture(scope="session")
def rig() -> "Rig":
    """Anny's average body, Z up, facing -Y, the left at +X."""
    from hnerf.body.anny import anny_rig

    return anny_rig()


@pytest.fixture(scope="session")
def prefect_api() -> Iterator[str]:
    """URL of a Prefect server."""
    from prefect.logging.handlers import APILogWorker
    from prefect.settings import PREFECT_API_URL, temporary_settings

    from tests.prefect_server import prefect_server

    with prefect_server() as url, temporary_settings({PREFECT_API_URL: url}):
        yield url
        APILogWorker.drain_all(timeout=10)  # who has logs for a server that is gone tries for a minute to send them


@pytest.fixture(scope="session")
def s3() -> Iterator[str]:
    """URL of an empty folder in a server of S3 on this machine."""
    server = pytest.importorskip("moto.server", reason="moto's server of S3 is not installed")
    fs = pytest.importorskip("s3fs").S3FileSystem
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    with pytest.MonkeyPatch.context() as patch:
        running = server.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
        running.start()
        host, port = running.get_host_and_port()
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        fs().mkdir("tests")
        yield "s3://tests/shared"
        running.stop()
