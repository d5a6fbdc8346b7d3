"""Models of other libraries with random weights, small enough for tests."""

from __future__ import annotations

from typing import Any


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
