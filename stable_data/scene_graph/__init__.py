"""The scene graph: supports, relations and the stages of a scene."""
