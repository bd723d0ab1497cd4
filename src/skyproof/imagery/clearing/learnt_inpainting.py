"""Fills masked ground with a learnt network from an ONNX file.

ONNX because such a file is numbers and the names of known operators. TorchScript and torch.export
files are archives with pickles in them, which run code before anybody can look at them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from skyproof.errors import ConfigurationError, ImageryError

_DOMAINS = ("", "ai.onnx")
_ARCHIVES = (b"PK\x03\x04", b"\x80")
_NO_LOGS = 4


class LearntInpainting:
    """A network in an ONNX file.

    Its inputs are called `image`, [1, 3, H, W], and `mask`, [1, 1, H, W], both 32-bit floats; its
    first output is the filled image, [1, 3, H, W]. LaMa is distributed in this form. Sides are
    padded to a multiple of 8, as such networks need.

    Nothing but the file itself is read: weights in other files, and operators that are not of the
    ONNX standard, are refused.

    Args:
        path: the file.

    Raises:
        ConfigurationError: onnxruntime is not installed.
        ImageryError: the file is missing, no ONNX model, or one of another form.
    """

    STRIDE_PX = 8

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise ImageryError(f"{self.path} is missing; give --inpainting an ONNX file.")
        content = self.path.read_bytes()
        if content.startswith(_ARCHIVES):
            raise ImageryError(
                f"{self.path} is an archive or a pickle (TorchScript, torch.export, torch.save), "
                "which could run code and is not opened; export the network to ONNX "
                "(torch.onnx.export)."
            )
        self._session = _session(self.path, content)
        self._digest = hashlib.sha256(content).hexdigest()

    def __call__(self, image: Float[Tensor, "3 H W"], mask: Bool[Tensor, "H W"]) -> Any:
        """Fills the mask; what the network returns is checked by `apply_inpainting`.

        Raises:
            RuntimeError: the network failed.
        """
        height, width = mask.shape
        pad = (0, -width % self.STRIDE_PX, 0, -height % self.STRIDE_PX)
        padded = torch.nn.functional.pad(image[None], pad, mode="replicate")
        flags = torch.nn.functional.pad(mask[None, None].float(), pad)
        inputs = {"image": padded.numpy(), "mask": flags.numpy()}
        try:
            result = self._session.run(None, inputs)[0]
        except Exception as error:
            # onnxruntime has exceptions of its own.
            raise RuntimeError(str(error)) from error
        filled = torch.from_numpy(result.copy())
        if filled.ndim != 4 or len(filled) != 1:
            return filled
        # A network that changed the size is to be refused, not cut to size.
        return filled[0, :, :height, :width] if filled.shape[2:] == padded.shape[2:] else filled[0]

    def record(self) -> dict[str, Any]:
        """Returns file name and SHA-256."""
        return {"name": self.path.name, "sha256": self._digest}


def _session(path: Path, content: bytes) -> Any:
    """Checks a model, and makes ready to run exactly what was checked."""
    onnx, onnxruntime = _libraries()
    try:
        model = onnx.load_model_from_string(content)
    except Exception as error:
        # The parser has exceptions of its own.
        raise ImageryError(
            f"{path} is no ONNX model; export the network to ONNX (torch.onnx.export)."
        ) from error
    for message in _messages(model):
        if isinstance(message, onnx.TensorProto) and message.data_location:
            raise ImageryError(
                f"{path} keeps weights in other files; save the network in one file "
                "(onnx.save(model, path, save_as_external_data=False))."
            )
        if isinstance(message, onnx.NodeProto) and message.domain not in _DOMAINS:
            raise ImageryError(
                f"{path} uses the operator {message.domain}.{message.op_type}, which is not of the "
                "ONNX standard; export the network with standard operators."
            )
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _NO_LOGS
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:
        # As above.
        reason = " ".join(str(error).split())[:200]
        raise ImageryError(
            f"{path} cannot be run as an ONNX model ({reason}); export the network again."
        ) from error
    inputs = {one.name: one.type for one in session.get_inputs()}
    if inputs != {"image": "tensor(float)", "mask": "tensor(float)"}:
        listed = ", ".join(f"{name}: {kind}" for name, kind in inputs.items()) or "none"
        raise ImageryError(
            f"{path} expects other inputs ({listed[:200]}) than image [1, 3, H, W] and mask "
            "[1, 1, H, W] of 32-bit floats; export the network with these."
        )
    if not session.get_outputs() or session.get_outputs()[0].type != "tensor(float)":
        raise ImageryError(
            f"{path} does not return an image of 32-bit floats; export the network with one."
        )
    return session


def _messages(message: Any) -> Iterator[Any]:
    """Gives a message of a model and all that are in it, sub-graphs and functions included."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None:
            several = [value] if hasattr(value, "ListFields") else value
            for one in several:
                yield from _messages(one)


def _libraries() -> tuple[Any, Any]:
    try:
        import onnx
        import onnxruntime
    except ImportError as error:
        raise ConfigurationError(
            "--inpainting needs onnx and onnxruntime, which are not installed; install skyproof "
            "with the extra 'onnx' (pip install 'skyproof[onnx]'), or leave --inpainting out."
        ) from error
    return onnx, onnxruntime
