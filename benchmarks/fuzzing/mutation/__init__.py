"""Edits of inputs, one module for each form."""
