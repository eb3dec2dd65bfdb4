"""Physics engines that judge whether a scene stays at rest, behind one interface: ``registry.judge``."""
