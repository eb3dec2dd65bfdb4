"""Conditional flow matching on poses, and the networks that learn it."""
