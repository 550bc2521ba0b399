"""Inference runtimes: torch, ONNX Runtime and OpenVINO, and the choice between them."""
