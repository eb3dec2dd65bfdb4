"""Replies: their grammar, their checks, their repair, and their conversion to scene objects."""
