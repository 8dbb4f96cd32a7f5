"""Exported networks: their description, the traced graph, and ONNX files that predict."""
