"""RTFNet's checkpoints: bare state dicts, without counters where they are old."""

from __future__ import annotations

from rgbt.checkpoints.layout import (
    Facts,
    count_blocks,
    has_parts,
    own_names,
    shapes_of,
    size_at,
)
from rgbt.checkpoints.layouts.resnet import DEPTHS
from rgbt.checkpoints.read import Contents

CONVENTION = ("model/inputs=unit", "model.final_relu=true")


def recognise(contents: Contents) -> Facts | None:
    """A file with both encoders and the decoder."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "encoder_rgb_", "encoder_thermal_", "deconv"):
        return None
    bottlenecks = any(name.startswith("encoder_rgb_layer1.0.conv3.") for name in shapes)
    blocks = tuple(
        count_blocks(shapes, rf"encoder_rgb_layer{stage}\.(\d+)\.") for stage in range(1, 5)
    )
    layers = DEPTHS.get((bottlenecks, blocks))
    return Facts(
        layout="rtfnet",
        what="RTFNet checkpoint",
        family="rtfnet",
        size=f"ResNet-{layers}" if layers else "",
        classes=size_at(shapes, "deconv5.1.conv1.weight"),
        fits=((f"model=rtfnet_{layers}",),) if layers else (),
        convention=CONVENTION,
    )


rule = own_names
