"""Attention over the cells of a feature map as ONNX nodes, on cells (batch, ny * nx, channels)."""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor

from yolov5_lifecycle.models.attention import TransformerBlock, TransformerLayer
from yolov5_lifecycle.runtimes.onnx_graph_builder import Graph


def transformed(graph: Graph, module: TransformerBlock, features: str) -> str:
    """Add a transformer that reads and returns features (batch, channels, ny, nx)."""
    flat = graph.add("Reshape", features, graph.constant([0, 0, -1]))
    cells = graph.add("Transpose", flat, perm=[0, 2, 1])
    assert module.linear.bias is not None
    cells = graph.add("Add", cells, _linear(graph, cells, module.linear.weight, module.linear.bias))
    for layer in module.tr:
        assert isinstance(layer, TransformerLayer)
        cells = _layer(graph, layer, cells)
    return graph.add("Reshape", graph.add("Transpose", cells, perm=[0, 2, 1]), graph.add("Shape", features))


def _layer(graph: Graph, module: TransformerLayer, cells: str) -> str:
    attended = graph.add("Add", _attention(graph, module, cells), cells)
    refined = _linear(graph, _linear(graph, attended, module.fc1.weight), module.fc2.weight)
    return graph.add("Add", refined, attended)


def _attention(graph: Graph, module: TransformerLayer, cells: str) -> str:
    attention = module.ma
    heads, size = attention.num_heads, attention.embed_dim // attention.num_heads
    assert attention.in_proj_weight is not None
    assert attention.in_proj_bias is not None
    queries, keys, values = (
        _linear(graph, _linear(graph, cells, first.weight), weight, bias)
        for first, weight, bias in zip(
            (module.q, module.k, module.v),
            attention.in_proj_weight.chunk(3),
            attention.in_proj_bias.chunk(3),
            strict=True,
        )
    )
    by_head = graph.constant([0, 0, heads, size])
    queries = graph.add("Transpose", graph.add("Reshape", queries, by_head), perm=[0, 2, 1, 3])
    keys = graph.add("Transpose", graph.add("Reshape", keys, by_head), perm=[0, 2, 3, 1])
    values = graph.add("Transpose", graph.add("Reshape", values, by_head), perm=[0, 2, 1, 3])
    queries = graph.add("Mul", queries, graph.constant(np.float32(1 / math.sqrt(size))))
    shares = graph.add("Softmax", graph.add("MatMul", queries, keys), axis=-1)
    mixed = graph.add("Transpose", graph.add("MatMul", shares, values), perm=[0, 2, 1, 3])
    joined = graph.add("Reshape", mixed, graph.constant([0, 0, attention.embed_dim]))
    return _linear(graph, joined, attention.out_proj.weight, attention.out_proj.bias)


def _linear(graph: Graph, cells: str, weight: Tensor, bias: Tensor | None = None) -> str:
    product = graph.add("MatMul", cells, graph.constant(weight.T))
    return product if bias is None else graph.add("Add", product, graph.constant(bias))
