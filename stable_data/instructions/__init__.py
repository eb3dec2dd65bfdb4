"""Instructions: tasks derived from a scene graph by templates; every statement in them is true in the scene."""
