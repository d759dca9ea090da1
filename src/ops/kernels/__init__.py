"""Kernels of some operations for GPUs: one file an operation and backend, imported by `src.ops.backend` when asked for.

Each is optional and gives what the torch reference of its operation gives, within the rounding of float32. Kernels are
deterministic: sums run in a fixed order, and the one atomic, an `or` of bits, gives the same in any. What a kernel does
not take (float64, tensors of the CPU outside Triton's interpreter) goes to the reference.
"""
