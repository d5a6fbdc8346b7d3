"""NMS for a torchvision whose compiled operators cannot be loaded.

The package index has torchvision for Linux built for CUDA only. Beside a CPU build of PyTorch its
import fails ("operator torchvision::nms does not exist"). With NMS declared here its Python code
runs unchanged, and with it ultralytics, rfdetr, transformers and torchvision's one-stage detectors.
A torchvision that matches PyTorch is used as it is.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from typing import Any


def declare_nms() -> None:
    """Import torchvision, if it is installed, with NMS in Python if necessary."""
    if not (importlib.util.find_spec("torch") and importlib.util.find_spec("torchvision")):
        return
    import torch

    try:
        importlib.import_module("torchvision")
    except RuntimeError:
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        for operator in ("nms", "qnms"):
            schema = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
            torch.library.define(f"torchvision::{operator}", schema)
        torch.library.impl("torchvision::nms", "CPU")(nms)
        from torchvision.ops import boxes

        boxes._assert_has_ops = lambda: None


def nms(dets: Any, scores: Any, iou_threshold: float) -> Any:
    """Return the rows of boxes (N, 4) that greedy NMS keeps, best first."""
    import torch
    from torchvision.ops import box_iou

    left = scores.argsort(descending=True, stable=True)
    kept = []
    while len(left):
        kept.append(left[:1])
        iou = box_iou(dets[left[:1]], dets[left[1:]])[0]  # (rows left - 1,)
        left = left[1:][iou <= iou_threshold]
    return torch.cat([*kept, left])
