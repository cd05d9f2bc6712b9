"""A simulated GPU: CPU tensors that claim to be on cuda:0, so that tests without a GPU detect operations on tensors of
two devices. Warp's kernels and `embedding_bag` run on the CPU."""

import builtins
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

from hnerf.avatar import trained as model
from hnerf.body import canonical, correction_pull
from hnerf.body.descriptor import BodyMeshes, ClosestPoints
from hnerf.fields import fast, shell, sparse_grids
from hnerf.fields.paper import PaperField
from hnerf.training import trainer

CUDA = torch.device("cuda", 0)
INDEXING = ("aten.index.", "aten.index_put", "aten._index_put")


class OnCuda(Tensor):
    """A wrapped CPU tensor; every operation that reaches a kernel checks devices as CUDA would."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "OnCuda":
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        wrapped = Tensor._make_wrapper_subclass(cls, inner.size(), device="meta", **layout)
        wrapped.inner = inner
        return wrapped

    device = property(lambda self: CUDA)
    is_cuda = property(lambda self: True)
    __torch_function__ = torch._C._disabled_torch_function_impl

    def tolist(self) -> Any:
        return self.inner.tolist()

    def data_ptr(self) -> int:
        return self.inner.data_ptr()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), str(func)
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        target = None if kwargs.get("device") is None else torch.device(kwargs["device"])
        if target is not None:
            kwargs["device"] = torch.device("cpu")
        _require_one_device(name, args, tensors)
        out = func(*tree_map(_unwrapped, args), **tree_map(_unwrapped, kwargs))
        if func._schema.name.endswith("_"):  # in place
            return args[0] if func._schema.returns else None
        same = [x for x in tensors if _unwrapped(x) is out]
        first = args[0] if args else None
        here = first if isinstance(first, Tensor) else next(iter(tensors), None)
        on_cuda = isinstance(here, OnCuda) if target is None else target.type != "cpu"
        return same[0] if same else tree_map(_wrapped if on_cuda else _as_is, out)


class Routed(TorchFunctionMode):
    """A mode that runs CUDA requests on the CPU and wraps the results."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", "")
        if name == "to" and isinstance(args[0], Tensor):
            return _moved(args[0], args[1:], kwargs)
        if name == "cpu" and isinstance(args[0], OnCuda):
            return args[0].detach().inner.clone()
        if name == "__setitem__":
            target, where, value = args
            if isinstance(target, OnCuda):
                assert not _on_cpu(value), "a CPU tensor is written into one on CUDA"
                target.detach().inner[tree_map(_unwrapped, where)] = _unwrapped(value)
                return None
            assert not any(isinstance(x, OnCuda) for x in tree_leaves(args)), "CUDA is written into the CPU"
        if name == "where" and len(args) == 3:  # numbers become tensors with the dtype of the branches
            kinds = [x.dtype for x in args[1:] if isinstance(x, Tensor)] or [torch.float32]
            args = (args[0], *(x if isinstance(x, Tensor) else torch.tensor(x, dtype=kinds[0]) for x in args[1:]))
        if _is_cuda(kwargs.get("device")):
            return _wrapped(func(*args, **kwargs | {"device": "cpu"}).detach().clone())
        return func(*args, **kwargs)


class OfCuda(torch.Generator):
    """A generator that claims to be on CUDA."""

    device = CUDA

    def __new__(cls, device: torch.device) -> "OfCuda":
        assert _is_cuda(device)
        return super().__new__(cls)


class Meshes:
    """`BodyMeshes` on the CPU."""

    def __init__(self, vertices_m: Tensor, faces: Tensor):
        self.inner = BodyMeshes(_unwrapped(vertices_m), _unwrapped(faces))

    def refit(self, vertices_m: Tensor) -> None:
        """Move the vertices, as `BodyMeshes.refit` does."""
        self.inner.refit(_unwrapped(vertices_m))

    def closest_points(self, points_m: Tensor, body: Tensor, reach_m: float, exact_sign: bool = False) -> ClosestPoints:
        """Return closest points, as `BodyMeshes.closest_points` does."""
        assert isinstance(points_m, OnCuda) == isinstance(body, OnCuda), "points and bodies are on two devices"
        asked = [_unwrapped(x.detach()) for x in (points_m, body)]
        found = self.inner.closest_points(*asked, reach_m, exact_sign)
        wrap = _wrapped if isinstance(points_m, OnCuda) else _as_is
        return ClosestPoints(wrap(found.face), wrap(found.barycentric), wrap(found.sign))


@contextmanager
def pretended_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """Yield the simulated device. Trained models are written and read; checkpoints are not written."""
    bag, load = torch.nn.functional.embedding_bag, model.load_file

    def embedding_bag(corners: Tensor, values: Tensor, *, per_sample_weights: Tensor, mode: str, **_: Any) -> Tensor:
        on_cuda = {isinstance(x, OnCuda) for x in (corners, values, per_sample_weights)}
        assert len(on_cuda) == 1, "embedding_bag of two devices"
        asked = [_unwrapped(x.detach()) for x in (corners, values, per_sample_weights)]
        found = bag(asked[0], asked[1], per_sample_weights=asked[2], mode=mode)
        return _wrapped(found) if on_cuda.pop() else found

    def load_file(path: Path, device: str) -> dict[str, Tensor]:
        assert _is_cuda(device)
        return {name: _wrapped(value) for name, value in load(path).items()}

    monkeypatch.setattr(torch, "Generator", OfCuda)
    monkeypatch.setattr(torch, "manual_seed", torch.default_generator.manual_seed)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "pretended")
    for counted in ("max_memory_allocated", "memory_allocated", "memory_reserved", "reset_peak_memory_stats"):
        monkeypatch.setattr(torch.cuda, counted, lambda device: 0)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1 << 30, 1 << 30))
    monkeypatch.setattr(torch.nn.functional, "embedding_bag", embedding_bag)
    for module in (canonical, fast):
        monkeypatch.setattr(module, "BodyMeshes", Meshes)
    for module in (correction_pull, shell, sparse_grids):
        monkeypatch.setattr(module, "_launch", _on_one_device(module._launch))
    monkeypatch.setattr(shell, "ThreadPoolExecutor", lambda threads: nullcontext(builtins))  # modes are per thread
    monkeypatch.setattr(PaperField, "compile_networks", lambda field: None)  # no GPU to compile for
    monkeypatch.setattr(model, "load_file", load_file)
    monkeypatch.setattr(trainer, "save_checkpoint", lambda folder, state: None)
    with Routed():
        yield CUDA


def _on_one_device(launch: Callable[..., None]) -> Callable[..., None]:
    """Return a function that launches warp's kernels on the CPU, after a check that all tensors are on one device."""

    def run(*args: Any) -> None:
        tensors = [x for x in tree_leaves(args) if isinstance(x, Tensor)]
        assert len({isinstance(x, OnCuda) for x in tensors}) == 1, "a kernel's tensors are on two devices"
        launch(*tree_map(lambda x: _unwrapped(x.detach()) if isinstance(x, Tensor) else x, args))

    return run


def _require_one_device(name: str, args: Any, tensors: list[Tensor]) -> None:
    if name.startswith(INDEXING):
        into, where = args[:2]
        if not isinstance(into, OnCuda) and any(isinstance(x, OnCuda) for x in tree_leaves(where)):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
        tensors = [into, *(x for x in args[2:3] if isinstance(x, Tensor))]
    mixed = any(isinstance(x, OnCuda) for x in tensors) and any(_on_cpu(x) for x in tensors)
    if mixed and not name.startswith(("aten.copy_", "aten._to_copy")):
        raise RuntimeError(f"Expected all tensors to be on the same device: {name}")


def _moved(tensor: Tensor, rest: tuple[Any, ...], kwargs: dict[str, Any]) -> Tensor:
    device, dtype = kwargs.get("device"), kwargs.get("dtype")
    for x in rest:
        if isinstance(x, Tensor):
            device, dtype = x.device, x.dtype
        elif isinstance(x, torch.dtype):
            dtype = x
        elif isinstance(x, str | torch.device):
            device = x
    if device is not None and not _is_cuda(device) and isinstance(tensor, OnCuda):
        tensor = tensor.detach().inner.clone()
    if dtype is not None:
        tensor = tensor.to(dtype=dtype) if tensor.dtype != dtype else tensor
    return _wrapped(tensor.detach().clone()) if _is_cuda(device) and not isinstance(tensor, OnCuda) else tensor


def _is_cuda(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


def _on_cpu(x: Any) -> bool:
    """Return whether x is a CPU tensor that cannot be combined with CUDA tensors, as a 0-dimensional one can."""
    return isinstance(x, Tensor) and not isinstance(x, OnCuda) and not x.is_meta and x.dim() > 0


def _unwrapped(x: Any) -> Any:
    if isinstance(x, OnCuda):
        return x.inner
    return torch.zeros(x.shape, dtype=x.dtype) if isinstance(x, Tensor) and x.is_meta else x


def _wrapped(x: Any) -> Any:
    return OnCuda(x) if isinstance(x, Tensor) and not isinstance(x, OnCuda) else x


def _as_is(x: Any) -> Any:
    return x
