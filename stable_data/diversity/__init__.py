"""How diverse a set of scenes is, and which of its scenes are near-duplicates."""
