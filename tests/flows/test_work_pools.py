"""The base job templates in configs/work_pools/: Kubernetes and Docker accept the jobs that Prefect makes of them."""

import asyncio
import json
import os
from pathlib import Path
from typing import Any
from uuid import UUID

import kubernetes_validate
import pytest
from docker.types import HostConfig
from jsonschema import Draft202012Validator
from prefect.client.schemas.actions import WorkPoolCreate
from prefect.client.schemas.objects import FlowRun
from prefect.utilities.templating import find_placeholders
from prefect.workers.base import BaseJobConfiguration, BaseWorker

POOLS = Path(__file__).parents[2] / "configs" / "work_pools"
RUN = FlowRun(id=UUID(int=7), flow_id=UUID(int=8), name="captures/Ada #1")
NOT_OURS = {"parallelism", "completions"}  # Prefect requires these in the pod spec, where Kubernetes drops them


def template(pool: str) -> dict[str, Any]:
    return json.loads((POOLS / f"{pool}.json").read_text())


def worker_of(pool: str) -> type[BaseWorker]:
    """Return the worker of a pool. Its library is imported only here, because every process of the tests imports this
    file, and only one needs the library."""
    if pool == "docker":
        from prefect_docker.worker import DockerWorker

        return DockerWorker
    from prefect_kubernetes.worker import KubernetesWorker

    return KubernetesWorker


def prepared(pool: str, **values: object) -> BaseJobConfiguration:
    """Return the job that a pool's worker makes from our template for a run with these job variables."""
    worker = worker_of(pool)
    make = worker.job_configuration.from_template_and_values
    job = asyncio.run(make(template(worker.type), values, client=object()))
    job.prepare_for_flow_run(RUN)
    return job


def manifest(**values: object) -> dict[str, Any]:
    """Return the manifest of a job, without the keys that Prefect puts in the wrong place (NOT_OURS)."""
    made: dict[str, Any] = prepared("kubernetes", **values).job_manifest
    pod = made["spec"]["template"]["spec"]
    made["spec"]["template"]["spec"] = {key: value for key, value in pod.items() if key not in NOT_OURS}
    return made


def validate(job: dict[str, Any]) -> None:
    """Raise ValidationError if the manifest does not match the schema or has unknown keys."""
    for version in ("1.28", kubernetes_validate.latest_version()):
        kubernetes_validate.validate(job, version, strict=True)


@pytest.mark.parametrize("pool", ["docker", "kubernetes"])
def test_variables_are_declared_and_used(pool: str) -> None:
    found = template(pool)
    WorkPoolCreate(name=pool, type=pool, base_job_template=found)
    Draft202012Validator.check_schema(found["variables"])
    used = {placeholder.name for placeholder in find_placeholders(found["job_configuration"])}
    assert used == set(found["variables"]["properties"])


@pytest.mark.parametrize(
    ("pool", "replaced"),
    [
        ("docker", {"command", "memswap_limit", "privileged", "container_create_kwargs"}),
        ("kubernetes", {"cpu_request", "memory_request"}),
    ],
)
def test_templates_have_the_variables_of_the_installed_prefect(pool: str, replaced: set[str]) -> None:
    default, ours = worker_of(pool).get_default_base_job_template(), template(pool)
    assert set(ours["job_configuration"]) == set(default["job_configuration"])
    assert set(default["variables"]["properties"]) - set(ours["variables"]["properties"]) == replaced


def test_a_job_has_one_gpu_and_limits_on_memory_and_time() -> None:
    job = manifest()
    validate(job)
    (container,) = job["spec"]["template"]["spec"]["containers"]
    assert container["resources"]["limits"] == {"cpu": "4", "memory": "16Gi", "nvidia.com/gpu": 1}
    assert container["resources"]["requests"] == container["resources"]["limits"]
    assert (job["spec"]["activeDeadlineSeconds"], job["spec"]["backoffLimit"]) == (86400, 0)
    assert container["args"] == ["prefect", "flow-run", "execute"]


def test_variables_reach_the_job() -> None:
    values = {"gpus": 0, "cpu_limit": "500m", "memory_limit": "3Gi", "time_limit_s": 60, "store_size": "2Gi"}
    job = manifest(image="example.org/hnerf:7", secret_name="keys", env={"HNERF_MODELS": "/models"}, **values)
    validate(job)
    pod = job["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert container["image"] == "example.org/hnerf:7" and job["spec"]["activeDeadlineSeconds"] == 60
    assert container["resources"]["limits"] == {"cpu": "500m", "memory": "3Gi", "nvidia.com/gpu": 0}
    assert pod["volumes"] == [{"name": "store", "emptyDir": {"sizeLimit": "2Gi"}}]
    assert container["envFrom"] == [{"secretRef": {"name": "keys"}}]
    assert {"name": "HNERF_MODELS", "value": "/models"} in container["env"]
    threads = {"resourceFieldRef": {"resource": "limits.cpu"}}
    assert {"name": "OMP_NUM_THREADS", "valueFrom": threads} in container["env"]


def docker_settings(**values: object) -> dict[str, Any]:
    """Return the container settings that the worker sends to Docker."""
    job = prepared("docker", env={"PREFECT_API_URL": "https://example.org/api"}, **values)
    return worker_of("docker")._build_container_settings(None, None, job)


def test_docker_containers_get_a_gpu_limits_and_the_folders_of_the_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    asked = docker_settings(cpuset_cpus="0-3", time_limit_s=60)
    assert asked["command"] == "timeout --foreground --kill-after=60 60 prefect flow-run execute"
    assert (asked["mem_limit"], asked["memswap_limit"], asked["cpuset_cpus"]) == ("16g", "16g", "0-3")
    here = os.path.realpath(tmp_path)
    assert asked["volumes"] == [f"{here}/{name}:/srv/hnerf/{name}" for name in ("store", "captures")]
    host = HostConfig(version="1.43", device_requests=asked["device_requests"], mem_limit=asked["mem_limit"])
    (gpu,) = host["DeviceRequests"]
    assert (gpu["Count"], gpu["Capabilities"], host["Memory"]) == (1, [["gpu"]], 16 * 2**30)


def test_docker_containers_can_run_without_a_gpu() -> None:
    asked = docker_settings(device_requests=[])
    assert asked["device_requests"] == [] and "cpuset_cpus" not in asked
