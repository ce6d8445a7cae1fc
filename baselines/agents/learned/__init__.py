"""Learned agents: encodings of observations, networks (ONNX, run without torch) and their cards."""
