"""Networks in ONNX files of unknown origin: a strict reader, and a check of operators, shapes and cost.

The check runs before onnxruntime sees a file. It needs neither `onnx` nor protobuf, takes bounded time and memory, and
accepts only files whose meaning it understands completely.
"""
