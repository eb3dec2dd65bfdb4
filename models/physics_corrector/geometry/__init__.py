"""Shapes and scenes as tensors."""
