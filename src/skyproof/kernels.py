"""Kernels (NVIDIA Warp) on tensors: one source serves CPU and CUDA.

A kernel runs on the device of its tensors, after the work that torch has queued there. So memory
that torch frees in the meantime is reused only by later work.
"""

import os
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from skyproof.console import say
from skyproof.errors import ConfigurationError

_NO_GPU = b"Could not find or load the NVIDIA CUDA driver"

_loaded: set[tuple[wp.Module, torch.device]] = set()
_refused: list[str] = []
_loading = threading.RLock()


def launch(kernel: wp.Kernel, dim: Sequence[int], *arguments: Any) -> None:
    """Runs a kernel; tensors are passed as the arrays that it takes."""
    device = _device_of(arguments)
    _load(kernel.module, device)
    given = [
        _array(each, dtype, bare=True) if isinstance(each, Tensor) else each
        for each, dtype in zip(arguments, _types(kernel), strict=True)
    ]
    if device.type == "cuda":
        wp.launch(kernel, dim=dim, inputs=given, stream=_stream(torch.cuda.current_stream(device)))
    else:
        wp.launch(kernel, dim=dim, inputs=given, device="cpu")


def rows(kernel: wp.Kernel, dim: Sequence[int], *arguments: Any) -> None:
    """Runs a kernel along rows: one thread per row on a CPU, one per pixel on CUDA."""
    parts = dim[2] if _device_of(arguments).type == "cuda" else 1
    launch(kernel, (*dim[:2], parts), *arguments, parts)


def struct(kind: Any, **values: Any) -> Any:
    """Fills a struct; tensors are stored as the arrays that it holds, and kept alive."""
    _device_of(values.values())
    with _loading:
        _start()
    filled = kind()
    for name, value in values.items():
        if isinstance(value, Tensor):
            value = _array(value, kind.vars[name].type.dtype)
        setattr(filled, name, value)
    return filled


def _device_of(values: Iterable[Any]) -> torch.device:
    devices = {each.device for each in values if isinstance(each, Tensor)}
    if len(devices) != 1:
        raise ValueError(f"expected tensors on one device, got {sorted(map(str, devices))}")
    return devices.pop()


def _array(tensor: Tensor, dtype: Any, *, bare: bool = False) -> Any:
    """A kernel's view of a tensor's numbers, vectors, or rows as structs."""
    if not hasattr(dtype, "vars"):
        return wp.from_torch(tensor, dtype, requires_grad=False, return_ctype=bare)
    assert tensor.is_contiguous()
    shape, device = (len(tensor),), _warp_device(tensor.device)
    view: Any = wp.array(ptr=tensor.data_ptr(), dtype=dtype, shape=shape, device=device)
    view.held = tensor
    return view


def _warp_device(device: torch.device) -> wp.Device:
    try:
        return wp.device_from_torch(device)
    except (RuntimeError, IndexError) as error:
        raise ConfigurationError(
            f"The renderer needs a CPU, or a CUDA device with a driver that Warp {wp.__version__} "
            f"knows, and got {device}; update the driver, or give --device cpu."
        ) from error


@cache
def _types(kernel: wp.Kernel) -> list[Any]:
    return [getattr(each.type, "dtype", None) for each in kernel.adj.args]


@cache
def _stream(stream: torch.cuda.Stream) -> wp.Stream:
    return wp.stream_from_torch(stream)


def _load(module: wp.Module, device: torch.device) -> None:
    """Makes a module's kernels ready; other threads wait for the one that compiles them."""
    if (module, device) in _loaded:
        return
    with _loading:
        _start()
        # The name depends on the number of threads in a block, which is one on a CPU.
        name = module.get_module_identifier(1 if device.type == "cpu" else None)
        if not Path(_folder(), name).exists():
            _tell_of_compiling()
        wp.force_load(_warp_device(device), [module])
        _loaded.add((module, device))


@cache
def _tell_of_compiling() -> None:
    how = "once per machine (about 10 s)"
    if _refused:
        how = f"for this run alone (about 10 s), because {_refused[0]} cannot be written; "
        how += "WARP_CACHE_PATH may name another folder"
    say(f"  compiling the renderer, {how} ...")


@cache
def _start() -> None:
    """Starts Warp, with a folder for compiled kernels that can be written."""
    # Its banner would come before every command's own words.
    wp.config.log_level = wp.LOG_ERROR
    with _without_the_drivers_line():
        try:
            wp.init()
        except OSError:
            _compile_elsewhere()
            wp.init()
    if not os.access(_folder(), os.W_OK):
        _compile_elsewhere()


def _folder() -> str:
    return str(wp.config.kernel_cache_dir)


@cache
def _compile_elsewhere() -> tempfile.TemporaryDirectory[str]:
    """Chooses another folder, which is removed when the program and with it the cache end."""
    _refused.append(_folder())
    folder = tempfile.TemporaryDirectory(prefix="skyproof-kernels-")
    wp.config.kernel_cache_dir = folder.name
    return folder


@contextmanager
def _without_the_drivers_line() -> Iterator[None]:
    """Drops the line that Warp writes without a GPU; other lines appear when the block ends."""
    if sys.stderr is None:
        yield
        return
    sys.stderr.flush()
    with tempfile.TemporaryFile() as written:
        kept = os.dup(2)
        os.dup2(written.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            written.seek(0)
            os.write(2, b"".join(line for line in written if _NO_GPU not in line))
