"""Maths on plain tensors: each file is one operation with its torch reference."""
