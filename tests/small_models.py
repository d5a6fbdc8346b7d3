"""Models small enough for tests: ONNX graphs, and another library's with random weights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest


def write_model(
    path: Path,
    outputs: dict[str, Any],
    shape: Sequence[Any] = (1, 3, 64, 64),
    seen: tuple[str, tuple[int, ...], Any] | None = None,
    each: bool = False,
    **metadata: str,
) -> Path:
    """Write a model, `m.onnx` of a folder, whose output is the same for every image.

    Args:
        outputs: by name; `boxes` (DETR) need the sizes of the images as a second input.
        shape: of the input.
        seen: (output, index, weights): to this number the mean of weights * input is added.
        each: the mean of each image of a batch, else of all.
    """
    onnx = pytest.importorskip("onnx", reason="pip install onnx (extra `dev`)")
    helper = onnx.helper
    inputs = [helper.make_tensor_value_info("images", 1, shape)]
    if "boxes" in outputs:
        inputs.append(helper.make_tensor_value_info("orig_target_sizes", 7, ["n", 2]))
    nodes = []
    made = []
    constants = dict[str, Any]()
    for name, value in outputs.items():
        array = np.asarray(value)
        array = array.astype(np.float32) if array.dtype == np.float64 else array
        constants[f"constant {name}"] = array
        kind = helper.np_dtype_to_tensor_dtype(array.dtype)
        made.append(helper.make_tensor_value_info(name, kind, None))
        if seen is None or seen[0] != name:
            nodes.append(helper.make_node("Identity", [f"constant {name}"], [name]))
            continue
        at = np.zeros_like(array)
        at[seen[1]] = 1
        column = np.array([-1, 1, 1] if each else [1])
        constants |= {"weights": np.float32(seen[2]), "at": at, "column": column}
        axes = {"axes": [1, 2, 3]} if each else {}
        nodes += [
            helper.make_node("Mul", ["images", "weights"], ["weighted"]),
            helper.make_node("ReduceMean", ["weighted"], ["mean"], keepdims=0, **axes),
            helper.make_node("Reshape", ["mean", "column"], ["means"]),
            helper.make_node("Mul", ["means", "at"], ["added"]),
            helper.make_node("Add", ["added", f"constant {name}"], [name]),
        ]
    tensors = [onnx.numpy_helper.from_array(a, name) for name, a in constants.items()]
    graph = helper.make_graph(nodes, "g", inputs, made, tensors)
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    helper.set_model_props(model, {key: text for key, text in metadata.items() if text})
    path = path / "m.onnx" if path.is_dir() else path
    onnx.save(model, path)
    return path


def small_rt_detr() -> Any:
    """RT-DETRv2 with the classes lamp and plant."""
    import transformers as tf

    backbone = tf.RTDetrResNetConfig(
        embedding_size=16, hidden_sizes=[16, 32, 64, 64], depths=[1, 1, 1, 1],
        out_features=["stage2", "stage3", "stage4"],
    )  # fmt: skip
    config = tf.RTDetrV2Config(
        backbone_config=backbone, encoder_in_channels=[32, 64, 64], encoder_hidden_dim=64,
        decoder_in_channels=[64, 64, 64], encoder_layers=1, encoder_ffn_dim=64, d_model=64,
        decoder_layers=2, num_queries=20, id2label={0: "lamp", 1: "plant"},
    )  # fmt: skip
    return tf.RTDetrV2ForObjectDetection(config)
