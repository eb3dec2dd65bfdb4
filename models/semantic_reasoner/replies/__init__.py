"""Replies: their grammar, their checks, their way into a scene."""
