"""Static int8 quantisation of an exported network, and float16 weights.

Activations uint8, weights int8 per output channel, as QDQ pairs: the combination onnxruntime's x86 and Arm
kernels
are fastest with (signed activations run slower than float32 on x86 without VNNI).
"""

import logging
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from edgeslam_torch.models.onnx.bias_correction import correct_biases
from edgeslam_torch.models.onnx.file import INPUT, LOG_DEPTH, SIGMA

MIN_CALIBRATION_IMAGES = 8
CALIBRATION_PERCENTILE = 99.99
"""Percentile at which activations are clipped, so that outliers do not reduce the resolution."""


def quantize_int8(source: Path, target: Path, images: Iterable[NDArray[np.float32]]) -> None:
    """Write an int8 version of ``source``.

    The last convolution and what follows stay float32: they are cheap, and 256 levels of log depth would be visible
    as steps.

    Args:
        source: File written by `export_onnx`.
        target: Where to write.
        images: Preprocessed inputs ``(1, 3, H, W)`` of representative real frames.

    Raises:
        ValueError: If there are fewer than 8 images.
    """
    from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    samples = list(images)
    if len(samples) < MIN_CALIBRATION_IMAGES:
        raise ValueError(f"calibration needs at least {MIN_CALIBRATION_IMAGES} images, got {len(samples)}")
    properties = {p.key: p.value for p in onnx.load(str(source)).metadata_props}
    logger = logging.getLogger()
    level = logger.level
    # onnxruntime logs irrelevant advice to stdout and the root logger.
    with TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        prepared = Path(folder) / "prepared.onnx"
        logger.setLevel(logging.ERROR)
        try:
            quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
            model = onnx.shape_inference.infer_shapes(onnx.load(str(prepared)))
            double_by_gather(model)
            onnx.save(model, str(prepared))
            quantize_static(
                str(prepared),
                str(target),
                _Samples(samples),
                quant_format=QuantFormat.QDQ,
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                nodes_to_exclude=_tail(model),
                calibrate_method=CalibrationMethod.Percentile,
                extra_options={"CalibPercentile": CALIBRATION_PERCENTILE, "WeightSymmetric": True},
            )
        finally:
            logger.setLevel(level)
    model = onnx.load(str(target))
    correct_biases(model, onnx.load(str(source)), samples)
    helper.set_model_props(model, properties)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(target))


def store_float16(source: Path, target: Path) -> None:
    """Halve a file: weights are stored as float16 and cast once when the model is loaded; arithmetic stays
    float32."""
    model = onnx.load(str(source))
    casts, kept = [], []
    for tensor in model.graph.initializer:
        array = numpy_helper.to_array(tensor)
        if array.dtype != np.float32 or array.size < 256:
            kept.append(tensor)
            continue
        half = f"{tensor.name}_half"
        kept.append(numpy_helper.from_array(array.astype(np.float16), half))
        casts.append(helper.make_node("Cast", [half], [tensor.name], to=TensorProto.FLOAT))
    nodes = casts + list(model.graph.node)
    del model.graph.initializer[:], model.graph.node[:]
    model.graph.initializer.extend(kept)
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(target))


def double_by_gather(model: onnx.ModelProto) -> None:
    """Replace each nearest-neighbour upsampling by two gathers, in place; the values are the same.

    onnxruntime's uint8 Resize is slow, a quarter of the whole network's time; copying rows of channels is cheap, and
    the transposes cancel against those of int8 convolutions.

    Args:
        model: With inferred shapes; upsampling of dynamic sizes is left unchanged.
    """
    known = {v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in model.graph.value_info}
    nodes = []
    for node in model.graph.node:
        shape = known.get(node.input[0], []) if node.op_type == "Resize" else []
        if len(shape) != 4 or not all(shape[2:]) or known.get(node.output[0], [])[2:] != [2 * n for n in shape[2:]]:
            nodes.append(node)
            continue
        name = node.output[0]
        a, b, c, rows, columns = (f"{name}_{part}" for part in ("nhwc", "wide", "doubled", "rows", "columns"))
        for indices, size in ((rows, shape[2]), (columns, shape[3])):
            twice = np.repeat(np.arange(size, dtype=np.int64), 2)
            model.graph.initializer.append(numpy_helper.from_array(twice, indices))
        nodes += [
            helper.make_node("Transpose", [node.input[0]], [a], name=f"{a}_node", perm=[0, 2, 3, 1]),
            helper.make_node("Gather", [a, columns], [b], name=f"{b}_node", axis=2),
            helper.make_node("Gather", [b, rows], [c], name=f"{c}_node", axis=1),
            helper.make_node("Transpose", [c], [name], name=f"{name}_node", perm=[0, 3, 1, 2]),
        ]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    # The scale factors are unused now; onnxruntime would print a warning for each.
    used = {name for node in nodes for name in node.input}
    kept = [tensor for tensor in model.graph.initializer if tensor.name in used]
    del model.graph.initializer[:]
    model.graph.initializer.extend(kept)


class _Samples:
    """onnxruntime's calibration reader."""

    def __init__(self, images: list[NDArray[np.float32]]) -> None:
        self._iterator: Iterator[NDArray[np.float32]] = iter(images)

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        """One input, None at the end."""
        image = next(self._iterator, None)
        return None if image is None else {INPUT: image}


def _tail(model: onnx.ModelProto) -> list[str]:
    """Names of the nodes between the last features and the outputs (back to and including the
    convolutions)."""
    producer = {output: node for node in model.graph.node for output in node.output}
    names: list[str] = []
    waiting = [LOG_DEPTH, SIGMA]
    while waiting:
        node = producer.get(waiting.pop())
        if node is None or node.name in names:
            continue
        names.append(node.name)
        if node.op_type != "Conv":
            waiting.extend(node.input)
    return names
