"""ONNX files of others: what they do wrong is one line that names them, and nothing is written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import denoisers
from denoisers.onnx import OnnxNetwork, compile_openvino
from rawaug.bayer import CFA
from rawaug.commands.export import export
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.io import RawFrame, write_dng

helper = pytest.importorskip("onnx.helper", reason="pip install rawaug[export]")
pytest.importorskip("onnxruntime", reason="pip install rawaug[export]")
import onnx  # noqa: E402

Nodes = Callable[[], list[Any]]


def written(path: Path, nodes: list[Any], channels: int = 4) -> Path:
    """A graph from ``noisy`` to ``denoised``."""
    shape, kind = ["b", channels, "h", "w"], onnx.TensorProto.FLOAT
    values = [helper.make_tensor_value_info(name, kind, shape) for name in ("noisy", "denoised")]
    graph = helper.make_graph(nodes, "graph", values[:1], [helper.make_empty_tensor_value_info("denoised")])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(path))
    return path


def halved() -> list[Any]:
    return [helper.make_node("AveragePool", ["noisy"], ["denoised"], kernel_shape=[2, 2], strides=[2, 2])]


def infinite() -> list[Any]:
    zero = helper.make_node("Sub", ["noisy", "noisy"], ["zero"])
    return [zero, helper.make_node("Div", ["noisy", "zero"], ["denoised"])]


def huge() -> list[Any]:
    size = helper.make_tensor("value", onnx.TensorProto.INT64, [1], [2**42])
    made = helper.make_node("ConstantOfShape", ["size"], ["many"])
    total = helper.make_node("ReduceSum", ["many"], ["total"], keepdims=0)
    constant = helper.make_node("Constant", [], ["size"], value=size)
    return [constant, made, total, helper.make_node("Add", ["noisy", "total"], ["denoised"])]


def mismatched() -> list[Any]:
    weights = helper.make_tensor("value", onnx.TensorProto.FLOAT, [4, 3, 1, 1], [0.0] * 12)
    constant = helper.make_node("Constant", [], ["weights"], value=weights)
    return [constant, helper.make_node("Conv", ["noisy", "weights"], ["denoised"])]


@pytest.mark.parametrize(
    ("nodes", "said"),
    [
        (halved, "foreign.onnx: the result has another shape"),
        (infinite, "the result is not finite"),
        (huge, "foreign.onnx: "),
        (mismatched, "foreign.onnx: "),
    ],
)
def test_a_graph_that_goes_wrong_is_one_line_and_writes_nothing(
    nodes: Nodes, said: str, tmp_path: Path, refused: Callable[..., str]
) -> None:
    file = written(tmp_path / "foreign.onnx", nodes())
    source, out = tmp_path / "in.dng", tmp_path / "out.dng"
    write_dng(source, RawFrame(torch.full((1, 64, 64), 0.5), CFA.GRBG))
    printed = refused("denoise", source, out, "--denoiser", file, "--noise", "[1e-3, 1e-5]")
    assert said in printed and not out.exists()


def test_a_graph_of_one_input_is_blind_and_one_of_three_is_refused(tmp_path: Path) -> None:
    file = written(tmp_path / "foreign.onnx", [helper.make_node("Identity", ["noisy"], ["denoised"])])
    denoiser, noisy = RawDenoiser.of(file), torch.rand(1, 4, 32, 32)
    assert not denoiser.reads_levels and torch.equal(denoiser(Noisy(noisy)), noisy)
    model = onnx.load(file)
    for name in ("b", "c"):
        model.graph.input.append(helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]))
    onnx.save(model, str(file))
    with pytest.raises(ValueError, match="denoiser"):
        RawDenoiser.of(file)


def test_openvino_computes_what_onnx_runtime_does(tmp_path: Path) -> None:
    pytest.importorskip("openvino", reason="pip install rawaug[openvino]")
    network = denoisers.build("UNet", width=4, scales=2)
    for weights in network.parameters():  # the last ones are zeros at first
        weights.data.uniform_(-0.2, 0.2, generator=torch.Generator().manual_seed(0))
    denoisers.save(network, tmp_path / "small.safetensors", {"cfa": "RGGB"})
    export(tmp_path / "small.safetensors", tmp_path / "small.onnx")
    run = OnnxNetwork(tmp_path / "small.onnx")
    for height, width in ((32, 48), (16, 64), (32, 48)):
        noisy = torch.rand(1, 4, height, width, generator=torch.Generator().manual_seed(height))
        inputs = {"noisy": noisy.numpy(), "variance": (1e-3 * noisy + 1e-5).numpy()}
        compiled = compile_openvino(run.path, inputs)
        assert compiled is not None and compiled is not run.session.run
        (expected,) = run.session.run(None, inputs)
        torch.testing.assert_close(torch.as_tensor(compiled(inputs)[0]), torch.as_tensor(expected), atol=1e-5, rtol=0)
        torch.testing.assert_close(run(noisy, 1e-3 * noisy + 1e-5), torch.as_tensor(expected), atol=1e-5, rtol=0)
